"""Render a scene: the embedded room, or a room along a dataset's true poses.

python tools/render_scene.py OUT [--poses poses.csv --scene heads --layout 7scenes] [--size 320x240] [--limit N]
"""

from __future__ import annotations

import argparse
from pathlib import Path

from mambaloc import rendering
from mambaloc.console import exits_cleanly
from mambaloc.errors import InputError


@exits_cleanly
def main() -> None:
    """Read the command line and render."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, metavar="OUT", help="folder in which the scene's folder is made")
    parser.add_argument("--poses", type=Path, help="CSV scene,split,image,x,y,z,qw,qx,qy,qz; else the embedded room")
    parser.add_argument("--scene", help="which scene of the CSV")
    parser.add_argument("--layout", choices=["7scenes", "cambridge"], default="7scenes")
    parser.add_argument("--size", default="320x240", help="WIDTHxHEIGHT of the pictures, default: 320x240")
    parser.add_argument("--limit", type=int, help="at most so many frames of each split, evenly spaced")
    parser.add_argument("--seed", type=int, default=0, help="another seed is another room")
    args = parser.parse_args()
    if args.poses is None:
        print(rendering.ensure_embedded_scene(args.out))
        return
    if args.scene is None:
        raise InputError("--poses: holds several scenes; choose one with --scene")
    shots = rendering.read_pose_table(args.poses, args.scene, args.layout)
    shots = rendering.thinned(shots, len(shots) if args.limit is None else args.limit)
    write = rendering.write_7scenes if args.layout == "7scenes" else rendering.write_cambridge
    print(write(args.out, args.scene, shots, size=rendering.parse_size(args.size), seed=args.seed))


if __name__ == "__main__":
    main()
