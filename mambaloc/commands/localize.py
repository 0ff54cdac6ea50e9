"""Localize images: mambaloc localize [MODEL|MAP] VIDEO_OR_FOLDER_OR_CAMERA_OR_BAG [--filter causal|smooth]."""

from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from mambaloc.bags.images import BagImage
from mambaloc.bags.reading import is_bag
from mambaloc.bags.writing import TOPIC
from mambaloc.console import OptionParser, black_and_white, exit_on_input_error, pinhole_matrix, thread_count
from mambaloc.errors import InputError
from mambaloc.images import Image
from mambaloc.runtime import Localizer
from mambaloc.runtime.localization import Localization
from mambaloc.runtime.sources import SourceFrame
from mambaloc.runtime.video import FILTERS, VideoResult, localize_video
from mambaloc.viz.rerun_recording import RerunRecording, rerun_recording


@exit_on_input_error
def main() -> None:
    """Localize every frame and write a trajectory; Ctrl-C ends a camera's."""
    parser = OptionParser(description=__doc__)
    parser.add_argument(
        "model",
        nargs="?",
        metavar="MODEL|MAP",
        help="bundle, exported model, map.safetensors or ARCH.TAG (default: the embedded room's)",
    )
    parser.add_argument(
        "source", help="a video, an image, a folder of images (30 a second), a camera's number, or a ROS bag"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("poses.tum"),
        help="trajectory to write in TUM format; for a ROS bag another bag: FILE.bag for ROS 1, or a folder for ROS 2",
    )
    parser.add_argument(
        "--filter", choices=FILTERS, help="filter a video's poses: causal by earlier frames, smooth by all"
    )
    cameras = parser.add_mutually_exclusive_group()
    cameras.add_argument(
        "--intrinsics",
        type=pinhole_matrix,
        metavar="FX,FY,CX,CY",
        help="of the frames, in pixels (default: the training camera's)",
    )
    cameras.add_argument(
        "--distorted",
        action="store_true",
        help="frames are as the training camera stores them, and are undistorted by its lens",
    )
    parser.add_argument(
        "--counts",
        type=black_and_white,
        metavar="BLACK,WHITE",
        help="of 16-bit images, as the scene's report.md says; those that use all 16 bits need none",
    )
    maps = parser.add_mutually_exclusive_group()
    maps.add_argument(
        "--map",
        dest="sparse_map",
        default=True,
        metavar="FILE",
        help="map to use with the model (default: the bundle's)",
    )
    maps.add_argument("--no-map", dest="sparse_map", action="store_false", help="use the network alone")
    parser.add_argument("--topic", metavar="NAME", help="topic of a bag's images, if it has several")
    parser.add_argument(
        "--world-frame",
        metavar="FRAME",
        help="frame that a bag's poses are in (default: map; the scene, of a network that knows several)",
    )
    parser.add_argument("--pose-frame", metavar="FRAME", help="frame that a bag's poses are of (default: the camera's)")
    parser.add_argument(
        "--rerun", type=Path, metavar="FILE.rrd", help="also record frames and poses for Rerun's viewer"
    )
    parser.add_argument("--threads", type=thread_count, help="threads that the network may use for an image")
    args = parser.parse_args()
    localizer = Localizer(_model(args.model), args.threads, args.sparse_map)
    if not is_bag(Path(args.source)) and (args.topic or args.world_frame or args.pose_frame):
        raise InputError(f"{args.source}: is not a ROS bag. Omit --topic, --world-frame and --pose-frame.")
    with _recording(localizer, args.rerun) as recording:
        if is_bag(Path(args.source)):
            summary = _localize_bag(localizer, args, recording)
        else:
            done = _localize_frames(localizer, args, recording)
            summary = f"{', '.join(map(str, done.files))}: {done}"
    print(summary)
    if args.rerun is not None:
        print(f"{args.rerun}: open it with rerun {args.rerun}")


@contextmanager
def _recording(localizer: Localizer, path: Path | None) -> Iterator[RerunRecording | None]:
    if path is None:
        yield None
        return
    with rerun_recording(path, localizer.scene, localizer.world) as recording:
        if localizer.sparse_map is not None:
            recording.add_map(localizer.sparse_map)
        yield recording


def _localize_frames(localizer: Localizer, args: Namespace, recording: RerunRecording | None) -> VideoResult:
    def record(frame: SourceFrame, pose: Localization) -> None:
        image, matrix = frame.image, args.intrinsics
        if args.distorted:
            image, matrix = localizer.undistortion.apply(image, args.source)
        elif matrix is None:
            matrix = localizer.intrinsics_of((image.shape[1], image.shape[0]))
        assert recording is not None
        recording.add_frame(image, pose, frame.time_s, matrix)

    return localize_video(
        localizer,
        args.source,
        args.out,
        args.filter,
        args.intrinsics,
        args.counts,
        is_distorted=args.distorted,
        on_frame=None if recording is None else record,
    )


def _localize_bag(localizer: Localizer, args: Namespace, recording: RerunRecording | None) -> str:
    from mambaloc.bags.localizing import localize_bag  # only here: an extra
    from mambaloc.importing.formats.ros_bag import straightener

    if args.distorted:
        raise InputError("--distorted: a bag has its camera's distortion in CameraInfo. Leave it out.")
    if args.filter is not None:
        raise InputError(
            f"--filter {args.filter}: a bag's poses are not filtered, since a robot has its own filter. Leave it out."
        )
    if args.out.suffix == ".tum":
        raise InputError(f"--out {args.out}: a bag's poses go into a bag. Give --out FILE.bag, or a folder for ROS 2.")

    def record(bag_image: BagImage, image: Image, matrix: ArrayLike | None, pose: Localization) -> None:
        assert recording is not None
        own = localizer.intrinsics_of((image.shape[1], image.shape[0])) if matrix is None else matrix
        recording.add_frame(image, pose, np.datetime64(bag_image.ns, "ns"), own)

    summary = localize_bag(
        localizer,
        Path(args.source),
        args.out,
        straightener,
        args.topic,
        args.intrinsics,
        args.world_frame,
        args.pose_frame,
        on_image=None if recording is None else record,
    )
    return f"{args.out}: {TOPIC}, {summary}"


def _model(name: str | None) -> Path:
    if name is not None and (Path(name).exists() or Path(name).suffix in (".onnx", ".ort", ".safetensors")):
        return Path(name)
    from mambaloc.zoo.bundles import EMBEDDED, released_bundle  # needs torch, which an exported model does not

    return released_bundle(EMBEDDED if name is None else name)
