"""Detection: each format is taken for itself, a stranger for none."""

from __future__ import annotations

from pathlib import Path

import pytest

from mambaloc.importing.registry import FORMATS, read_capture

MATRIX = "1 0 0 2 0 1 0 3 0 0 1 4 0 0 0 1"
FILES = {
    "record3d": ["metadata", "rgbd/0.jpg", "rgbd/0.depth"],
    "polycam": ["keyframes/cameras/1.json", "keyframes/images/1.jpg", "mesh_info.json", "polycam.mp4"],
    "stray_scanner": [
        "rgb.mp4",
        "odometry.csv",
        "camera_matrix.csv",
        "imu.csv",
        "depth/000000.png",
        "confidence/000000.png",
    ],
    "euroc": [
        "mav0/cam0/data.csv",
        "mav0/cam0/sensor.yaml",
        "mav0/cam0/data/1.png",
        "mav0/imu0/data.csv",
        "mav0/state_groundtruth_estimate0/data.csv",
    ],
    "tum_rgbd": ["rgb.txt", "depth.txt", "groundtruth.txt", "accelerometer.txt", "rgb/1.2.png"],
    "kitti": ["poses/00.txt", "sequences/00/image_2/000000.png", "sequences/00/calib.txt"],
    "7scenes": ["TrainSplit.txt", "TestSplit.txt", "seq-01/frame-000000.color.png", "seq-01/frame-000000.pose.txt"],
    "scannet": ["color/0.jpg", "pose/0.txt", "depth/0.png", "intrinsic/intrinsic_color.txt"],
    "replica": ["traj.txt", "results/frame000000.jpg", "results/depth000000.png"],
    "colmap": ["sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin", "images/a.jpg"],
    "csv": ["poses.csv", "images/a.jpg"],
    "tum": ["images/1.2.jpg", "trajectory.txt"],
    "kitti_poses": ["images/1.jpg", "poses.txt"],
    "structure_from_motion": ["a.jpg", "b.jpg", "notes.txt"],
}
WRITTEN = {
    "map_free": {
        "seq1/1.jpg": "",
        "poses.txt": "# name qw qx qy qz tx ty tz\nseq1/1.jpg 1 0 0 0 0 0 0\nseq1/2.jpg 0 0 0 0 0 0 0\n",
        "poses_device.txt": "seq1/1.jpg 1 0 0 0 0 0 0\nseq1/2.jpg 1 0 0 0 1 0 0\n",
        "intrinsics.txt": "seq1/1.jpg 5 5 3 2 6 4\n",
    },
    "kapture": {
        "mapping/sensors/sensors.txt": "# kapture format: 1.1\n",
        "mapping/sensors/records_camera.txt": "",
        "mapping/sensors/trajectories.txt": "",
        "mapping/sensors/records_data/a.jpg": "",
    },
    "realityscan": {
        "photos/1.jpg": "",
        "any.csv": "#cameras 1\n#name,x,y,alt,yaw,pitch,roll,f_35mm,px_norm\n1.jpg,0,0,0,0,0,0,30,0\n",
    },
    "metashape": {"photos/1.jpg": "", "export.xml": '<?xml version="1.0"?>\n<document version="2">\n<chunk></chunk>'},
    "ros_bag": {"metadata.yaml": "rosbag2_bagfile_information:\n  version: 5\n", "drive_0.db3": "", "a.jpg": ""},
    "pose_lines": {"images/1.jpg": "", "images/2.jpg": "", "any.log": f"{MATRIX}\n{MATRIX}\n"},
    "pose_files": {"1.color.png": "", "1.pose.txt": MATRIX, "seq-02/1.color.png": "", "seq-02/1.pose.txt": MATRIX},
    "tum": {"images/1.2.jpg": "", "path.txt": "1 0 0 0 0 0 0 1\n2 0 0 0 0 0 1 0\n"},
    "kitti_poses": {"images/1.jpg": "", "path.txt": "1 0 0 0 0 1 0 0 0 0 1 0\n" * 2},
    "structure_from_motion": {
        "1.jpg": "",
        "1.xml": "<annotation><object/></annotation>",
        "1.txt": "0 0.5 0.5 0.1 0.1\n",
        "intrinsics.txt": "500 0 320 0 500 240 0 0 1\n",
    },
}
"""Files by what is in them: no name tells these formats."""
ALSO = [
    ("record3d", ["metadata.json", "rgb/0.png"]),
    ("polycam", ["corrected_cameras/1.json", "corrected_images/1.jpg"]),
    ("euroc", ["cam0/data.csv", "cam0/sensor.yaml", "mocap0/data.csv", "imu0/data.csv"]),
    ("scannet", ["frames/color/0.jpg", "frames/pose/0.txt"]),
    ("colmap", ["cameras.txt", "images.txt", "points3D.txt"]),
    ("colmap", ["sparse/images.txt", "images/a.jpg"]),
    ("tum", ["1.2.jpg", "run.tum"]),
    ("kitti_poses", ["1.jpg", "run.kitti"]),
    ("structure_from_motion", ["images/a.jpg"]),
]


def make(folder: Path, files: list[str]) -> Path:
    for name in files:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return folder


def detected(source: Path) -> str | None:
    return next((name for name, known in FORMATS.items() if known.matches(source)), None)


@pytest.mark.parametrize(("kind", "files"), [*FILES.items(), *ALSO])
def test_each_format_is_taken_for_itself(tmp_path, kind, files):
    assert detected(make(tmp_path, files)) == kind


@pytest.mark.parametrize(("kind", "files"), WRITTEN.items())
def test_formats_are_told_by_their_lines(tmp_path, kind, files):
    make(tmp_path, list(files))
    for name, content in files.items():
        (tmp_path / name).write_text(content)
    assert detected(tmp_path) == kind


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("csv", "a.csv"),
        ("tum", "a.tum"),
        ("kitti_poses", "a.kitti"),
        ("record3d", "a.r3d"),
        ("ros_bag", "a.bag"),
        ("ros_bag", "a.mcap"),
        ("structure_from_motion", "a.MP4"),
    ],
)
def test_files_are_told_by_their_suffix(tmp_path, kind, name):
    assert detected(make(tmp_path, [name]) / name) == kind


@pytest.mark.parametrize(
    "files", [[], ["readme.txt"], ["a.pdf"], ["sparse/0/readme"], ["data/a.jpg"], ["poses/00.txt"], ["color/0.jpg"]]
)
def test_a_stranger_is_taken_for_none(tmp_path, refused, files):
    assert detected(make(tmp_path, files)) is None
    refused(read_capture, tmp_path, "the format is not recognized")


def test_a_folder_of_videos_is_told_that_an_import_takes_one(tmp_path, refused):
    (tmp_path / "one.mp4").touch(), (tmp_path / "two.MOV").touch()
    refused(read_capture, tmp_path, "holds videos, and an import takes one")


def test_every_format_is_tried_here():
    others = {
        "csv_world_from_cam",
        "csv_cam_from_world",
        "pose_lines_world_from_cam",
        "pose_lines_cam_from_world",
        "pose_files_cam_from_world",
        "nerfstudio",
    }  # asked for by name; tested in a file of its own
    assert set(FILES) | set(WRITTEN) == set(FORMATS) - others
