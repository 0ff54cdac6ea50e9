"""Train a recipe: mambaloc train RECIPE [OVERLAY ...] [--key value ...]."""

import os
import time

began_s = time.monotonic()  # a time budget counts the imports, too
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy: on a map's small matrices threads only wait

from mambaloc import cli  # noqa: E402


def main(argv: list[str] | None = None) -> cli.RecipeCLI:
    """Train; a run gets a folder of its own."""
    return cli.main(argv, began_s)
