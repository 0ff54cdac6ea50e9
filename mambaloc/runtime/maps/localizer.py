"""Where an image was taken, from a sparse map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import deprecated

from mambaloc.errors import InputError
from mambaloc.images import Image, as_rgb
from mambaloc.runtime.maps.absolute_pose import CameraPose, focal_scale, pose_covariance, ransac_pose, refine_pose
from mambaloc.runtime.maps.acceptance import Evidence, is_another_focal_length, occupied_cells
from mambaloc.runtime.maps.drift import Drift
from mambaloc.runtime.maps.features import (
    Features,
    check_intrinsics,
    dequantized,
    detect_features,
    distance,
    mutual,
    rescaled_intrinsics,
    unambiguous,
)
from mambaloc.runtime.maps.sparse_map import SparseMap
from mambaloc.runtime.maps.viewpoints import spread_m, viewpoints
from mambaloc.runtime.rotations import quaternion_from_matrix

Floats = NDArray[np.floating[Any]]

_AT_ONCE = 2500  # points, of those that most frames see, which are matched without a pose
_RATIO = 0.85
_GUIDED_RATIO = 0.95
_GUIDED_FARTHEST = 0.9  # of unit descriptors
_NEAREST = 8  # key frames whose points are searched again
_WINDOWS = (6.0, 2.0)  # radii of the guided rounds, in times of what is near
_PRIOR_WINDOW = 12.0  # radius around a prior: 54 px at a width of 160
_MIN_SHARE = 0.1
_SHARED = 1.25  # of variances: neighbouring matches share errors; chosen on frames held out of rendered rooms


@dataclass(frozen=True)
class MapLocalization:
    """Where one image was taken, ``world_from_cam``, and how sure that is.

    Shape:
        ``position_m`` (3,) camera centre in metres; ``quaternion`` (4,) unit, wxyz, ``w >= 0``; ``covariance`` (6, 6).
        All NaN where no pose was found.

    Args:
        position_m: in the map's frame.
        quaternion: of the camera's rotation in the map's frame.
        inliers: matches that agree with the pose.
        is_accepted: whether its evidence is enough, matches ask for no other focal length, and it has as many inliers
            as the map requires.
        covariance: of the position in metres, then of the rotation in radians about the fixed axes of the world: the
            order and frame of ROS's PoseWithCovariance. It says how well the matches fix the pose; errors that the
            map's own poses share are not in it.
        probability: that it is right; 0 where matches ask for another focal length.
        focal_scale: how many times the given focal length matches ask for; None where they do not contradict it.
        evidence: what the probability rests on otherwise; None where no pose was found.
    """

    position_m: Floats
    quaternion: Floats
    inliers: int
    is_accepted: bool
    covariance: Floats
    probability: float = 0.0
    focal_scale: float | None = None
    evidence: Evidence | None = None


class _Matches(NamedTuple):
    """Rows of keypoints and of points, and which matches are distinctive: the most similar of all points in view."""

    keypoints: NDArray[np.int64]
    points: NDArray[np.int64]
    is_distinctive: NDArray[np.bool_]


class MapLocalizer:
    """Localize images in a map, without torch and without a network.

    The points that most frames see are matched at once, RANSAC finds a pose, and every point is searched again around
    where that pose projects it to.

    Args:
        sparse_map: the map.
        seed: of RANSAC.
    """

    def __init__(self, sparse_map: SparseMap, seed: int = 0) -> None:
        self.map = sparse_map
        self.seed = seed
        self._points_m = sparse_map.points_m.astype(np.float64)
        self._descriptors = dequantized(sparse_map.descriptors)
        self._views = np.ascontiguousarray(sparse_map.is_seen.T)
        # A map's first points are in this order; those that were added to it are not.
        often = np.argsort(-self._views.sum(axis=0), kind="stable")[:_AT_ONCE]
        self._often_m = self._points_m[often]
        self._often_descriptors = np.ascontiguousarray(self._descriptors[often].T)
        self._near = near_px(sparse_map.size[0]) / sparse_map.intrinsics[0, 0]  # in the plane at depth 1
        self._unit_m = spread_m(sparse_map.key_poses)
        self._viewpoints = viewpoints(sparse_map.key_poses, self._unit_m)
        drift = sparse_map.drift if len(sparse_map.drift) else np.zeros((len(sparse_map.key_poses), 6))
        self.drift = Drift(sparse_map.key_poses[: len(drift)], drift, sparse_map.nugget)

    def localize(
        self, image: Image, intrinsics: ArrayLike | None = None, prior: CameraPose | None = None
    ) -> MapLocalization:
        """Localize one image.

        Args:
            image: RGB (H, W, 3) or grey (H, W), ``uint8``, of any size, without distortion.
            intrinsics: (3, 3) pinhole matrix in pixels of it; the map's camera unless given.
            prior: a pose to search around where all points at once find none to accept, such as a network's.

        Raises:
            InputError: for another kind of array, intrinsics that do not fit the image, or none for an image of
                another shape than the map's.
        """
        return self.localize_features(self.features(image, intrinsics), prior)

    def features(self, image: Image, intrinsics: ArrayLike | None = None) -> Features:
        """Find an image's keypoints as the map's were found; arguments and errors are those of :meth:`localize`."""
        rgb = as_rgb(image)
        matrix = self._intrinsics(rgb) if intrinsics is None else np.asarray(intrinsics, np.float64)
        check_intrinsics(matrix, (rgb.shape[1], rgb.shape[0]))
        # So that things are as large as in the map's images, whatever the lens.
        found = detect_features(rgb, matrix, self.map.intrinsics[0, 0] / matrix[0, 0])
        return self.map.lens.straighten(found) if self._is_own_camera(found) else found

    def localize_features(self, features: Features, prior: CameraPose | None = None) -> MapLocalization:
        """Localize an image whose keypoints :meth:`features` found."""
        best, is_clear = unambiguous(features.descriptors @ self._often_descriptors, _RATIO)
        rng = np.random.default_rng(self.seed)
        start = ransac_pose(self._often_m[best[is_clear]], features.rays[is_clear], self._near, rng)
        found = self._settled(features, start)
        if prior is None or found.is_accepted:
            return found
        around = self._search(features, self.drift.to_adjusted(prior), _PRIOR_WINDOW * self._near)
        start = ransac_pose(self._points_m[around.points], features.rays[around.keypoints], self._near, rng)
        both = (found, self._settled(features, start))
        return max(both, key=lambda each: (each.is_accepted, each.probability, each.inliers))

    @deprecated("MapLocalizer.localise is now localize. The old name is removed in the next release.")
    def localise(
        self, image: Image, intrinsics: ArrayLike | None = None, prior: CameraPose | None = None
    ) -> MapLocalization:
        """Localize one image. Deprecated: removed in the next release."""
        return self.localize(image, intrinsics, prior)

    def _settled(self, features: Features, start: CameraPose | None) -> MapLocalization:
        """Search around a pose and refine it, twice."""
        if start is None:
            return _nowhere()
        near = self._near
        pose, scale = start, near / 2  # of the refinement; finer where the matches are
        for window in _WINDOWS:
            matches, finest = self._search(features, pose, window * near), scale
            if len(matches.points) < 4:
                return _nowhere()
            seen_m, rays = self._points_m[matches.points], features.rays[matches.keypoints]
            pose = refine_pose(pose, seen_m, rays, finest)
            off = np.linalg.norm(pose.project(seen_m)[0] - rays, axis=1)
            scale = min(near / 2, max(2.5 * float(np.nanmedian(off)), _MIN_SHARE * near))
        is_inlier = off <= near
        covariance = pose_covariance(pose, seen_m, rays, finest)
        evidence = self._evidence(features, matches, is_inlier, start, pose, finest, _deviation_m(covariance))
        focal = focal_scale(pose, seen_m, rays, finest)
        focal_off = focal[0] if is_another_focal_length(*focal) else None
        probability = evidence.probability if focal_off is None else 0.0
        given, unsure = self.drift.to_given(pose)
        return MapLocalization(
            given.position_m,
            quaternion_from_matrix(given.rotation),
            int(is_inlier.sum()),
            bool(focal_off is None and evidence.is_enough and is_inlier.sum() >= self.map.least_inliers),
            _SHARED * covariance + unsure,
            probability,
            focal_off,
            evidence,
        )

    def _evidence(
        self,
        features: Features,
        matches: _Matches,
        is_inlier: NDArray[np.bool_],
        start: CameraPose,
        pose: CameraPose,
        scale: float,
        deviation_m: float,
    ) -> Evidence:
        """What speaks for a pose that :meth:`_settled` refined from ``start`` at a ``scale``; the deviation is its."""
        points, keypoints = matches.points[matches.is_distinctive], matches.keypoints[matches.is_distinctive]
        alone_m = np.inf
        if len(points) >= 4:
            seen_m, rays = self._points_m[points], features.rays[keypoints]
            alone_m = _deviation_m(pose_covariance(refine_pose(pose, seen_m, rays, scale), seen_m, rays, scale))
        deviation = float(np.maximum(alone_m, deviation_m)) / self._unit_m  # NaN where either is
        pixels = features.pixels[matches.keypoints[matches.is_distinctive & is_inlier]]
        turn_deg = np.degrees(np.linalg.norm(cv2.Rodrigues(start.rotation.T @ pose.rotation)[0]))
        return Evidence(occupied_cells(pixels, features.size), deviation, float(turn_deg))

    def matches(self, features: Features, pose: CameraPose) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Points that an image shows where its pose projects them: rows of keypoints and of points."""
        found = self._search(features, pose, self._near)
        return found.keypoints, found.points

    def _search(self, features: Features, pose: CameraPose, radius: float) -> _Matches:
        """Match again what a pose projects near a keypoint."""
        projected, _ = pose.project(self._points_m)
        corners = features.corner_rays
        with np.errstate(invalid="ignore"):
            inside = ((projected >= corners[0]) & (projected <= corners[1])).all(axis=1)
        visible = np.flatnonzero(inside & self._seen_around(pose))
        similarity = features.descriptors @ self._descriptors[visible].T
        row_max = similarity.max(axis=1, initial=-1)
        np.copyto(similarity, -1, where=_square_distances(features.rays, projected[visible]) > radius**2)
        best, is_clear = unambiguous(similarity, _GUIDED_RATIO)
        rows = np.flatnonzero(is_clear & mutual(similarity, best))
        rows = rows[distance(similarity[rows, best[rows]]) < _GUIDED_FARTHEST]
        return _Matches(rows, visible[best[rows]], similarity[rows, best[rows]] >= row_max[rows])

    def _seen_around(self, pose: CameraPose) -> NDArray[np.bool_]:
        """Which points one of the nearest key frames sees, (P,): what is hidden from there is not searched.

        Where the poses of a capture drift, these also agree best with each other.
        """
        squared = ((self._viewpoints - viewpoints(pose.matrix[None], self._unit_m)) ** 2).sum(axis=1)
        nearest = np.argsort(squared, kind="stable")[:_NEAREST]
        return np.asarray(self._views[nearest].any(axis=0))

    def _is_own_camera(self, features: Features) -> bool:
        """Whether an image, of any resolution, claims to be of the map's camera, whose lens is known."""
        (width, height), tolerance_px = self.map.size, 0.01 * self.map.size[0]
        as_large = rescaled_intrinsics(features.intrinsics, features.size, self.map.size)
        has_shape = abs(features.size[1] * width / features.size[0] - height) <= tolerance_px
        return has_shape and bool(np.abs(as_large - self.map.intrinsics).max() <= tolerance_px)

    def _intrinsics(self, image: Image) -> Floats:
        height, width = image.shape[:2]
        if abs(width * self.map.size[1] - height * self.map.size[0]) > max(self.map.size):
            raise InputError(
                f"image of {width}x{height}: its shape differs from the map's images of "
                f"{self.map.size[0]}x{self.map.size[1]}, so its camera is unknown. Give its intrinsics."
            )
        return rescaled_intrinsics(self.map.intrinsics, self.map.size, (width, height))


def near_px(width: int) -> float:
    """How far a match may be from where its point is projected, in pixels of an image that is so wide.

    Poses of a real capture drift by that much; where matches agree better, the refinement follows them.
    """
    return 4.5 * width / 160


def _square_distances(first: Floats, second: Floats) -> NDArray[np.float32]:
    """Between points of a plane, (N, 2) and (M, 2); (N, M). As one product, without arrays of that size in between."""
    of_first = np.column_stack((-2 * first, np.ones(len(first)), (first**2).sum(axis=1)))
    of_second = np.column_stack((second, (second**2).sum(axis=1), np.ones(len(second))))
    return np.asarray(of_first.astype(np.float32) @ of_second.astype(np.float32).T)


def _deviation_m(covariance: Floats) -> float:
    """Of the position, in the direction that is least sure."""
    return float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))


def _nowhere() -> MapLocalization:
    return MapLocalization(np.full(3, np.nan), np.full(4, np.nan), 0, False, np.full((6, 6), np.nan))
