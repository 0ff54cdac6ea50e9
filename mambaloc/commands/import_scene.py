"""Make a scene of any capture: mambaloc import SOURCE --out SCENE [--format KIND]."""

import shlex
import sys
from pathlib import Path

from mambaloc.console import OptionParser, exit_on_input_error
from mambaloc.errors import InputError
from mambaloc.importing.formats.ros_bag import BagTopics
from mambaloc.importing.importer import import_scene
from mambaloc.importing.registry import FORMATS
from mambaloc.importing.report import print_summary
from mambaloc.importing.splits.selection import ASKED


@exit_on_input_error
def main() -> None:
    """Import, and say what was found."""
    parser = OptionParser(
        description=__doc__, epilog="; ".join(f"{name}: {each.looks_like}" for name, each in FORMATS.items())
    )
    parser.add_argument("source", type=Path, help="the capture: a folder, or the file that lists its poses")
    parser.add_argument("--out", type=Path, required=True, metavar="SCENE", help="the folder to create")
    parser.add_argument("--format", metavar="KIND", help=f"of {', '.join(FORMATS)}; detected by default")
    parser.add_argument(
        "--images", type=Path, metavar="FOLDER", help="folder of the capture's images, if they are elsewhere"
    )
    parser.add_argument("--topic", metavar="NAME", help="topic of a ROS bag's images, if it has several")
    parser.add_argument("--pose-topic", metavar="NAME", help="topic of a ROS bag's poses, or /tf, if it has several")
    parser.add_argument("--pose-frame", metavar="FRAME", help="frame of a ROS bag's poses, if they do not name it")
    parser.add_argument(
        "--metres-per-unit", type=float, metavar="X", help="the capture's unit in metres, if it is known"
    )
    parser.add_argument(
        "--split", default="auto", choices=ASKED, help="how to choose test frames (default: the best measured split)"
    )
    parser.add_argument("--adjust-poses", action="store_true", help="also write poses that fit the images better")
    args = parser.parse_args()
    topics = BagTopics(args.topic, args.pose_topic, args.pose_frame)
    is_script = sys.argv[0].endswith(".py")
    command = shlex.join([*(["python", sys.argv[0]] if is_script else ["mambaloc", "import"]), *sys.argv[1:]])
    imported = import_scene(
        args.source,
        args.out,
        args.format,
        args.metres_per_unit,
        args.split,
        command,
        args.adjust_poses,
        args.images,
        None if topics == BagTopics() else topics,
    )
    print_summary(imported, args.out)
    if not imported.verdict.is_usable:
        raise InputError(f"{args.out}: {imported.verdict}; see report.md there, and repair the capture")
