"""Localized frames as a recording for the Rerun viewer: images, frusta, poses, their radii, the truth, and a map.

Frames of reference are those of the rest of the package: the scene's frame in metres, ``world_from_cam``, and OpenCV's
camera axes (x right, y down, z forward), which Rerun calls RDF. Rerun's quaternions are xyzw, and its pixels begin at
their corners, where ours have their centres. Its positions are float32, so they are shown in the scene's frame and not
in its source's world, which may lie far from its origin.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mambaloc.errors import InputError
from mambaloc.files import atomic_file, writing
from mambaloc.images import CORNER_PX, Image
from mambaloc.runtime.localization import Localization
from mambaloc.runtime.maps import SparseMap
from mambaloc.runtime.rotations import quaternion_from_matrix, rotation_error_deg
from mambaloc.runtime.world import World

Floats = NDArray[np.floating[Any]]
Pose = tuple[ArrayLike, ArrayLike]
"""Position (3,) in metres, and quaternion (4,) wxyz."""

CAMERA, TRUTH, RADIUS, MAP = "world/camera", "world/truth", "world/radius", "world/map"
ESTIMATED_PATH, TRUE_PATH, PLOTS = "world/estimated_path", "world/true_path", "plots"
FRAME, TIME = "frame", "time"
"""The timelines: number of the frame, and when it was taken."""

_ESTIMATE_RGB, _TRUE_RGB, _RADIUS_RGBA, _MAP_RGB = (215, 48, 39), (26, 152, 80), (215, 48, 39, 70), (150, 150, 150)
_JPEG_QUALITY = 90
_FRUSTUM_M = 0.3
_CHI_SQUARED = 6.2514  # its quantile 0.9 for three dimensions: the ellipsoid that nine of ten poses are in


class RerunRecording:
    """A recording that is being written, frame after frame.

    Args:
        stream: Rerun's ``RecordingStream``.
        world: that poses are in; the recording is in the scene's frame.
    """

    def __init__(self, stream: Any, world: World) -> None:
        self._stream, self._world = stream, world
        self._count = 0
        self._estimated_m: list[Floats] = []
        self._true_m: list[Floats] = []

    def add_map(self, sparse_map: SparseMap) -> None:
        """Show the points of a map."""
        import rerun as rr

        points = rr.Points3D(sparse_map.points_m, colors=_MAP_RGB, radii=rr.Radius.ui_points(1.5))
        self._stream.log(MAP, points, static=True)

    def add_frame(
        self,
        image: Image,
        pose: Localization,
        taken: float | np.datetime64,
        intrinsics: ArrayLike | None = None,
        truth: Pose | None = None,
    ) -> None:
        """Add a frame and what was found of it; a frame without a pose shows its image alone.

        Args:
            image: RGB (H, W, 3) or grey (H, W), ``uint8``, without distortion.
            pose: what was found.
            taken: seconds since the first frame, or the time of day.
            intrinsics: (3, 3) in pixels of the image; where they are not known there is no frustum.
            truth: where the frame was taken, if that is known.
        """
        import rerun as rr

        self._stream.set_time(FRAME, sequence=self._count)
        if isinstance(taken, np.datetime64):
            self._stream.set_time(TIME, timestamp=taken)
        else:
            self._stream.set_time(TIME, duration=taken)
        self._count += 1
        size = image.shape[1], image.shape[0]
        if truth is not None:
            self._true_m.append(self._log_pose(TRUTH, truth, intrinsics, size, _TRUE_RGB))
        if pose.source is not None:
            found = pose.position_m, pose.quaternion
            self._estimated_m.append(self._log_pose(CAMERA, found, intrinsics, size, _ESTIMATE_RGB))
        else:  # the last one's pose and frustum end here; where a new pose comes at the same time, it would end, too
            self._stream.log(CAMERA, rr.Clear(recursive=True))
        self._stream.log(f"{CAMERA}/image", rr.EncodedImage(contents=_jpeg(image), media_type="image/jpeg"))
        self._log_radius(pose)
        for name, value in _numbers(pose, truth).items():
            self._stream.log(f"{PLOTS}/{name}", rr.Scalars(value))

    def finish(self) -> None:
        """Add both paths, which only the end knows."""
        import rerun as rr

        for entity, positions_m, color in (
            (ESTIMATED_PATH, self._estimated_m, _ESTIMATE_RGB),
            (TRUE_PATH, self._true_m, _TRUE_RGB),
        ):
            if positions_m:
                line = rr.LineStrips3D([np.stack(positions_m)], colors=color, radii=rr.Radius.ui_points(1.0))
                self._stream.log(entity, line, static=True)

    def _log_pose(
        self,
        entity: str,
        world_from_cam: Pose,
        intrinsics: ArrayLike | None,
        size: tuple[int, int],
        color: tuple[int, int, int],
    ) -> Floats:
        """Place a camera, and return its position (3,) in the scene's frame."""
        import rerun as rr

        position_m = self._scene_m(world_from_cam[0])
        w, x, y, z = np.asarray(world_from_cam[1], np.float64).tolist()
        self._stream.log(entity, rr.Transform3D(translation=position_m, quaternion=rr.Quaternion(xyzw=(x, y, z, w))))
        if intrinsics is not None:
            matrix = np.array(intrinsics, np.float64)
            matrix[:2, 2] += CORNER_PX
            pinhole = rr.Pinhole(
                image_from_camera=matrix,
                resolution=size,
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=_FRUSTUM_M,
                color=color,
            )
            self._stream.log(f"{entity}/image", pinhole)
        return position_m

    def _scene_m(self, position_m: ArrayLike) -> Floats:
        return np.asarray(position_m, np.float64) - self._world.offset_m

    def _log_radius(self, pose: Localization) -> None:
        """Nine of ten poses are inside: the covariance's ellipsoid, or a sphere."""
        import rerun as rr

        if pose.source is None or pose.position_radius_m is None:
            self._stream.log(RADIUS, rr.Clear(recursive=False))
            return
        half_m, axes = np.full(3, pose.position_radius_m), np.eye(3)
        if pose.covariance is not None:
            variances, axes = np.linalg.eigh(pose.covariance[:3, :3])
            half_m = np.sqrt(_CHI_SQUARED * np.maximum(variances, 0))
            axes = axes * np.sign(np.linalg.det(axes))  # a rotation, no reflection
        w, x, y, z = quaternion_from_matrix(axes).tolist()
        shape = rr.Ellipsoids3D(
            centers=[self._scene_m(pose.position_m)],
            half_sizes=[half_m],
            quaternions=[rr.Quaternion(xyzw=(x, y, z, w))],
            colors=_RADIUS_RGBA,
            fill_mode=rr.components.FillMode.Solid,
        )
        self._stream.log(RADIUS, shape)


