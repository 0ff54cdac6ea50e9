"""Localise pictures: python tools/localize.py MODEL VIDEO_OR_FOLDER_OR_CAMERA [--out poses.tum] [--threads N]."""

import argparse
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track

from mambaloc.console import exits_cleanly
from mambaloc.errors import InputError
from mambaloc.runtime import Localiser, frames_of, write_tum


@exits_cleanly
def main() -> None:
    """Localise every frame and write a trajectory; Ctrl-C ends a camera's."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", help="an exported model, or a bundle's folder")
    parser.add_argument("source", help="a video, a picture, a folder of pictures, or a camera's number")
    parser.add_argument("--out", type=Path, default=Path("poses.tum"), help="trajectory to write, TUM format")
    parser.add_argument("--threads", type=int, help="that one image may use")
    args = parser.parse_args()
    localiser = Localiser(args.model, args.threads)
    (frames, count), found = frames_of(args.source), []
    try:
        for frame in track(frames, "Localising", count, console=Console(stderr=True), transient=True):
            found.append((frame.time_s, localiser.localise(frame.image)))
    except KeyboardInterrupt:
        pass  # what was localised is written
    if not found:
        raise InputError(f"{args.source}: holds no frame; give another video")
    times, poses = zip(*found, strict=True)
    write_tum(args.out, times, np.stack([p.position_m for p in poses]), np.stack([p.quaternion for p in poses]))
    latency_ms = 1000 * np.median([p.latency_s for p in poses])
    print(f"{args.out}: {len(poses)} poses, median {latency_ms:.1f} ms a frame")


if __name__ == "__main__":
    main()
