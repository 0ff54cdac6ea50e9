"""``mambaloc export-scene``, from a checkout."""

from mambaloc.commands.export_scene import main

if __name__ == "__main__":
    main()