def check_recording(path: Path) -> None:
    """Check that a recording can be written.

    Raises:
        InputError: without Rerun, for a name that does not end in ``.rrd``, or where there is no folder for it.
    """
    if path.suffix != ".rrd":
        raise InputError(f"--rerun {path}: is not the name of a recording. Give a file that ends in .rrd.")
    if path.is_dir() or not path.absolute().parent.is_dir():
        raise InputError(f"--rerun {path}: its folder does not exist. Make it, or choose another.")
    try:
        import rerun  # only here: an extra  # noqa: F401
    except ImportError:
        raise InputError(f"--rerun {path}: needs rerun-sdk. Run pip install 'mambaloc[rerun]'.") from None


@contextmanager
def rerun_recording(path: Path, scene: str, world: World | None = None) -> Iterator[RerunRecording]:
    """Make a recording, and give what frames are added to; it opens with a layout of its own.

    Args:
        path: ending in ``.rrd``. It is there whole once the block ends; an error leaves nothing.
        scene: name of the place.
        world: that poses are in; the scene's frame unless given.

    Raises:
        InputError: without Rerun, for another ending, or where it cannot be written.
    """
    check_recording(path)
    import rerun as rr

    with writing(path, "choose another file with --rerun"), atomic_file(path) as partial:
        partial.touch()  # Rerun's own error would not say why
        stream = rr.RecordingStream("mambaloc")
        stream.save(partial, default_blueprint=_layout())
        stream.send_recording_name(scene)
        recording = RerunRecording(stream, world or World())
        yield recording
        recording.finish()
        stream.flush()
        stream.disconnect()


def _numbers(pose: Localization, truth: Pose | None) -> dict[str, float]:
    """What is plotted: radii, and errors where the truth is known."""
    numbers = {
        "position_radius_m": pose.position_radius_m,
        "rotation_radius_deg": pose.rotation_radius_deg,
        "unfamiliarity": pose.unfamiliarity,
        "inliers": pose.inliers,
    }
    if pose.source is not None and truth is not None:
        numbers["position_error_m"] = float(np.linalg.norm(pose.position_m - np.asarray(truth[0])))
        numbers["rotation_error_deg"] = float(rotation_error_deg(pose.quaternion, truth[1]))
    return {name: float(value) for name, value in numbers.items() if value is not None}


def _layout() -> Any:
    """The scene on the left; the image and the numbers on the right."""
    import rerun.blueprint as rrb

    errors = [f"+ /{PLOTS}/{name}" for name in ("position_radius_m", "position_error_m")]
    turns = [f"+ /{PLOTS}/{name}" for name in ("rotation_radius_deg", "rotation_error_deg")]
    others = [f"+ /{PLOTS}/{name}" for name in ("inliers", "unfamiliarity")]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(origin="/world", name="Scene"),
            rrb.Vertical(
                rrb.Spatial2DView(origin=f"/{CAMERA}/image", name="Frame"),
                rrb.TimeSeriesView(origin=f"/{PLOTS}", contents=errors, name="Position [m]"),
                rrb.TimeSeriesView(origin=f"/{PLOTS}", contents=turns, name="Rotation [°]"),
                rrb.TimeSeriesView(origin=f"/{PLOTS}", contents=others, name="Inliers, unfamiliarity"),
                row_shares=[3, 1, 1, 1],
            ),
            column_shares=[2, 1],
        ),
        rrb.TimePanel(timeline=FRAME),
        collapse_panels=True,
    )


def _jpeg(image: Image) -> bytes:
    pixels: Any = image[..., ::-1] if image.ndim == 3 else image
    return cv2.imencode(".jpg", np.ascontiguousarray(pixels), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()
