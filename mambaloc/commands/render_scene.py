"""Render a scene: the embedded room, or a room along a dataset's true poses.

mambaloc render OUT [--poses poses.csv --scene heads --layout 7scenes] [--size 320x240] [--limit N]
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from mambaloc import rendering
from mambaloc.console import OptionParser, exit_on_input_error, whole_number
from mambaloc.errors import InputError


@exit_on_input_error
def main() -> None:
    """Read the command line and render."""
    parser = OptionParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, metavar="OUT", help="folder in which the scene's folder is made")
    parser.add_argument(
        "--poses", type=Path, help="CSV with columns scene,split,image,x,y,z,qw,qx,qy,qz (default: the embedded room)"
    )
    parser.add_argument("--scene", help="which scene of the CSV")
    parser.add_argument("--layout", choices=["7scenes", "cambridge"], help="layout of the files (default: 7scenes)")
    parser.add_argument("--size", help="WIDTHxHEIGHT of the images (default: 320x240)")
    parser.add_argument("--limit", type=whole_number(1), help="at most so many frames of each split, evenly spaced")
    parser.add_argument("--seed", type=whole_number(0), help="seed of the room")
    args = parser.parse_args()
    if args.poses is None:
        given = [name for name in ("scene", "layout", "size", "limit", "seed") if getattr(args, name) is not None]
        if given:
            raise InputError(f"--{given[0]}: needs --poses, since the embedded room is always the same. Give both.")
        print(rendering.ensure_embedded_scene(args.out))
        return
    if args.scene is None:
        raise InputError("--poses: has several scenes; choose one with --scene")
    layout: Literal["7scenes", "cambridge"] = args.layout or "7scenes"
    size = rendering.parse_size(args.size or "320x240")
    shots = rendering.read_pose_table(args.poses, args.scene, layout)
    shots = rendering.thinned(shots, len(shots) if args.limit is None else args.limit)
    write = rendering.write_7scenes if layout == "7scenes" else rendering.write_cambridge
    print(write(args.out, args.scene, shots, size=size, seed=args.seed or 0))
