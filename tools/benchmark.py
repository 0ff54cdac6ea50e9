"""``mambaloc benchmark``, from a checkout."""

from mambaloc.commands.benchmark import main

if __name__ == "__main__":
    main()
