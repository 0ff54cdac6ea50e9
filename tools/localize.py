"""Localise pictures: python tools/localize.py [MODEL] VIDEO_OR_FOLDER_OR_CAMERA [--filter causal|smooth]."""

import argparse
from pathlib import Path

from mambaloc.console import exits_cleanly, thread_count
from mambaloc.runtime import Localiser
from mambaloc.runtime.video import FILTERS, follow


@exits_cleanly
def main() -> None:
    """Localise every frame and write a trajectory; Ctrl-C ends a camera's."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "model", nargs="?", help="exported model, bundle or ARCH.TAG; unless given, the embedded room's"
    )
    parser.add_argument("source", help="a video, a picture, a folder of pictures (30 a second), or a camera's number")
    parser.add_argument("--out", type=Path, default=Path("poses.tum"), help="trajectory to write, TUM format")
    parser.add_argument("--filter", choices=FILTERS, help="steady a video's poses: from those before, or from all")
    parser.add_argument("--threads", type=thread_count, help="that one image may use")
    args = parser.parse_args()
    localiser = Localiser(_model(args.model), args.threads)
    done = follow(localiser, args.source, args.out, args.filter)
    poses = f"{done.count} poses" + (f" ({done.outliers} outliers)" if args.filter else "")
    print(f"{args.out}: {poses} in {localiser.contract.scene}, median {done.latency_ms:.1f} ms a frame")
    if done.radii:
        metres, degrees = done.radii
        print(f"nine of ten within {metres:.2g} m and {degrees:.2g}°; {done.unfamiliar} do not look like the place")


def _model(name: str | None) -> Path:
    if name is not None and (Path(name).exists() or Path(name).suffix in (".onnx", ".ort")):
        return Path(name)
    from mambaloc.zoo.bundles import EMBEDDED, released_bundle  # needs torch, which an exported model does not

    return released_bundle(EMBEDDED if name is None else name)


if __name__ == "__main__":
    main()
