"""``mambaloc visualize``, from a checkout."""

from mambaloc.commands.visualize import main

if __name__ == "__main__":
    main()
