"""Get a public dataset from its official address: ``mambaloc download 7scenes heads``."""

from pathlib import Path

from mambaloc.console import OptionParser, exit_on_input_error
from mambaloc.data.download import describe_sources, download


@exit_on_input_error
def main() -> None:
    """Read the arguments, list or download."""
    parser = OptionParser(description=__doc__)
    parser.add_argument("dataset", nargs="?", help="7scenes or cambridge; omit it to list what can be downloaded")
    parser.add_argument("scene", nargs="?", help="a scene's name, or all")
    parser.add_argument("--root", type=Path, help="folder that holds the scenes (default: data/<dataset>)")
    parser.add_argument("--list", action="store_true", help="list datasets, licences, scenes and sizes")
    parser.add_argument("--keep-archive", action="store_true", help="keep the zip next to the scene")
    parser.add_argument("--accept-changed", action="store_true", help="accept an archive with another size or checksum")
    args = parser.parse_args()
    if args.list or args.dataset is None:
        print(describe_sources())
        return
    try:
        download(
            args.dataset, args.scene, args.root, keep_archive=args.keep_archive, accept_changed=args.accept_changed
        )
    except KeyboardInterrupt:
        raise SystemExit("interrupted: run the same command again to resume") from None
