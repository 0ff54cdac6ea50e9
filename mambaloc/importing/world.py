"""The world of a capture: frames without a fix, the unit, and an origin that is near."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from mambaloc.importing.capture import Capture
from mambaloc.importing.checks import sanity
from mambaloc.importing.checks.fixes import astray, without_fix
from mambaloc.importing.undistort.images import selected
from mambaloc.runtime.world import World

_FAR = 1000.0
"""Extents from the origin, beyond which it is shifted: float32 would be off by a ten-thousandth of the extent."""
_BLURRED = 4096.0
"""Units from the origin, beyond which it is shifted, too: float32 would be off by a quarter of a thousandth."""


def in_its_world(capture: Capture, metres_per_unit: float | None) -> tuple[Capture, dict[str, str]]:
    """Leave out frames that have no pose, scale positions, and shift a world whose origin is far away.

    Args:
        capture: as it was read.
        metres_per_unit: what the format's unit is; as the format states by default.

    Returns:
        The capture, with its offset, and the rule that each frame that was left out breaks, by file.
    """
    capture, lost = _without(capture, without_fix(capture.world_from_cam, capture.sequences, capture.images))
    capture, broken = _without(capture, sanity.bad_poses(capture.world_from_cam))
    capture = _in_metres(capture, metres_per_unit)
    capture, strays = _without(capture, astray(capture.world_from_cam))
    capture = _near_the_origin(capture)
    capture, far = _without(capture, sanity.far_poses(capture.world_from_cam))
    return capture, {**lost, **broken, **strays, **far}


def _without(capture: Capture, rules: Mapping[int, str]) -> tuple[Capture, dict[str, str]]:
    """A capture without some rows, and the rule that each breaks, by file."""
    if not rules:
        return capture, {}
    kept = selected(capture, [row for row in range(len(capture.images)) if row not in rules])
    return kept, {str(capture.images[row]): rule for row, rule in rules.items()}


def _in_metres(capture: Capture, metres_per_unit: float | None) -> Capture:
    stated = capture.choices.get("scale", "")
    if metres_per_unit is not None:
        scale = f"multiplied by {metres_per_unit:g}, as --metres-per-unit says; otherwise: {stated}"
    elif capture.metres_per_unit in (None, 1.0):
        return capture
    else:
        metres_per_unit = capture.metres_per_unit
        scale = f"multiplied by {metres_per_unit:g}: {stated}"
    world_from_cam = capture.world_from_cam.copy()
    world_from_cam[:, :3, 3] *= metres_per_unit
    depth = capture.depth and replace(capture.depth, step=capture.depth.step * metres_per_unit)
    choices = {**capture.choices, "scale": scale}
    tracks = capture.tracks and capture.tracks.moved(metres_per_unit, np.zeros(3))
    return replace(
        capture,
        world_from_cam=world_from_cam,
        unit="metre",
        choices=choices,
        depth=depth,
        tracks=tracks,
        world=World(metres_per_unit=metres_per_unit),
    )


def _near_the_origin(capture: Capture) -> Capture:
    """Shift a world whose origin is so far away that float32 would blur it, as a map's is."""
    position = capture.world_from_cam[:, :3, 3]
    middle = np.median(position, axis=0).round() if len(position) else np.zeros(3)
    low, high = np.percentile(position, (5, 95), axis=0) if len(position) else np.zeros((2, 3))
    extent, distance = float(np.linalg.norm(high - low)), float(np.linalg.norm(middle))
    if distance <= min(_FAR * max(extent, 1e-3), _BLURRED):
        return replace(capture, choices={"origin": "as in the source", **capture.choices})
    world_from_cam = capture.world_from_cam.copy()
    world_from_cam[:, :3, 3] -= middle
    origin = f"shifted to {middle.tolist()} of the source's world, so that float32 holds the positions"
    tracks = capture.tracks and capture.tracks.moved(1.0, -middle)
    return replace(
        capture,
        world_from_cam=world_from_cam,
        choices={**capture.choices, "origin": origin},
        tracks=tracks,
        world=replace(capture.world, offset_m=tuple(middle.tolist())),
    )
