"""Build a sparse map and measure it; or grow one by new frames, and take them out again.

mambaloc map RECIPE.yaml|SCENE [--frames N] [--width PX] [--out FOLDER]
mambaloc map MAP --add FRAMES --out FOLDER [--name NAME] [--test RECIPE.yaml|SCENE]
mambaloc map MAP --remove NAME --out FOLDER
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy: on small matrices threads only wait for each other

import argparse
import time
from dataclasses import replace
from pathlib import Path

from mambaloc.console import OptionParser, configure_logging, exit_on_input_error, pinhole_matrix, whole_number
from mambaloc.errors import InputError
from mambaloc.mapping import MapSettings
from mambaloc.mapping.building import POINTS, describe_points
from mambaloc.mapping.evaluating import Making, build_and_measure, measure, measure_saved
from mambaloc.mapping.growing import add_frames, remove_session
from mambaloc.mapping.new_frames import read_new_frames
from mambaloc.mapping.posed import read_frames
from mambaloc.mapping.recipe import MINIMUM, recipe_of
from mambaloc.runtime.maps import MAP_FILE, MapLocalizer, SparseMap
from mambaloc.viz.coverage import write_coverage
from mambaloc.viz.matches import write_points


@exit_on_input_error
def main(argv: list[str] | None = None) -> None:
    """Write map.safetensors, coverage.png, and what the map does on test frames."""
    configure_logging()
    args = _parser().parse_args(argv)
    of_added = {"name": args.name, "intrinsics": args.intrinsics is not None, "distorted": args.distorted}
    if not args.add and any(of_added.values()):
        name = next(name for name, is_given in of_added.items() if is_given)
        raise InputError(f"--{name}: applies to --add alone. Leave it out.")
    if args.source.suffix == Path(MAP_FILE).suffix or (args.source / MAP_FILE).is_file():
        _change(args)
    else:
        _build(args)


def _build(args: argparse.Namespace) -> None:
    if args.add or args.remove or args.test:
        raise InputError(f"{args.source}: is not a map, so nothing can be added, removed or tested. Build it first.")
    recipe = recipe_of(args.source)
    given = {"key_frames": args.frames, "width": args.width, "points": args.points}
    settings = replace(recipe.settings, **{key: value for key, value in given.items() if value is not None})
    out = args.out or Path("runs", args.source.resolve().stem)
    measured = build_and_measure(replace(recipe, settings=settings), out)
    sparse_map = measured.sparse_map
    print(f"{out}: {MAP_FILE}, metrics.json, coverage.png, points.png", describe_points(sparse_map), sep="\n")
    if (cameras := measured.result["map"]["cameras"]) > 1:
        print(f"{cameras} cameras: their intrinsics are taken as given; a lens is fitted for a single camera only")
    print(write_coverage(sparse_map, out / "coverage.png"))
    write_points({"map": sparse_map}, measured.test, out / "points.png", sparse_map.scene)
    print(measured.describe())


def _change(args: argparse.Namespace) -> None:
    path = args.source / MAP_FILE if args.source.is_dir() else args.source
    before = after = SparseMap.load(path)
    if args.width or args.points:
        raise InputError(f"{path}: exists already. Leave out --{'width' if args.width else 'points'}.")
    if (args.add or args.remove) and args.out is None:
        raise InputError(f"{path}: would be overwritten. Give --out FOLDER, which may be {path.parent}.")
    out = args.out or path.parent
    recipe = recipe_of(args.test) if args.test else None
    test = read_frames(recipe, "test") if recipe else None
    frames, settings = [], {}
    if args.add:
        frames = read_new_frames(args.add, MapLocalizer(before), args.intrinsics, args.distorted)
        settings = {"key_frames": args.frames or MapSettings.key_frames, "most_bytes": MapSettings.most_bytes}
    cpu = time.process_time()
    if args.add:
        growth = add_frames(before, frames, args.name or args.add.absolute().stem, *settings.values())
        after = growth.sparse_map
        print(growth.describe(len(before)))
    elif args.remove:
        after = remove_session(before, args.remove)
        print(f"{len(before) - len(after)} points removed; {len(after)} are left")
    making = Making(len(frames), settings, time.process_time() - cpu)
    if after is not before:
        after.save(out / MAP_FILE)
    print(f"{out}: coverage.png", write_coverage(after, out / "coverage.png"), sep="\n")
    if recipe and test:
        maps = {"before": before, "after": after} if after is not before else {"map": before}
        write_points(maps, test, out / "points.png", after.scene)
        measured = measure_saved(path if after is before else out / MAP_FILE, recipe, test, making)
        if after is not before:
            print(f"before: {measure(before, test, recipe.ransac_seeds).describe()}")
            print(f"after: {measured.errors.describe()}")
        print(measured.describe())


def _parser() -> OptionParser:
    lines = (__doc__ or "").splitlines()
    parser = OptionParser(description=lines[0], epilog=" ".join(lines[2:]))
    parser.add_argument(
        "source", type=Path, metavar="RECIPE|SCENE|MAP", help="a YAML file, an imported scene's folder, or a map"
    )
    parser.add_argument(
        "--frames",
        type=whole_number(MINIMUM["key_frames"]),
        help="number of key frames among the training or added frames (default: 160)",
    )
    parser.add_argument(
        "--width",
        type=whole_number(MINIMUM["width"]),
        help="width in pixels at which keypoints are searched; narrower images keep their size",
    )
    parser.add_argument(
        "--points", choices=POINTS, help="triangulated: MambaLoc's own (default); colmap: of an imported COLMAP model"
    )
    parser.add_argument("--out", type=Path, help="folder to write to (default for a new map: runs/NAME)")
    change = parser.add_mutually_exclusive_group()
    change.add_argument(
        "--add", type=Path, metavar="FRAMES", help="a scene or recipe with poses, a folder of images, or a video"
    )
    change.add_argument("--remove", metavar="NAME", help="remove what was added under this name")
    parser.add_argument("--name", help="name of the added frames, for --remove (default: that of FRAMES)")
    cameras = parser.add_mutually_exclusive_group()
    cameras.add_argument(
        "--intrinsics",
        type=pinhole_matrix,
        metavar="FX,FY,CX,CY",
        help="intrinsics of the images to add (default: the map's)",
    )
    cameras.add_argument(
        "--distorted",
        action="store_true",
        help="images to add are as the map's camera stores them, and are undistorted by its lens",
    )
    parser.add_argument("--test", type=Path, metavar="RECIPE|SCENE", help="measure the map on its test frames")
    return parser
