"""Train a recipe: python tools/train.py RECIPE.yaml [OVERLAY.yaml ...] [--key value ...]."""

from mambaloc.cli import main

if __name__ == "__main__":
    main()
