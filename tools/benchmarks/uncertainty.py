"""Compare estimates of a pose's uncertainty on the test frames of trained systems of one scene.

python tools/benchmarks/uncertainty.py CHECKPOINT ... [--elsewhere FOLDER] [--out FOLDER]
"""

from pathlib import Path

from uncertainty_methods import measure_certainty
from uncertainty_report import print_certainty, write_certainty

from mambaloc import provenance
from mambaloc.console import OptionParser, configure_logging, exit_on_input_error
from mambaloc.zoo.bundles import load_with_scene


@exit_on_input_error
def main() -> None:
    """Measure, print and write."""
    configure_logging()
    parser = OptionParser(description=__doc__)
    parser.add_argument("checkpoints", nargs="+", help="of one scene; several are also taken for an ensemble")
    parser.add_argument("--elsewhere", type=Path, help="folder of images of another place")
    parser.add_argument("--out", type=Path, default=Path("runs/uncertainty"), help="folder of the plot and the figures")
    args = parser.parse_args()
    systems = {checkpoint: load_with_scene(checkpoint) for checkpoint in args.checkpoints}
    found = measure_certainty(systems, args.elsewhere)
    print_certainty(found, provenance.machine())
    write_certainty(found, args.out, provenance.machine())
    print(f"{args.out}: uncertainty.json, uncertainty.png")


if __name__ == "__main__":
    main()
