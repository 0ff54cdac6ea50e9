"""``mambaloc publish``, from a checkout."""

from mambaloc.commands import run

if __name__ == "__main__":
    run("publish")
