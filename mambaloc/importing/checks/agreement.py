"""Whether a capture's images agree with its poses and its camera, and what would make them."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mambaloc.importing.capture import Capture
from mambaloc.importing.checks.adjusting import Adjusted, adjust_poses
from mambaloc.importing.checks.depth import ByDepth, by_depth
from mambaloc.importing.checks.epipolar import FOCALS, Bin, best_focal, by_baseline, by_focal
from mambaloc.importing.checks.explanations import AS_READ, WORLD_TO_CAMERA, Order, better_order, by_convention
from mambaloc.importing.checks.findings import Finding
from mambaloc.importing.checks.matching import find_matches, intrinsics
from mambaloc.importing.motion import Motion

Floats = NDArray[np.floating[Any]]

_MIN_MATCHES = 200
_AGREE = 0.3  # a tenth of matches agree with any poses
_PLAINLY = 0.2
_CLEARLY = 0.1
_SAME_FOCAL = 0.03
_WORSE = 1.25
_DRIFT = 0.5  # of what is possible
_AS_GIVEN = int(np.abs(FOCALS - 1).argmin())
_OF_EITHER_DIRECTION = ("csv", "pose_lines", "pose_files")  # formats that may be read as KIND_cam_from_world


@dataclass(frozen=True)
class Agreement:
    """How many matches between a capture's images agree with its poses and its camera.

    Args:
        share: of matches between neighbours, by convention.
        matches: between neighbours.
        pairs: of neighbours.
        bins: the share by how far images are apart.
        focal_share: the share at each of :data:`~mambaloc.importing.checks.epipolar.FOCALS`.
        focal_px: of the first frame's camera, along x.
        is_guessed: the focal length is a guess, since the format gives none.
        order: another association of images with poses that fits clearly better.
        depth: what depth says, where the capture has some.
        adjusted: poses adjusted to the images, where they were asked for.
        kind: the capture's format.
    """

    share: dict[str, float]
    matches: int
    pairs: int
    bins: list[Bin]
    focal_share: Floats
    focal_px: float
    is_guessed: bool
    order: Order | None = None
    depth: ByDepth | None = None
    adjusted: Adjusted | None = None
    kind: str = ""

    @property
    def best(self) -> str:
        """The convention that most matches agree with."""
        return max(self.share, key=self.share.__getitem__)

    @property
    def is_known(self) -> bool:
        """Whether there are matches enough to say anything."""
        return self.matches >= _MIN_MATCHES

    @property
    def focal(self) -> float:
        """The focal length that most matches agree with, over that of the capture."""
        return best_focal(self.focal_share)

    @property
    def contradiction(self) -> str:
        """What is wrong with the poses, and what to do, in a line; empty where nothing is known to be."""
        return _contradiction(self) if self.is_known else ""

    @property
    def is_of_another_lens(self) -> bool:
        """Whether another focal length than the given explains clearly more, and more than another order does."""
        best, given = self.focal_share.max(), self.focal_share[_AS_GIVEN]
        is_other = abs(self.focal - 1) > _SAME_FOCAL and best > max(given + _CLEARLY, _AGREE)
        return bool(is_other) and not self.is_guessed and (self.order is None or best >= self.order.share)


def agreement(capture: Capture, motion: Motion, with_adjusted: bool = False) -> Agreement:
    """Compare a capture's images with its poses and its camera.

    Args:
        capture: its images are those of pinholes, where it has cameras.
        motion: its.
        with_adjusted: also adjust the poses to the images.

    Raises:
        InputError: for a depth frame that is damaged, a camera that cannot be that of its images, or images too
            bare to adjust the poses.
    """
    matches, poses = find_matches(capture, motion), capture.world_from_cam
    adjusted = adjust_poses(capture) if with_adjusted else None
    return Agreement(
        by_convention(matches, poses),
        int(matches.per_pair()[: matches.neighbours].sum()),
        matches.neighbours,
        by_baseline(matches, poses, None if adjusted is None else adjusted.world_from_cam),
        by_focal(matches, poses),
        float(intrinsics(capture, 0)[0, 0]),
        matches.is_guessed,
        better_order(capture, matches),
        by_depth(capture, matches),
        adjusted,
        capture.kind,
    )


def check_agreement(found: Agreement) -> list[Finding]:
    """Say whether images agree with poses and camera, and what to do where they do not; the first says all in one."""
    figures: dict[str, Any] = {
        "matches": found.matches,
        "pairs": found.pairs,
        "share": {name: round(share, 4) for name, share in found.share.items()},
        "focal_length_guessed": found.is_guessed,
        "by_baseline": [_rounded(each) for each in found.bins],
    }
    name, share = "images and poses", found.share[AS_READ]
    if not found.is_known:
        message = f"not compared: {found.matches} matches on {found.pairs} pairs of images"
        concern = (
            f"nothing could be compared: {found.matches} matches between images are too few to check whether the poses "
            "fit; look at trajectory.png, and give larger or more textured images if you can"
        )
        return [Finding(name, message, concern, figures=figures)]
    others = max(share for convention, share in found.share.items() if convention != AS_READ)
    guessed = ", focal length guessed" if found.is_guessed else ""
    message = f"{share:.0%} of {found.matches} matches on {found.pairs} pairs agree{guessed} (otherwise: {others:.0%})"
    findings = [Finding(name, message, found.contradiction, figures=figures), _check_focal(found)]
    if found.depth is not None:
        findings.append(_check_depth(found.depth, found.focal_px))
    if found.adjusted is not None:
        findings.append(_of_adjusted(found.adjusted))
    return findings


def _remedy(convention: str, kind: str) -> str:
    if convention == WORLD_TO_CAMERA and kind in _OF_EITHER_DIRECTION:
        return f"import them with --format {kind}_cam_from_world"
    return "convert them to camera to world in OpenCV's axes (x right, y down, z forward), and import them again"


def _contradiction(found: Agreement) -> str:
    """What is wrong with the poses, and what to do; empty where nothing is."""
    share, best = found.share[AS_READ], found.best
    if best != AS_READ and found.share[best] >= _AGREE and found.share[best] > share + _PLAINLY:
        return (
            f"the poses look like {best}: {found.share[best]:.0%} of matches agree with that, {share:.0%} with them "
            f"{AS_READ}; {_remedy(best, found.kind)}"
        )
    order = found.order
    if order is not None and order.share >= _AGREE and not found.is_of_another_lens:
        return (
            f"the images fit {order.name} better: {order.share:.0%} of matches agree, {order.as_read:.0%} as they "
            "were read; correct the time stamps, or the order of the files"
        )
    if found.is_guessed and max(share, float(found.focal_share.max())) < _AGREE:
        return (
            f"only {share:.0%} of matches between images agree with the poses, and no focal length makes more agree "
            "than chance: the poses may be inaccurate, of other images, or meant otherwise than they were read; "
            "compare choices with how the file was written"
        )
    if share < _AGREE and not found.is_guessed and not found.is_of_another_lens:
        return (
            f"only {share:.0%} of matches between images agree with the poses: these may be inaccurate, or of other "
            "images, or the camera's intrinsics wrong; check that all three are of one recording"
        )
    far = found.bins[len(found.bins) // 2 :]
    agreeing, possible = (sum(each.matches * getattr(each, of) for each in far) for of in ("share", "possible"))
    if not found.is_guessed and not found.is_of_another_lens and agreeing < _DRIFT * possible:
        total = sum(each.matches for each in far)
        return (
            f"the poses drift: {agreeing / total:.0%} of matches agree between images far apart, where "
            f"{possible / total:.0%} could; --adjust-poses writes poses that fit better beside them"
        )
    return ""


def _check_focal(found: Agreement) -> Finding:
    best, given = float(found.focal_share.max()), float(found.focal_share[_AS_GIVEN])
    focal_px = found.focal * found.focal_px
    figures = {
        "given_px": round(found.focal_px, 2), "best_px": round(focal_px, 2), "best_over_given": round(found.focal, 4),
        "share_at_given": round(given, 4), "share_at_best": round(best, 4),
    }  # fmt: skip
    kind = "guessed" if found.is_guessed else "given"
    message = f"{found.focal_px:.0f} px {kind}, {given:.0%} of matches agree; most at {focal_px:.0f} px, {best:.0%}"
    concern = ""
    if found.is_of_another_lens and found.best == AS_READ:
        concern = (
            f"the focal length looks like {focal_px:.0f} px rather than {found.focal_px:.0f}: {best:.0%} of matches "
            f"agree, not {given:.0%}; check that the intrinsics are of images of this size"
        )
    return Finding("focal length", message, concern, figures=figures)


def _check_depth(found: ByDepth, focal_px: float) -> Finding:
    figures = {
        "matches": found.matches, "pairs": found.pairs, "off_px": round(found.given_px, 2),
        "best_focal_px": round(found.focal * focal_px, 2), "off_at_best_focal_px": round(found.focal_px.min(), 2),
        "best_turns": found.turn, "off_at_best_turns_px": round(found.turn_px.min(), 2),
    }  # fmt: skip
    message = (
        f"{found.matches} matches lifted by depth are {found.given_px:.1f} px off (median); least at a focal length of "
        f"{found.focal * focal_px:.0f} px ({found.focal_px.min():.1f} px), or at turns times {found.turn:.3g} "
        f"({found.turn_px.min():.1f} px)"
    )
    concern = ""
    if abs(found.focal - 1) > _SAME_FOCAL and found.given_px > _WORSE * found.focal_px.min():
        concern = (
            f"depth fits a focal length of {found.focal * focal_px:.0f} px better than {focal_px:.0f}: matches are "
            f"{found.focal_px.min():.1f} px off, not {found.given_px:.1f}; check the intrinsics of images and depth"
        )
    return Finding("depth", message, concern, figures=figures)


def _of_adjusted(found: Adjusted) -> Finding:
    figures = {
        "frames": found.frames, "points": found.points, "turns_over_given": round(found.turns, 4),
        "moved": round(found.moved, 6), "turned_deg": round(found.turned_deg, 3), "with_depth": found.with_depth,
        "focal_over_given": {name: round(scale, 4) for name, scale in found.focal.items()},
    }  # fmt: skip
    message = (
        f"{found.frames} frames and {found.points} points adjusted: camera centres moved by {found.moved:.3g}, cameras "
        f"turned by {found.turned_deg:.2g}° (medians); turns between frames are {found.turns:.3g} of those given"
    )
    if found.focal:
        message += "; focal length " + ", ".join(f"{scale:.4f} ({name})" for name, scale in found.focal.items())
    return Finding("adjusted poses", message, figures=figures)


def _rounded(each: Bin) -> dict[str, float | None]:
    """A bin as ``scene.json`` has it, which knows no infinity."""
    rounded = {name: None if value is None else round(value, 4) for name, value in asdict(each).items()}
    return {**rounded, "high": None if np.isinf(each.high) else rounded["high"]}
