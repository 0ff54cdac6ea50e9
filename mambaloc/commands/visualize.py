"""Draw the paper's figures: mambaloc visualize KIND CHECKPOINT... [--out FOLDER] [--data.KEY VALUE ...]."""

from pathlib import Path

from mambaloc.cli import OneLineErrorParser
from mambaloc.console import configure_logging, exit_on_input_error
from mambaloc.data import MultiSceneDataModule, build_data
from mambaloc.errors import InputError
from mambaloc.evaluation.figures import FIGURES, draw_figures
from mambaloc.evaluation.trained import Trained, load_trained
from mambaloc.models import Checkpoint


@exit_on_input_error
def main(argv: list[str] | None = None) -> None:
    """Draw trained systems on the test frames of their recipes, changed where an option says so."""
    configure_logging()
    parser = OneLineErrorParser(description=__doc__)
    parser.add_argument("kind", choices=list(FIGURES), help="trajectory: a figure per system; others: one figure")
    parser.add_argument("checkpoints", type=Path, nargs="+", metavar="CHECKPOINT")
    parser.add_argument("--out", type=Path, help="folder for the figures (default: RUN/figures/EPOCH of the first)")
    parser.add_argument("--frames", type=int, default=3, help="number of test frames to show, evenly spaced")
    parser.add_function_arguments(build_data, "data")
    args = parser.parse_args(argv, defaults=False)
    trained = [_trained(parser, argv, path) for path in args.checkpoints]
    first = args.checkpoints[0]
    out = args.get("out") or first.parent.parent / "figures" / first.stem
    for path in draw_figures(args.kind, trained, out, args.get("frames", 3)):
        print(path)


def _trained(parser: OneLineErrorParser, argv: list[str] | None, path: Path) -> Trained:
    """Load a checkpoint with its own recipe's data under the options that were given."""
    checkpoint = Checkpoint.read(path)
    parser.set_defaults({f"data.{name}": value for name, value in checkpoint.data().hparams.items()})
    data = build_data(**parser.parse_args(argv).data)
    if isinstance(data, MultiSceneDataModule):
        raise InputError(f"{path}: has several scenes. Use mambaloc evaluate, which draws a figure for each.")
    return load_trained(checkpoint, data)
