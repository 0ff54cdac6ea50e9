"""What a localizer answers, and which answer counts where there are two."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mambaloc.runtime.maps import MapLocalization
from mambaloc.runtime.maps.radii import covariance_radius

Floats = NDArray[np.floating[Any]]

_RIGHT_M, _RIGHT_DEG = 0.2, 5.0
# That a network is right which states no radii. Images that a map rejects are bad: on none of 148 such images of
# frames held out of the embedded room was it right, nor was the map on the 66 of them to which it gave less than this.
_UNSTATED = 0.1


@dataclass(frozen=True)
class Localization:
    """Where one image was taken: ``world_from_cam``.

    Shape:
        ``position_m`` (3,) camera centre in metres; ``quaternion`` (4,) unit, wxyz, ``w >= 0``; both NaN where there is
        no pose. ``covariance`` (6, 6).

    Args:
        position_m: in the scene's frame; as :class:`~mambaloc.runtime.Localizer` returns it, in the world of the data
            that the scene was made of.
        quaternion: of the same pose.
        latency_s: seconds that it took, without decoding the image.
        position_radius_m: nine of ten poses are within this, as the model's contract says, or the covariance where the
            map's pose is accepted; None where neither says.
        rotation_radius_deg: the same of the rotation.
        unfamiliarity: how far the image is from those that the network was trained on; over 1, hardly any frame of the
            place is. None if the model does not estimate it.
        source: what found the pose; None where nothing did.
        inliers: matches that agree with the map's pose, accepted or not; None where there is no map.
        covariance: where the map's pose is accepted, of the position in metres, then of the rotation in radians about
            the fixed axes of the world, as ROS's PoseWithCovariance has it. None otherwise.
        focal_scale: how many times the given focal length the map's matches ask for; None where they do not contradict
            it, and where there is no map.
        scene: name of the scene that the image shows, in whose frame the pose is, where the network knows several. An
            unfamiliar image shows no known scene.
        scene_probability: of that scene, against the others.
    """

    position_m: Floats
    quaternion: Floats
    latency_s: float
    position_radius_m: float | None = None
    rotation_radius_deg: float | None = None
    unfamiliarity: float | None = None
    source: Literal["network", "map"] | None = "network"
    inliers: int | None = None
    covariance: Floats | None = None
    focal_scale: float | None = None
    scene: str | None = None
    scene_probability: float | None = None

    @property
    def is_accepted(self) -> bool:
        """Whether it is a pose that the map accepts."""
        return self.covariance is not None

    @property
    def is_unfamiliar(self) -> bool:
        """Whether the image does not look like the place, so that the network's pose says nothing.

        False where the map answers, and for models without an estimate.
        """
        return self.source != "map" and self.unfamiliarity is not None and not self.unfamiliarity <= 1


def combined(network: Localization | None, found: MapLocalization) -> Localization:
    """The map's pose where it is accepted, or likelier to be right than the network's; otherwise the network's.

    Everything that has both a network and a map decides here: apps' runtime, evaluation and benchmarks. Without a
    network, only an accepted pose is an answer. Where a pose is not accepted, the network's radii stand.

    Args:
        network: its answer; None where there is no network.
        found: the map's answer about the same image, with the network's pose as prior.
    """
    lost = Localization(np.full(3, np.nan), np.full(4, np.nan), 0.0, source=None)
    base = replace(network or lost, inliers=found.inliers, focal_scale=found.focal_scale)
    if not found.is_accepted and (network is None or found.probability <= _probability(network)):
        return base
    answer = replace(base, position_m=found.position_m, quaternion=found.quaternion, source="map")
    if not found.is_accepted:
        return answer
    return replace(
        answer,
        covariance=found.covariance,
        position_radius_m=covariance_radius(found.covariance[:3, :3]),
        rotation_radius_deg=float(np.degrees(covariance_radius(found.covariance[3:, 3:]))),
    )


def _probability(network: Localization) -> float:
    """That a network's pose is right, as the map's are: within 0.2 m and 5 degrees."""
    if network.is_unfamiliar:
        return 0.0
    if network.position_radius_m is None or network.rotation_radius_deg is None:
        return _UNSTATED
    radii = _RIGHT_M / network.position_radius_m, _RIGHT_DEG / network.rotation_radius_deg
    # Nine tenths of errors are within a radius; within so many radii are these, if errors are Rayleigh's.
    return math.prod(1 - 0.1 ** (each**2) for each in radii)
