"""Build a sparse map and measure it: python tools/map.py RECIPE.yaml|SCENE [--frames N] [--width PX] [--out FOLDER]."""

import argparse
from dataclasses import replace
from pathlib import Path

from mambaloc.console import exits_cleanly, quieten
from mambaloc.errors import InputError
from mambaloc.mapping.evaluating import build_and_measure, describe
from mambaloc.mapping.recipe import MapRecipe, read_recipe


@exits_cleanly
def main(argv: list[str] | None = None) -> None:
    """Build from training frames, measure on test frames, write map.safetensors and metrics.json."""
    quieten()
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", type=Path, metavar="RECIPE|SCENE", help="a YAML file, or an imported scene's folder")
    parser.add_argument("--frames", type=int, help="key frames, of the training frames; the recipe's unless given")
    parser.add_argument("--width", type=int, help="of the pictures in which keypoints are searched, in pixels")
    parser.add_argument("--out", type=Path, help="folder to write to; runs/NAME unless given")
    args = parser.parse_args(argv)
    recipe = MapRecipe(str(args.source)) if args.source.is_dir() else read_recipe(args.source)
    for option, least, value in (("frames", 2, args.frames), ("width", 32, args.width)):
        if value is not None and value < least:
            raise InputError(f"--{option} {value}: is less than {least}. Give more.")
    given = {"key_frames": args.frames, "width": args.width}
    settings = replace(recipe.settings, **{key: value for key, value in given.items() if value is not None})
    out = args.out or Path("runs", args.source.resolve().stem)
    result = build_and_measure(replace(recipe, settings=settings), out)
    print(f"{out}: map.safetensors, metrics.json", describe(result), sep="\n")


if __name__ == "__main__":
    main()
