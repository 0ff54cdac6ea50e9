"""``mambaloc train``, from a checkout."""

from mambaloc.commands.train import main

if __name__ == "__main__":
    main()
