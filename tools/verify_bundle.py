"""``mambaloc verify``, from a checkout."""

from mambaloc.commands.verify_bundle import main

if __name__ == "__main__":
    main()
