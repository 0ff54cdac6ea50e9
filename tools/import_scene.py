"""``mambaloc import``, from a checkout."""

from mambaloc.commands.import_scene import main

if __name__ == "__main__":
    main()
