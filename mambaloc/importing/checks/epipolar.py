"""Whether images and poses speak of the same cameras: matched points must lie on the lines that the poses draw.

No pose file says for sure in which direction its poses transform, nor which way its cameras look. Pairs of images do:
in the right convention nearly every match lies near its epipolar line, and in front of both cameras.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from mambaloc.images import Image, read_image
from mambaloc.importing.capture import OPENCV_FROM_OPENGL, Camera, Capture
from mambaloc.importing.motion import Motion, apart, quaternions

Floats = NDArray[np.float64]


def _inverse(pose: Floats) -> Floats:
    return np.linalg.inv(pose).astype(np.float64)


AS_READ = "as they were read"
CONVENTIONS: Mapping[str, Callable[[Floats], Floats]] = {
    AS_READ: lambda pose: pose,
    "world to camera": _inverse,
    "camera to world in OpenGL's axes": lambda pose: pose @ OPENCV_FROM_OPENGL,
    "world to camera in OpenGL's axes": lambda pose: _inverse(pose) @ OPENCV_FROM_OPENGL,
}
"""What makes ``world_from_cam`` in OpenCV's axes of a pose that was meant otherwise."""

_PAIRS = 16
_OFFSETS = (32, 24, 16, 12, 8, 6, 4, 3, 2, 1)  # frames from one of a pair to the other; far apart they tell more
_MOST_TURN_DEG = 15.0
_LEAST_MOVE = 0.01  # of the extent; turned on the spot, a camera draws no lines
_LONG_SIDE = 640
_FEATURES = 1500
_LOWE_RATIO = 0.75
_NEAR_PX = 2.0
_GUESSED_FOCAL = 0.85  # of the longer side, as a phone's


@dataclass(frozen=True)
class Agreement:
    """How many matches agree with the poses.

    Args:
        share: of the matches, by convention.
        matches: in all pairs.
        pairs: of images.
        is_guessed: the focal length was guessed, since none is told.
    """

    share: dict[str, float]
    matches: int
    pairs: int
    is_guessed: bool

    @property
    def best(self) -> str:
        """The convention that most matches agree with."""
        return max(self.share, key=self.share.__getitem__)


@dataclass(frozen=True)
class _View:
    """An image's features: rays (K, 2), what they look like (K, 128), and how wide a pixel of the image is in rays."""

    rays: Floats
    descriptors: NDArray[np.float32]
    pixel: float


def agreement(capture: Capture, motion: Motion) -> Agreement:
    """Match pairs of images, spread over the capture, and count what agrees with each convention.

    Args:
        capture: its images are those of pinholes, where it tells of cameras.
        motion: its.
    """
    pairs, agreeing, matches = _pairs(capture, motion), dict.fromkeys(CONVENTIONS, 0), 0
    for pair in track(pairs, "Comparing images with poses", console=Console(stderr=True), transient=True):
        first, second = (_view(read_image(capture.images[row]), _camera(capture, row)) for row in pair)
        rays = _matched(first, second)
        matches += len(rays[0])
        for name, meant in CONVENTIONS.items():
            poses = [meant(capture.world_from_cam[row]) for row in pair]
            second_from_first = np.linalg.inv(poses[1]) @ poses[0]
            agreeing[name] += int(agrees(second_from_first, *rays, _NEAR_PX * max(first.pixel, second.pixel)).sum())
    share = {name: count / max(1, matches) for name, count in agreeing.items()}
    return Agreement(share, matches, len(pairs), capture.camera_of is None)


def agrees(second_from_first: Floats, first: Floats, second: Floats, near: float) -> NDArray[np.bool_]:
    """Which matches lie near their epipolar line (Sampson's distance) and in front of both cameras, (M,).

    Args:
        second_from_first: transform between the cameras, (4, 4).
        first: rays in the first camera, (M, 2).
        second: in the second.
        near: the line, in rays.
    """
    rotation, shift = second_from_first[:3, :3], second_from_first[:3, 3]
    ones = np.ones((len(first), 1))
    start, end = np.hstack((first, ones)), np.hstack((second, ones))
    turned = start @ rotation.T
    lines, lines_back = np.cross(shift, turned), np.cross(end, shift) @ rotation
    slope = (lines[:, :2] ** 2).sum(1) + (lines_back[:, :2] ** 2).sum(1)
    is_near = (end * lines).sum(1) ** 2 <= near**2 * slope
    between = np.cross(turned, end)
    # Depths along both rays where they pass closest; unknown where the rays are parallel to a pixel.
    from_second = (between * np.cross(turned, shift)).sum(1)
    from_first = (between * np.cross(end, shift)).sum(1)
    is_parallel = np.linalg.norm(between, axis=1) <= near * np.linalg.norm(turned, axis=1) * np.linalg.norm(end, axis=1)
    return is_near & (slope > 0) & (is_parallel | ((from_second > 0) & (from_first > 0)))


def _pairs(capture: Capture, motion: Motion) -> list[tuple[int, int]]:
    """Frames that see much of the same from apart: the farthest of the next ones that is turned little."""
    position, quaternion, every = capture.world_from_cam[:, :3, 3], quaternions(capture), np.arange(len(capture.images))
    found = []
    for row in every[:: max(1, len(every) // (4 * _PAIRS))]:
        others = [row + offset for offset in _OFFSETS if row + offset < len(every)] if motion.in_order else every
        others = np.array(
            [other for other in others if capture.sequences[other] == capture.sequences[row]], dtype=np.int64
        )
        length, turn_deg = (each[0] for each in apart(position, quaternion, every[row : row + 1], others))
        fits = np.flatnonzero((turn_deg <= _MOST_TURN_DEG) & (length >= _LEAST_MOVE * motion.extent))
        if len(fits):
            place = fits[0] if motion.in_order else fits[length[fits].argmin()]
            found.append((int(row), int(others[place])))
    chosen = np.linspace(0, len(found) - 1, min(_PAIRS, len(found))).round().astype(int)
    return [found[place] for place in chosen]


def _camera(capture: Capture, row: int) -> Camera | None:
    return capture.cameras[capture.camera_of[row]] if capture.camera_of is not None else None


def _view(image: Image, camera: Camera | None) -> _View:
    height, width = image.shape[:2]
    if camera is None:
        focal_px = _GUESSED_FOCAL * max(height, width)
        camera = Camera(width, height, (focal_px, focal_px), ((width - 1) / 2, (height - 1) / 2))
    scale = min(1.0, _LONG_SIDE / max(height, width))
    small = cv2.resize(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    points, found = cv2.SIFT.create(_FEATURES).detectAndCompute(small, None)
    descriptors = np.empty((0, 128), np.float32) if found is None else np.asarray(found, dtype=np.float32)
    pixels = (np.array([point.pt for point in points], dtype=np.float64).reshape(-1, 2) + 0.5) / scale - 0.5
    return _View((pixels - camera.centre_px) / camera.focal_px, descriptors, 1 / (camera.focal_px[0] * scale))


def _matched(first: _View, second: _View) -> tuple[Floats, Floats]:
    """Rays of features that look like each other more than like any third, (M, 2) each."""
    if min(len(first.rays), len(second.rays)) < 2:
        return np.empty((0, 2)), np.empty((0, 2))
    nearest = cv2.BFMatcher().knnMatch(first.descriptors, second.descriptors, k=2)
    good = [best for best, next_best in nearest if best.distance < _LOWE_RATIO * next_best.distance]
    rows = np.array([(match.queryIdx, match.trainIdx) for match in good], dtype=np.int64).reshape(-1, 2)
    return first.rays[rows[:, 0]], second.rays[rows[:, 1]]
