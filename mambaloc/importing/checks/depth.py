"""Focal length and turns of a capture by its depth: matches lifted out of one image and projected into the other.

In matches alone, a focal length that is too long and turns that are too small look alike. Depth says where a match must
lie in the other image, not only on which line.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mambaloc.data.depth_frames import NO_DEPTH_MM, read_complete_png, read_depth_mm
from mambaloc.errors import InputError
from mambaloc.importing.capture import Capture, Depth
from mambaloc.importing.checks.epipolar import pair_distances
from mambaloc.importing.checks.matching import Matches

Floats = NDArray[np.floating[Any]]

SCALES = np.round(np.arange(0.80, 1.2001, 0.005), 4)
"""Focal lengths and turns that are tried, over those of the capture."""

_TURNED_DEG = (4.0, 20.0)  # less says little, and more is often matched wrongly
_MIN_MATCHES = 100


@dataclass(frozen=True)
class ByDepth:
    """How far matches lie from where depth and poses put them, were the longer side of
    the images 640 pixels.

    Shape:
        ``focal_px`` and ``turn_px``: medians at each of :data:`SCALES`, of the focal length with the turns as they are,
        and of the turns with the focal length as it is.

    Args:
        matches: that have a depth.
        pairs: of images.
    """

    focal_px: Floats
    turn_px: Floats
    matches: int
    pairs: int

    @property
    def focal(self) -> float:
        """The best focal length, over that of the capture."""
        return float(SCALES[self.focal_px.argmin()])

    @property
    def turn(self) -> float:
        """The best turns, over those of the poses."""
        return float(SCALES[self.turn_px.argmin()])

    @property
    def given_px(self) -> float:
        """The median with focal length and turns as they are."""
        return float(self.focal_px[np.abs(SCALES - 1).argmin()])


def by_depth(capture: Capture, matches: Matches) -> ByDepth | None:
    """Try focal lengths and turns on matches that have a depth; None where there are too few.

    Args:
        capture: whose depth, where it has some, is of images without distortion.
        matches: between its images.

    Raises:
        InputError: for a depth frame that is damaged.
    """
    if capture.depth is None:
        return None
    turn_deg = pair_distances(matches, capture.world_from_cam)[1]
    pairs = np.flatnonzero((turn_deg >= _TURNED_DEG[0]) & (turn_deg <= _TURNED_DEG[1]))
    chosen = matches.of_pairs(pairs)
    depth = depth_of_matches(capture.depth, chosen)
    has_depth = np.isfinite(depth)
    if has_depth.sum() < _MIN_MATCHES:
        return None

    def median_px(focal: float, turn: float) -> float:
        px = _off_px(capture.world_from_cam, chosen, depth, focal, turn)
        return float(np.median(px[has_depth]))

    return ByDepth(
        np.array([median_px(focal, 1.0) for focal in SCALES]),
        np.array([median_px(1.0, turn) for turn in SCALES]),
        int(has_depth.sum()),
        int((chosen.per_pair(has_depth) > 0).sum()),
    )


def depth_of_matches(depth: Depth, matches: Matches) -> Floats:
    """Depths of matches in their first images, in the capture's unit, (M,); NaN where none was measured.

    Raises:
        InputError: for a depth frame that is damaged.
    """
    found = np.full(len(matches.pair), np.nan)
    first = matches.pairs[matches.pair, 0]
    for row in np.unique(first).tolist():
        found[first == row] = sampled(depth, row, matches.first[first == row])
    return found


def sampled(depth: Depth, row: int, rays: Floats) -> Floats:
    """What an image's depth frame measured along rays (M, 2), in the capture's unit, (M,); NaN where nothing to trust.

    Raises:
        InputError: where it, or its confidence, is damaged.
    """
    if (file := depth.files[row]) is None:
        return np.full(len(rays), np.nan)
    steps = read_depth_mm(file)
    if depth.confidence and (sure := depth.confidence[row]) is not None:
        steps = np.where(_confidence(sure, steps.shape) == 0, 0, steps)
    pixels = np.rint(rays @ depth.intrinsics[:2, :2].T + depth.intrinsics[:2, 2]).astype(int)
    is_inside = np.all((pixels >= 0) & (pixels < steps.shape[::-1]), axis=1)
    x, y = np.where(is_inside[:, None], pixels, 0).T
    is_measured = is_inside & np.isin(steps[y, x], NO_DEPTH_MM, invert=True)
    return np.where(is_measured, depth.step * steps[y, x], np.nan)


def _confidence(path: Path, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """Confidence of each pixel of a depth frame, (H, W).

    Raises:
        InputError: where it is not a whole PNG of 8 bits and that shape.
    """
    found = read_complete_png(path)
    if found is None or found.dtype != np.uint8 or found.shape != shape:
        raise InputError(
            f"{path}: is not a complete 8-bit PNG of one channel and the size of its depth frame, "
            f"{shape[1]}x{shape[0]}. "
            "Copy the recording again, or remove the file to trust all of that frame's depth."
        )
    return found


def _off_px(world_from_cam: Floats, matches: Matches, depth: Floats, focal: float, turn: float) -> Floats:
    """How far lifted matches project from where they are seen, (M,); infinite behind the camera."""
    first, second = world_from_cam[matches.pairs.T]
    first_from_second = np.linalg.inv(first) @ second
    turned = [cv2.Rodrigues(turn * cv2.Rodrigues(rotation)[0])[0] for rotation in first_from_second[:, :3, :3]]
    lifted = np.hstack((matches.first / focal, np.ones((len(depth), 1)))) * depth[:, None]
    moved = lifted - first_from_second[matches.pair, :3, 3]
    cam = np.einsum("mji,mj->mi", np.array(turned)[matches.pair], moved)
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.linalg.norm(focal * cam[:, :2] / cam[:, 2:] - matches.second, axis=1)
    return np.where(cam[:, 2] > 0, off * matches.focal_px[matches.pair], np.inf)
