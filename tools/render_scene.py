"""``mambaloc render``, from a checkout."""

from mambaloc.commands.render_scene import main

if __name__ == "__main__":
    main()
