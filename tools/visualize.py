"""``mambaloc visualize``, from a checkout."""

from mambaloc.commands import run

if __name__ == "__main__":
    run("visualize")
