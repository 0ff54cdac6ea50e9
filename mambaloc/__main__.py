"""``python -m mambaloc``: the command ``mambaloc``."""

from mambaloc.commands import main

if __name__ == "__main__":
    main()
