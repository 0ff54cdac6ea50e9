"""Write an imported scene as kapture: mambaloc export-scene SCENE --out FOLDER."""

from pathlib import Path

from mambaloc.console import OptionParser, exit_on_input_error
from mambaloc.importing.as_kapture import write_kapture


@exit_on_input_error
def main() -> None:
    """Write it, and say how many frames each split has."""
    parser = OptionParser(description=__doc__)
    parser.add_argument("scene", type=Path, help="folder that mambaloc import made")
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="the folder to create")
    args = parser.parse_args()
    counts, unused = write_kapture(args.scene, args.out)
    for name, count in counts.items():
        print(f"{args.out / name}: {count} frames")
    if unused:
        print(f"left out: {unused} frames that the scene marks as unused")
