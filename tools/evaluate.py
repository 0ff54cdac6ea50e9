"""``mambaloc evaluate``, from a checkout."""

from mambaloc.commands.evaluate import main

if __name__ == "__main__":
    main()
