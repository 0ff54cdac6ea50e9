"""Measure a checkpoint: mambaloc evaluate CHECKPOINT [--out FOLDER] [--data.KEY VALUE ...]."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy: on a map's small matrices threads only wait

from pathlib import Path

from mambaloc.cli import OneLineErrorParser
from mambaloc.console import configure_logging, exit_on_input_error
from mambaloc.data import MultiSceneDataModule, build_data
from mambaloc.errors import InputError
from mambaloc.evaluation import (
    evaluate_checkpoint,
    evaluate_scenes,
    measure_map,
    measure_map_of_run,
    print_scenes,
    print_table,
)
from mambaloc.models import Checkpoint

_FILES = ("metrics.json", "predictions.csv", "predictions.tum", "ground_truth.tum", "trajectory.png")
_FILES_WITH_MAP = ("predictions_both.csv", "predictions_both.tum")


@exit_on_input_error
def main(argv: list[str] | None = None) -> None:
    """Evaluate on the data of the training recipe, changed where an option says so."""
    configure_logging()
    parser = OneLineErrorParser(description=__doc__)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--out", type=Path, help="folder for the results (default: next to the checkpoint)")
    parser.add_argument("--accelerator", default="auto", help="an accelerator of Lightning's Trainer")
    parser.add_argument(
        "--retrieval", action="store_true", help="also measure image retrieval with the backbone's initial weights"
    )
    parser.add_argument("--map", type=Path, metavar="FILE", help="also measure this map (default: the run's)")
    parser.add_argument(
        "--rerun", type=Path, metavar="FILE.rrd", help="also record frames and poses for Rerun's viewer"
    )
    parser.add_function_arguments(build_data, "data")
    path = parser.parse_args(argv, defaults=False).checkpoint
    if path is None:
        raise InputError("a checkpoint is missing: mambaloc evaluate RUN/checkpoints/best.ckpt")
    checkpoint = Checkpoint.read(path)
    parser.set_defaults({f"data.{name}": value for name, value in checkpoint.data().hparams.items()})
    args = parser.parse_args(argv)
    run = path.parent.parent
    out = args.out or run / "evaluation" / path.stem
    data = build_data(**args.data)
    if isinstance(data, MultiSceneDataModule):
        for option in ("map", "rerun"):
            if given := args[option]:
                raise InputError(f"--{option} {given}: is of one scene, and this network knows several. Leave it out.")
        print_scenes(evaluate_scenes(checkpoint, out, data, args.accelerator, args.retrieval))
        print(f"{out}: a folder per scene, each with {', '.join(_FILES)}")
        return
    beside = measure_map(args.map, data) if args.map else measure_map_of_run(run, data)
    measured = evaluate_checkpoint(checkpoint, out, data, args.accelerator, args.retrieval, beside, args.rerun)
    print_table([measured])
    print(f"{out}: {', '.join([*_FILES, *(_FILES_WITH_MAP if beside else ())])}")
    if args.rerun is not None:
        print(f"{args.rerun}: open it with rerun {args.rerun}")
