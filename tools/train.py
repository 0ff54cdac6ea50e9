"""Train a recipe: python tools/train.py RECIPE.yaml [OVERLAY.yaml ...] [--key value ...]."""

import os
import time

began_s = time.monotonic()  # a time budget counts the imports, too
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy: on a map's small matrices threads only wait

from mambaloc.cli import main  # noqa: E402

if __name__ == "__main__":
    main(began_s=began_s)
