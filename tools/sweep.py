"""``mambaloc sweep``, from a checkout."""

from mambaloc.commands.sweep import main

if __name__ == "__main__":
    main()
