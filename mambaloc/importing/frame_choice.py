"""Which frames of a video are worth posing: the sharpest of each stretch in which the view has moved enough.

Sharpness is the variance of the Laplacian (Pech-Pacheco et al. 2000), movement the median displacement of points that
are tracked from the last chosen frame (Lucas-Kanade, kept where tracking back returns).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mambaloc.images import Image, resized
from mambaloc.runtime.sources import SourceFrame

Grey = NDArray[np.uint8]

NEAR, FAR = 0.025, 0.05
"""A frame may be chosen once points have moved by ``NEAR`` of its width, and one is before they have by ``FAR``."""

_SIDE_PX = 240  # frames are compared at this size: what a hand's shake blurs, shows
_POINTS = 300
_MIN_TRACKED = 0.3
_RETURNS_PX = 1.0


@dataclass(frozen=True)
class _Candidate:
    frame: SourceFrame
    grey: Grey
    sharpness: float


def choose_frames(frames: Iterable[SourceFrame]) -> Iterator[SourceFrame]:
    """Choose frames of a video, in its order, holding one at a time.

    The first stretch begins with the video and is half as long; the last one ends with it.
    """
    reference: Reference | None = None
    near, far = 0.0, FAR - NEAR
    best: _Candidate | None = None
    for frame in frames:
        grey = small_grey(frame.image)
        if reference is None:
            reference = Reference(grey)
        moved = reference.displacement(grey)
        here = _Candidate(frame, grey, sharpness(grey)) if moved >= near else None
        if moved > far:
            chosen = best or here
            if chosen is not None:
                yield chosen.frame
                reference, near, far = Reference(chosen.grey), NEAR, FAR
                best = here if chosen is not here and reference.displacement(grey) >= near else None
        elif here is not None and (best is None or here.sharpness > best.sharpness):
            best = here
    if best is not None:
        yield best.frame


def small_grey(image: Image) -> Grey:
    """An image at the size at which frames are compared."""
    return np.asarray(cv2.cvtColor(resized(image, min(_SIDE_PX, *image.shape[:2])), cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def sharpness(grey: Grey) -> float:
    """Variance of the Laplacian."""
    return float(cv2.Laplacian(grey, cv2.CV_64F).var())


class Reference:
    """An image that others are compared with.

    Args:
        grey: at the size at which frames are compared.
    """

    def __init__(self, grey: Grey) -> None:
        self.grey = grey
        self.points: Any = cv2.goodFeaturesToTrack(grey, _POINTS, 0.01, 5)

    def displacement(self, other: Grey) -> float:
        """How far points have moved in another image, in widths: their median; infinite where most are lost."""
        if self.grey.shape != other.shape:
            return float("inf")
        if self.points is None:  # nothing to see, as in the dark
            return 0.0
        moved, is_found, _ = cv2.calcOpticalFlowPyrLK(self.grey, other, self.points, None)  # type: ignore[call-overload]
        back, is_back, _ = cv2.calcOpticalFlowPyrLK(other, self.grey, moved, None)  # type: ignore[call-overload]
        returns = np.linalg.norm(back - self.points, axis=2)[:, 0] < _RETURNS_PX
        kept = (is_found[:, 0] == 1) & (is_back[:, 0] == 1) & returns
        if kept.mean() < _MIN_TRACKED:
            return float("inf")
        return float(np.median(np.linalg.norm(moved - self.points, axis=2)[kept, 0])) / self.grey.shape[1]
