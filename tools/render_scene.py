"""Render a scene: the embedded room, or a room along a dataset's true poses.

python tools/render_scene.py OUT --scene heads --layout 7scenes --poses poses.csv [--size 320x240] [--limit N] [--seed 0]
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from mambaloc.data.rendering import ensure_embedded_scene, read_pose_table, thinned, write_7scenes, write_cambridge
from mambaloc.errors import exits_cleanly


def size(text: str) -> tuple[int, int]:
    """Parse ``WIDTHxHEIGHT``."""
    match = re.fullmatch(r"([1-9]\d{1,3})x([1-9]\d{1,3})", text)
    if not match:
        raise argparse.ArgumentTypeError(f"{text!r} is no WIDTHxHEIGHT in pixels, such as 320x240")
    return int(match[1]), int(match[2])


@exits_cleanly
def main() -> None:
    """Read the command line and render."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, metavar="OUT", help="folder in which the scene's folder is made")
    parser.add_argument("--poses", type=Path, help="CSV: scene,split,image,x,y,z,qw,qx,qy,qz; without it, the embedded room")
    parser.add_argument("--scene", help="which scene of the CSV")
    parser.add_argument("--layout", choices=["7scenes", "cambridge"], default="7scenes", help="default: 7scenes")
    parser.add_argument("--size", type=size, default=(320, 240), help="WIDTHxHEIGHT, default: 320x240")
    parser.add_argument("--limit", type=int, help="at most so many frames of each split, evenly spaced")
    parser.add_argument("--seed", type=int, default=0, help="another seed is another room")
    args = parser.parse_args()
    if args.poses is None:
        print(ensure_embedded_scene(args.out))
        return
    if args.scene is None or (args.limit is not None and args.limit < 1):
        parser.error("--poses needs --scene NAME, and --limit at least 1")
    shots = read_pose_table(args.poses, args.scene, args.layout)
    write = {"7scenes": write_7scenes, "cambridge": write_cambridge}[args.layout]
    print(write(args.out, args.scene, thinned(shots, args.limit or len(shots)), size=args.size, seed=args.seed))


if __name__ == "__main__":
    main()
