"""Measure a checkpoint: mambaloc evaluate CHECKPOINT [--out FOLDER] [--data.KEY VALUE ...]."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy: on a map's small matrices threads only wait

from pathlib import Path

from mambaloc.cli import OneLineErrorParser
from mambaloc.console import exits_cleanly, quieten
from mambaloc.data import PoseDataModule
from mambaloc.errors import InputError
from mambaloc.evaluation import evaluate_checkpoint, measure_map, measure_map_of_run, print_table
from mambaloc.models import Checkpoint


@exits_cleanly
def main(argv: list[str] | None = None) -> None:
    """Evaluate on the data of the training recipe, changed where an option says so."""
    quieten()
    parser = OneLineErrorParser(description=__doc__)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--out", type=Path, help="folder of the result; beside the checkpoint unless given")
    parser.add_argument("--accelerator", default="auto", help="as Lightning's Trainer takes it")
    parser.add_argument(
        "--retrieval", action="store_true", help="also measure retrieval on the backbone's first features"
    )
    parser.add_argument(
        "--map", type=Path, metavar="FILE", help="measure it beside the network; the run's unless given"
    )
    parser.add_argument(
        "--rerun", type=Path, metavar="FILE.rrd", help="also record frames and poses for Rerun's viewer"
    )
    parser.add_class_arguments(PoseDataModule, "data")
    path = parser.parse_args(argv, defaults=False).checkpoint
    if path is None:
        raise InputError("evaluate.py needs a checkpoint: evaluate.py RUN/checkpoints/best.ckpt")
    checkpoint = Checkpoint.read(path)
    parser.set_defaults({f"data.{name}": value for name, value in checkpoint.data().hparams.items()})
    args = parser.parse_args(argv)
    run = path.parent.parent
    out = args.out or run / "evaluation" / path.stem
    data = PoseDataModule(**args.data)
    beside = measure_map(args.map, data) if args.map else measure_map_of_run(run, data)
    measured = evaluate_checkpoint(checkpoint, out, data, args.accelerator, args.retrieval, beside, args.rerun)
    print_table([measured])
    both = ", predictions_both.csv, predictions_both.tum" if beside else ""
    print(f"{out}: metrics.json, predictions.csv, predictions.tum{both}, trajectory.png")
    if args.rerun is not None:
        print(f"{args.rerun}: open it with rerun {args.rerun}")
