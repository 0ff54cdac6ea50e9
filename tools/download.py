"""``mambaloc download``, from a checkout."""

from mambaloc.commands.download import main

if __name__ == "__main__":
    main()
