"""``mambaloc map``, from a checkout."""

from mambaloc.commands.map import main

if __name__ == "__main__":
    main()
