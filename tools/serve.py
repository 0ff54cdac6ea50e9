"""``mambaloc serve``, from a checkout."""

from mambaloc.commands.serve import main

if __name__ == "__main__":
    main()
