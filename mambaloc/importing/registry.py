"""Which formats there are, and which one a source is in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from mambaloc.bags.reading import is_bag
from mambaloc.errors import InputError
from mambaloc.importing.capture import Capture
from mambaloc.importing.formats import (
    arkit,
    colmap,
    csv_table,
    euroc,
    kapture,
    kitti,
    map_free,
    metashape,
    nerfstudio,
    pose_files,
    pose_folders,
    pose_lines,
    realityscan,
    ros_bag,
    seven_scenes,
    stray_scanner,
    tum,
)
from mambaloc.importing.formats.ros_bag import BagTopics
from mambaloc.importing.sfm import structure
from mambaloc.importing.video import VIDEO_SUFFIXES


@dataclass(frozen=True)
class Format:
    """A kind of capture.

    Args:
        looks_like: what a person sees, for messages.
        matches: whether a source is in it, by the names of its files, and by their lines where names are ambiguous.
        read: read it; raises :class:`InputError` that names the file, the rule and the remedy.
        names_images: whether the format names its images by their paths, so that ``read`` takes a folder to find them.
    """

    looks_like: str
    matches: Callable[[Path], bool]
    read: Callable[..., Capture]
    names_images: bool = False


def _by_name_alone(source: Path) -> bool:
    """Never: a format that cannot be detected is asked for with ``--format``."""
    return False


FORMATS: dict[str, Format] = {
    "ros_bag": Format("a .bag of ROS 1; the folder, .mcap or .db3 of a ROS 2 bag", is_bag, ros_bag.read_ros_bag),
    "nerfstudio": Format("transforms.json of nerfstudio or instant-ngp", nerfstudio.matches, nerfstudio.read, True),
    "record3d": Format("metadata and rgbd/ of Record3D", arkit.is_record3d, arkit.read_record3d),
    "polycam": Format("keyframes/cameras/ and images/ of Polycam", arkit.is_polycam, arkit.read_polycam),
    "stray_scanner": Format(
        "rgb.mp4, odometry.csv and camera_matrix.csv of Stray Scanner",
        stray_scanner.is_stray_scanner,
        stray_scanner.read_stray_scanner,
    ),
    "euroc": Format("mav0/cam0 and mav0/state_groundtruth_estimate0 of EuRoC", euroc.is_euroc, euroc.read_euroc, True),
    "kapture": Format(
        "sensors/ with sensors.txt, records_camera.txt and trajectories.txt of kapture",
        kapture.is_kapture,
        kapture.read_kapture,
        True,
    ),
    "tum_rgbd": Format("rgb.txt and groundtruth.txt", tum.is_tum_rgbd, tum.read_tum_rgbd, True),
    "kitti": Format("poses/ and sequences/", kitti.is_kitti, kitti.read_kitti),
    "7scenes": Format(
        "TrainSplit.txt, TestSplit.txt and seq-NN/ of 7-Scenes",
        seven_scenes.is_seven_scenes,
        seven_scenes.read_seven_scenes,
    ),
    "map_free": Format(
        "poses.txt and intrinsics.txt of Map-free, with an image's name in each line",
        map_free.is_map_free,
        map_free.read_map_free,
        True,
    ),
    "scannet": Format("color/ and pose/", pose_folders.is_scannet, pose_folders.read_scannet),
    "replica": Format("traj.txt and results/", pose_folders.is_replica, pose_folders.read_replica),
    "colmap": Format("cameras, images and points3D", colmap.is_colmap, colmap.read_colmap, True),
    "metashape": Format(
        "cameras.xml, exported by Agisoft Metashape", metashape.is_metashape, metashape.read_metashape, True
    ),
    "realityscan": Format(
        "a .csv with columns name,x,y,alt,heading,pitch,roll,f of RealityScan or RealityCapture",
        realityscan.is_realityscan,
        realityscan.read_realityscan,
        True,
    ),
    "csv": Format("a .csv with columns image,x,y,z,qw,qx,qy,qz", csv_table.is_csv, csv_table.read_csv, True),
    "csv_world_from_cam": Format(
        "the same", _by_name_alone, partial(csv_table.read_csv, direction="world_from_cam"), True
    ),
    "csv_cam_from_world": Format(
        "the same", _by_name_alone, partial(csv_table.read_csv, direction="cam_from_world"), True
    ),
    "tum": Format("a .tum or trajectory.txt beside images", tum.is_tum, tum.read_tum),
    "kitti_poses": Format("a .kitti or poses.txt beside images", kitti.is_kitti_poses, kitti.read_kitti_poses),
    "pose_lines": Format(
        "lines of a 4x4 matrix, or of an image's name and a pose, beside images",
        pose_lines.is_pose_lines,
        pose_lines.read_pose_lines,
        True,
    ),
    "pose_lines_world_from_cam": Format(
        "the same", _by_name_alone, partial(pose_lines.read_pose_lines, direction="world_from_cam"), True
    ),
    "pose_lines_cam_from_world": Format(
        "the same", _by_name_alone, partial(pose_lines.read_pose_lines, direction="cam_from_world"), True
    ),
    "pose_files": Format(
        "a pose file beside each image, as in a sequence of 7-Scenes",
        pose_files.is_pose_files,
        pose_files.read_pose_files,
    ),
    "pose_files_cam_from_world": Format(
        "the same", _by_name_alone, partial(pose_files.read_pose_files, direction="cam_from_world")
    ),
    "structure_from_motion": Format("a video or images alone", structure.is_video_or_images, structure.read_structure),
}
"""By name, the most specific first: the first that matches a source is taken."""


def read_capture(
    source: Path, kind: str | None = None, images: Path | None = None, topics: BagTopics | None = None
) -> Capture:
    """Read a capture, in the format that its files look like unless one is named.

    Args:
        source: the capture.
        kind: of :data:`FORMATS`.
        images: the folder of its images; found unless given.
        topics: what to read of a ROS bag.

    Raises:
        InputError: where there is no such source or format, or it cannot be read.
    """
    if not source.exists():
        raise InputError(f"{source}: no such file or folder; give a capture")
    if kind is not None and kind not in FORMATS:
        raise InputError(f"unknown --format {kind}; choose one of {', '.join(FORMATS)}")
    kind = kind or next((name for name, known in FORMATS.items() if known.matches(source)), None)
    if kind is None and source.is_dir() and any(each.suffix.lower() in VIDEO_SUFFIXES for each in source.iterdir()):
        raise InputError(f"{source}: holds videos, and an import takes one. Give one of them, or join them into one.")
    if kind is None:
        known = "; ".join(f"{name}: {each.looks_like}" for name, each in FORMATS.items())
        raise InputError(f"{source}: the format is not recognized ({known}). Give --format.")
    if topics is not None:
        if kind != "ros_bag":
            raise InputError(f"{source}: is not a ROS bag but {kind}, which has no topics. Omit --topic and --pose-*.")
        return ros_bag.read_ros_bag(source, topics)
    if images is None:
        return FORMATS[kind].read(source)
    if not FORMATS[kind].names_images:
        able = ", ".join(name for name, each in FORMATS.items() if each.names_images)
        raise InputError(
            f"--images {images}: {kind} has its images in the capture. Leave it out. It is for formats that give "
            f"paths of images ({able})."
        )
    if not images.is_dir():
        raise InputError(f"--images {images}: no such folder. Give the folder of the capture's images.")
    return FORMATS[kind].read(source, images=images)
