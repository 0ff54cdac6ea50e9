"""``mambaloc export``, from a checkout."""

from mambaloc.commands.export import main

if __name__ == "__main__":
    main()
