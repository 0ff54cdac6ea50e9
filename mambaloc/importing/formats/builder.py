"""Build a capture from what a format says of its images: poses and cameras are validated, and each image used once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mambaloc.data.datasets.capture import MAX_FRAMES
from mambaloc.data.frames import ROTATION_TOLERANCE, UNIT_TOLERANCE
from mambaloc.errors import InputError
from mambaloc.images import LARGEST_SIDE_PX
from mambaloc.importing.capture import Camera, Capture, Depth, Unit
from mambaloc.runtime.rotations import is_rotation, matrix_from_quaternion, quaternion_from_matrix, rigid_transforms

Matrices = NDArray[np.float64]

SHORTEST, LONGEST = 0.5 - 1e-3, 2.0 + 1e-3
"""Lengths of quaternions that are made units, and their rounding."""
_ROUNDED = 1e-6  # of a rotation's entries
_NONE_LISTED = "a split of its own that names none of the frames that have a pose and an image"


@dataclass(frozen=True)
class Pose:
    """A pose (4, 4) as a format has it, and why its image is left out; empty where it is not."""

    world_from_cam: Matrices
    fault: str = ""


@dataclass(frozen=True)
class Posed:
    """One image and what a format says of it; the fields are those of :class:`Capture`."""

    image: Path
    sequence: str
    pose: Pose
    camera: str | None = None
    time_s: float | None = None
    split: str | None = None
    depth: Path | None = None
    confidence: Path | None = None


@dataclass(frozen=True)
class Checked:
    """Poses that a file has, checked: ``checked[row]``, ``checked @ matrix`` and ``checked.inverse()``.

    Args:
        poses: (N, 4, 4); NaN where a pose is a mark of no fix or is left out.
        faults: why poses are left out, by row.
        choices: how many rotations were made exact, and the largest repair, where it was more than rounding.
    """

    poses: Matrices
    faults: Mapping[int, str]
    choices: Mapping[str, str]

    def __getitem__(self, row: int) -> Pose:
        return Pose(self.poses[row], self.faults.get(row, ""))

    def __matmul__(self, matrix: Matrices) -> Checked:
        return replace(self, poses=self.poses @ matrix)

    def inverse(self) -> Checked:
        """The transforms the other way; NaN stays NaN."""
        return replace(self, poses=np.linalg.inv(self.poses).astype(np.float64))


def build_capture(
    kind: str,
    source: Path,
    posed: Sequence[Posed],
    *,
    unit: Unit,
    choices: Mapping[str, str],
    cameras: Mapping[str, Camera] | None = None,
    missing: Sequence[str] = (),
    beside: Iterable[Path] = (),
    left_out: Mapping[Path, str] | None = None,
    depth_camera: Matrices | None = None,
    split_concern: str = "",
    metres_per_unit: float | None = None,
) -> Capture:
    """Make a capture: sequence after sequence, in the order of their first images.

    Args:
        kind: the format.
        source: for messages.
        posed: images, all there, each sequence in order.
        unit: of positions, unless the source says it.
        choices: what was decided, by name.
        cameras: by name.
        missing: images that the format names and that are not there.
        beside: images that are there, of which some may be among ``posed``.
        left_out: why images are left out that the format marks as bad.
        depth_camera: (3, 3), in pixels of depth frames, which are in millimetres.
        split_concern: as of :class:`Capture`.
        metres_per_unit: as of :class:`Capture`.

    Raises:
        InputError: for no image, one with two poses, or more than a scene may have.
    """
    marked = {**(left_out or {}), **{each.image: each.pose.fault for each in posed if each.pose.fault}}
    if marked and all(each.pose.fault for each in posed):
        image, rule = next(iter(marked.items()))
        raise InputError(
            f"{source}: all {len(marked)} images with a pose are left out, such as {image.name}: {rule}; correct them"
        )
    if not posed:
        named = f"; {len(missing)} are named and missing, such as {missing[0]!r}" if missing else ""
        raise InputError(f"{source}: has no image with a pose{named}; add them")
    if len(posed) > MAX_FRAMES:
        raise InputError(f"{source}: lists {len(posed)} frames, more than {MAX_FRAMES}; keep fewer")
    used: set[Path] = set()
    for each in posed:
        if each.image in used:
            raise InputError(f"{source}: gives {each.image} more than one pose; remove all but one")
        used.add(each.image)
    posed = [each for each in posed if not each.pose.fault]
    known = {*used, *marked}
    rank = {name: at for at, name in enumerate(dict.fromkeys(each.sequence for each in posed))}
    ordered = sorted(posed, key=lambda each: rank[each.sequence])
    depth, confidence = tuple(each.depth for each in ordered), tuple(each.confidence for each in ordered)
    cameras_of = [each.camera for each in ordered if each.camera is not None]
    times = [each.time_s for each in ordered if each.time_s is not None]
    splits = [each.split for each in ordered if each.split is not None]
    return Capture(
        kind=kind,
        images=tuple(each.image for each in ordered),
        sequences=tuple(each.sequence for each in ordered),
        world_from_cam=np.stack([each.pose.world_from_cam for each in ordered]),
        unit=unit if metres_per_unit is None else "metre" if metres_per_unit == 1 else "unknown",
        metres_per_unit=metres_per_unit,
        choices=dict(choices),
        cameras=dict(cameras or {}),
        camera_of=tuple(cameras_of) if len(cameras_of) == len(ordered) else None,
        time_s=np.array(times) if len(times) == len(ordered) else None,
        split=tuple(splits) if len(splits) == len(ordered) and set(splits) != {"unused"} else None,
        poses_without_image=tuple(missing),
        images_without_pose=tuple(image for image in dict.fromkeys(beside) if image not in known),
        left_out={str(image): rule for image, rule in marked.items()},
        depth=None if depth_camera is None else Depth(depth, depth_camera, confidence=confidence),
        split_concern=split_concern or (_NONE_LISTED if splits and set(splits) == {"unused"} else ""),
    )


def validate_se3(matrices: Matrices, where: Callable[[int], str]) -> Checked:
    """Check transforms, and make rotations that were rounded in a text exact.

    Args:
        matrices: (N, 3, 4) or (N, 4, 4).
        where: names a row, for messages.

    Returns:
        The poses; a mark of no fix is NaN, infinite, one number throughout, or a rotation of zeros.

    Raises:
        InputError: where none is a rigid transform, and not all are marks.
    """
    lost = is_mark(matrices[:, :3].reshape(-1, 12), matrices[:, :3, :3].reshape(-1, 9))
    matrices = np.where(lost[:, None, None], np.eye(4)[: matrices.shape[1]], matrices)
    rotation, position = matrices[:, :3, :3], matrices[:, :3, 3]
    rules = {"the pose's rotation is not orthonormal": np.asarray(~is_rotation(rotation, ROTATION_TOLERANCE))}
    if matrices.shape[1] == 4:
        is_last = np.isclose(matrices[:, 3], (0, 0, 0, 1), rtol=0, atol=1e-6).all(axis=1)
        rules["the pose's last row is not 0 0 0 1"] = np.asarray(~is_last)
    faults, usable = _faults(rules, lost, where)
    exact = matrix_from_quaternion(quaternion_from_matrix(np.where(usable[:, None, None], rotation, np.eye(3))))
    off = np.where(usable, np.abs(exact - rotation).max(axis=(1, 2)), 0.0)
    poses = np.where(usable[:, None, None], rigid_transforms(exact, position), np.nan)
    return Checked(poses, faults, _repaired("rotations", "orthonormal", off, _ROUNDED, where))


def from_quaternions(position: Matrices, quaternion: Matrices, where: Callable[[int], str]) -> Checked:
    """Check transforms of positions and quaternions.

    Args:
        position: (N, 3).
        quaternion: (N, 4), wxyz; those that are half to twice as long as a unit are made so.
        where: names a row, for messages.

    Returns:
        The poses; a mark of no fix is NaN, infinite, one number throughout, or a quaternion of zeros.

    Raises:
        InputError: where none has a quaternion of about unit length, and not all are marks.
    """
    lost = is_mark(np.concatenate((position, quaternion), axis=1), quaternion)
    quaternion = np.where(lost[:, None], (1.0, 0.0, 0.0, 0.0), quaternion)
    with np.errstate(over="ignore"):
        norm = np.linalg.norm(quaternion, axis=1)
    is_bad = ~((norm >= SHORTEST) & (norm <= LONGEST))
    faults, usable = _faults({"the quaternion is far from unit length": is_bad}, lost, where)
    rotation = matrix_from_quaternion(np.where(usable[:, None], quaternion, (1.0, 0.0, 0.0, 0.0)))
    poses = np.where(usable[:, None, None], rigid_transforms(rotation, position), np.nan)
    off = np.where(usable, np.abs(norm - 1), 0.0)
    return Checked(poses, faults, _repaired("quaternions", "of unit length", off, UNIT_TOLERANCE, where))


def _faults(
    rules: Mapping[str, NDArray[np.bool_]], lost: NDArray[np.bool_], where: Callable[[int], str]
) -> tuple[dict[int, str], NDArray[np.bool_]]:
    """The first rule that rows break, with where they are; and which rows have a pose.

    Raises:
        InputError: where all rows that are not marks break one.
    """
    usable: NDArray[np.bool_] = ~lost
    faults: dict[int, str] = {}
    for rule, is_bad in rules.items():
        faults |= {row: f"{rule} ({where(row)})" for row in np.flatnonzero(usable & is_bad).tolist()}
        usable = np.asarray(usable & ~is_bad)
    if faults and not usable.any():
        row = min(faults)
        raise InputError(f"{where(row)}: {faults[row].partition(' (')[0]}; correct or remove it")
    return faults, usable


def _repaired(name: str, what: str, off: Matrices, tolerance: float, where: Callable[[int], str]) -> dict[str, str]:
    """How many rotations were made exact, and the largest repair; nothing where none is more than rounding."""
    count, worst = int((off > tolerance).sum()), int(off.argmax()) if len(off) else 0
    if not count:
        return {}
    return {name: f"{count} of {len(off)} were not {what}, and made so; at most {off[worst]:.2g} off ({where(worst)})"}


def pinhole(size: Sequence[float], focal: Sequence[float], center: Sequence[float], where: str | Path) -> Camera:
    """Check a pinhole camera; the centre of the top-left pixel is (0, 0).

    Args:
        size: width and height.
        focal: along x and y.
        centre: principal point.
        where: the file, for messages.

    Raises:
        InputError: for an invalid size, or impossible lens parameters.
    """
    width, height = size
    is_size = all(1 <= side <= LARGEST_SIDE_PX and side == int(side) for side in size)
    if not is_size or not all(np.isfinite([*focal, *center])) or min(focal) <= 0:
        raise InputError(
            f"{where}: a camera must have a size and finite, positive focal lengths, and at most {LARGEST_SIDE_PX} "
            "pixels a side; export it again"
        )
    if not (abs(center[0] - width / 2) <= width / 4 and abs(center[1] - height / 2) <= height / 4):
        raise InputError(
            f"{where}: principal point {center[0]:.0f}, {center[1]:.0f} is far from the centre of images of "
            f"{width:.0f}x{height:.0f}; give the intrinsics of these images, not of others' size"
        )
    return Camera(int(width), int(height), (float(focal[0]), float(focal[1])), (float(center[0]), float(center[1])))


def is_mark(poses: Matrices, rotations: Matrices) -> NDArray[np.bool_]:
    """Which rows (N, K) loggers and trackers write where they have no pose; of these the numbers of rotations."""
    is_constant = (poses == poses[:, :1]).all(axis=1)
    return ~np.isfinite(poses).all(axis=1) | is_constant | (rotations == 0).all(axis=1)
