"""``mambaloc demo``, from a checkout."""

from mambaloc.commands.demo import main

if __name__ == "__main__":
    main()
