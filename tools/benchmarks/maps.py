"""Compare a network, a sparse map, and both together under disturbances; our map with pycolmap's own route; and
calibrate the rule by which a map's pose is accepted.

python tools/benchmarks/maps.py robustness RECIPE|SCENE [--checkpoint CHECKPOINT] [--frames N] [--width PX]
python tools/benchmarks/maps.py colmap RECIPE|SCENE [--frames N] [--width PX]
python tools/benchmarks/maps.py report FOLDER ... --out IMAGE
python tools/benchmarks/maps.py acceptance RECIPE|SCENE [--frames N] [--width PX] --out FOLDER
python tools/benchmarks/maps.py calibrate FOLDER ...
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from maps_report import by_disturbance, draw, overview, read_results

from mambaloc.console import OptionParser, configure_logging, exit_on_input_error, whole_number
from mambaloc.mapping.recipe import recipe_of


@exit_on_input_error
def main() -> None:
    """Measure, print and write."""
    configure_logging()
    parser = OptionParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    names = ("robustness", "colmap", "acceptance", "report", "calibrate")
    robustness, colmap, acceptance, report, calibration = map(commands.add_parser, names)
    for command in (robustness, colmap, acceptance):
        command.add_argument("source", type=Path, metavar="RECIPE|SCENE", help="as tools/map.py takes it")
        command.add_argument("--frames", type=whole_number(2), help="key frames; the recipe's unless given")
        command.add_argument(
            "--width", type=whole_number(32), help="of the images in which keypoints are searched, in pixels"
        )
        command.add_argument("--seeds", type=whole_number(0), nargs="+", help="of RANSAC; the recipe's unless given")
        command.add_argument("--out", type=Path, help="folder to write to")
    for command in (robustness, colmap):
        command.add_argument(
            "--hold-out", metavar="SEQUENCE", help="of the training frames: measure on it, not on test"
        )
    acceptance.add_argument("--queries", type=whole_number(1), default=20, help="frames of each sequence held out")
    robustness.add_argument("--checkpoint", type=Path, help="of a network trained on the same scene")
    robustness.add_argument("--training-cpu-s", type=float, help="CPU seconds that its training took, for the tables")
    robustness.add_argument("--unit", default="m", help="of the scene's positions, for the figure")
    report.add_argument("folders", nargs="+", type=Path, help="that robustness wrote")
    calibration.add_argument("folders", nargs="+", type=Path, help="that acceptance wrote")
    report.add_argument("--out", type=Path, required=True, help="image to draw, a PNG")
    args = parser.parse_args()
    if args.command == "report":
        results = read_results(args.folders)
        draw(results, args.out)
        print(overview(results), *map(by_disturbance, results), sep="\n")
        return
    if args.command == "calibrate":
        from maps_acceptance import calibrate

        print(calibrate(args.folders))
        return
    recipe = recipe_of(args.source)
    given = {"key_frames": args.frames, "width": args.width}
    settings = replace(recipe.settings, **{key: value for key, value in given.items() if value is not None})
    recipe = replace(recipe, settings=settings, ransac_seeds=tuple(args.seeds or recipe.ransac_seeds))
    out = args.out or Path("runs", args.command, f"{args.source.resolve().stem}_{settings.key_frames}")
    if args.command == "robustness":
        from maps_scenes import measure_robustness

        print(measure_robustness(recipe, args.checkpoint, args.training_cpu_s, args.hold_out, args.unit, out))
    elif args.command == "acceptance":
        from maps_acceptance import collect_evidence

        collect_evidence(recipe, args.queries, out)
    else:
        from maps_beside import measure_beside_colmap

        print(measure_beside_colmap(recipe, args.hold_out, out))


if __name__ == "__main__":
    main()
