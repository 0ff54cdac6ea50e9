"""``mambaloc publish``, from a checkout."""

from mambaloc.commands.publish import main

if __name__ == "__main__":
    main()
