"""``mambaloc localize``, from a checkout."""

from mambaloc.commands.localize import main

if __name__ == "__main__":
    main()
