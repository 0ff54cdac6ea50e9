"""Train a recipe: python tools/train.py RECIPE.yaml [OVERLAY.yaml ...] [--key value ...]."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy: on a map's small matrices threads only wait

from mambaloc.cli import main

if __name__ == "__main__":
    main()
