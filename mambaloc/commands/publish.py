"""Release a model: mambaloc publish CHECKPOINT --tag TAG [--zoo zoo] [--half]."""

from pathlib import Path

from mambaloc.console import OptionParser, configure_logging, exit_on_input_error
from mambaloc.zoo.publishing import publish


@exit_on_input_error
def main() -> None:
    """Measure, write, read back, measure again."""
    configure_logging()
    parser = OptionParser(description=__doc__)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--tag", required=True, help="TAG of the released name ARCH.TAG")
    parser.add_argument("--zoo", type=Path, default=Path("zoo"), help="folder of released models")
    parser.add_argument("--half", action="store_true", help="write weights as float16, half the size")
    args = parser.parse_args()
    folder = publish(args.checkpoint, args.tag, args.zoo, half=args.half)
    print(f"{folder}: {', '.join(sorted(file.name for file in folder.iterdir()))}")
