"""Poses over HTTP: mambaloc serve [BUNDLE ...] [--port 8000] [--workers N] [--host ADDRESS --token-file FILE]."""

import os
from pathlib import Path

from mambaloc.console import OptionParser, exit_on_input_error, whole_number
from mambaloc.errors import InputError


@exit_on_input_error
def main() -> None:
    """Serve bundles until Ctrl-C."""
    parser = OptionParser(description=__doc__)
    parser.add_argument(
        "bundles", nargs="*", type=Path, metavar="BUNDLE", help="bundles to serve (default: the embedded room's)"
    )
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on; any but localhost needs a token")
    parser.add_argument("--port", type=whole_number(0, 65535), default=8000, help="0 chooses a free port")
    parser.add_argument(
        "--workers", type=whole_number(1, 256), default=os.cpu_count(), help="number of worker processes"
    )
    parser.add_argument("--token-file", type=Path, help="file of the token that requests must carry")
    parser.add_argument("--megabytes", type=whole_number(1, 1024), default=32, help="largest body of a request")
    parser.add_argument(
        "--distorted",
        action="store_true",
        help="images are distorted, as the training camera stores them, unless a request has distorted=false",
    )
    args = parser.parse_args()
    try:
        from mambaloc.serving import Limits, serve_bundles
    except ModuleNotFoundError as error:
        raise InputError(f"mambaloc serve: needs {error.name}. Install it: pip install 'mambaloc[serve]'") from None
    token = None if args.token_file is None else _token(args.token_file)
    limits = Limits(body_bytes=args.megabytes * 2**20, is_distorted=args.distorted)
    serve_bundles(_by_name(args.bundles or [_released_bundle()]), args.host, args.port, args.workers, limits, token)


def _by_name(paths: list[Path]) -> dict[str, Path]:
    """Bundles by their folders' names; a run's ``bundle`` by the run's."""
    named: dict[str, Path] = {}
    for path in paths:
        whole = path.resolve()
        name = whole.parent.name if whole.name == "bundle" else whole.name
        if name in named:
            raise InputError(f"{path}: has the same name, {name}, as {named[name]}. Rename one of the folders.")
        named[name] = path
    return named


def _token(path: Path) -> str:
    try:
        token = path.read_text().strip()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"--token-file {path}: cannot be read ({error}). Give a file of one line.") from None
    if len(token) < 16 or not token.isascii() or not token.isprintable():
        raise InputError(
            f"--token-file {path}: is not a token of 16 characters or more. Make one: openssl rand -hex 32"
        )
    return token


def _released_bundle() -> Path:
    from mambaloc.zoo.bundles import released_bundle  # needs torch, which a bundle that is there does not

    return released_bundle()
