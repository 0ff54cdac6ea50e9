"""Which way a capture's world and cameras are turned: measured, with how sure it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mambaloc.importing.capture import Capture
from mambaloc.importing.checks.findings import Finding

Floats = NDArray[np.float64]

_AXES = ("+x", "-x", "+y", "-y", "+z", "-z")
_UPRIGHT_DEG = 20.0
_COMMON = 0.5  # length of the mean of unit vectors that still have a direction in common
_ON_THEIR_SIDE = 0.2
_IN_FRONT = 0.9


@dataclass(frozen=True)
class Up:
    """Which way is up in the world, as far as cameras are held upright.

    Args:
        direction: mean of the cameras' up axes, unit, (3,); the world's z where they have none in common.
        common: length of the mean of the unit vectors: 1 where all cameras agree, 0 where they point all ways.
        axis: the nearest of the world's axes.
        off_deg: how far that is from the mean.
        spread_deg: median of how far cameras' are from the mean.
    """

    direction: Floats
    common: float
    axis: str
    off_deg: float
    spread_deg: float

    @property
    def is_known(self) -> bool:
        """Whether the cameras have a direction in common."""
        return self.common >= _COMMON

    @property
    def world_axis(self) -> Floats | None:
        """The axis of the world that points up, where one plainly does."""
        if not self.is_known or self.off_deg > _UPRIGHT_DEG:
            return None
        return np.eye(3)["xyz".index(self.axis[1])] * (1 if self.axis[0] == "+" else -1)


def up_of(capture: Capture) -> Up:
    """Ask the cameras which way is up: against their y axis, in OpenCV's axes."""
    ups = -capture.world_from_cam[:, :3, 1]
    mean = ups.mean(axis=0)
    common = float(np.linalg.norm(mean))
    direction = mean / common if common >= _COMMON else np.array([0.0, 0.0, 1.0])
    along = np.stack((direction, -direction), axis=1).ravel()  # +x -x +y -y +z -z
    nearest = int(along.argmax())
    spread_deg = float(np.median(_angle_deg(ups @ direction)))
    return Up(direction, common, _AXES[nearest], float(_angle_deg(along[nearest])), spread_deg)


def check_up(capture: Capture, up: Up, are_contradicted: bool = False) -> Finding:
    """Say which way is up, and whether the images lie on their side.

    Args:
        capture: of posed images.
        up: of its cameras.
        are_contradicted: the images contradict the poses, which then say nothing of how the images lie.
    """
    figures = {
        "direction": up.direction.round(4).tolist(),
        "axis": up.axis,
        "off_deg": round(up.off_deg, 2),
        "agreement": round(up.common, 3),
        "spread_deg": round(up.spread_deg, 2),
    }
    sideways = float(np.linalg.norm(capture.world_from_cam[:, :3, 0].mean(axis=0)))
    concern = ""
    if sideways >= _COMMON and sideways > up.common + _ON_THEIR_SIDE and not are_contradicted:
        concern = (
            "the images seem to lie on their side: the cameras' x axis, not y, keeps a direction; images to "
            "localize must lie so, too"
        )
    if not up.is_known:
        return Finding(
            "up", f"unknown: cameras point all ways (agreement {up.common:.2f} of 1)", concern, figures=figures
        )
    place = f"{up.axis}, {up.off_deg:.0f}° off" if up.world_axis is not None else f"{up.off_deg:.0f}° from {up.axis}"
    message = f"{place}; cameras' own is {up.spread_deg:.0f}° from their mean (agreement {up.common:.2f} of 1)"
    return Finding("up", message, concern, figures=figures)


def check_axes(capture: Capture) -> Finding:
    """Say where the optical axes pass closest to each other, and whether that is in front of the cameras."""
    position, forward = capture.world_from_cam[:, :3, 3], capture.world_from_cam[:, :3, 2]
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    total = across.sum(axis=0)
    if np.linalg.cond(total) > 1e4:
        return Finding("optical axes", "parallel")
    meeting = np.linalg.solve(total, (across @ position[..., None]).sum(axis=0)[:, 0])
    depth = ((meeting - position) * forward).sum(axis=1)
    miss = np.linalg.norm(across @ (meeting - position)[..., None], axis=(1, 2))
    in_front, share = float((depth > 0).mean()), float(np.median(miss) / max(np.median(np.abs(depth)), 1e-12))
    figures = {"point": meeting.round(4).tolist(), "in_front": round(in_front, 3), "miss": round(share, 3)}
    if share > 0.5:
        return Finding("optical axes", "meet nowhere", figures=figures)
    where = "in front of" if in_front >= _IN_FRONT else "behind" if in_front <= 1 - _IN_FRONT else "before and behind"
    message = f"meet {where} the cameras, missing a point by {share:.0%} of its distance (median)"
    return Finding("optical axes", message, figures=figures)


def _angle_deg(cosine: Floats | float) -> Floats:
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))
