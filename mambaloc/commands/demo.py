"""Localize in a browser: mambaloc demo [BUNDLE] [--port 8000] [--lan] [--video FILE] [--out FOLDER]."""

from pathlib import Path

from mambaloc.console import OptionParser, configure_logging, exit_on_input_error, whole_number
from mambaloc.demo import build_site, embedded_video, serve_page


@exit_on_input_error
def main() -> None:
    """Serve the page until Ctrl-C, or write it."""
    configure_logging()
    parser = OptionParser(description=__doc__)
    parser.add_argument(
        "bundle", nargs="?", type=Path, help="a bundle of mambaloc export (default: the embedded room's)"
    )
    parser.add_argument("--port", type=whole_number(0, 65535), default=8000, help="0 chooses a free port")
    parser.add_argument("--lan", action="store_true", help="serve the local network by HTTPS, for a phone's camera")
    parser.add_argument(
        "--video",
        "--film",
        type=Path,
        metavar="FILE",
        help="a video for the page to play (--film until the next release)",
    )
    parser.add_argument("--out", type=Path, help="write the page to this folder, for any web server, and exit")
    args = parser.parse_args()
    bundle = args.bundle or _released_bundle()
    video = args.video or (None if args.bundle else embedded_video())
    if args.out:
        print(f"wrote {build_site(bundle, args.out, video)}")
    else:
        serve_page(bundle, video, args.port, args.lan)


def _released_bundle() -> Path:
    from mambaloc.zoo.bundles import released_bundle  # needs torch, which a bundle that is there does not

    return released_bundle()
