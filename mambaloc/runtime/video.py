"""Localize a whole source, filter its poses, and write its trajectory."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rich.console import Console
from rich.progress import track

from mambaloc.errors import InputError
from mambaloc.images import Counts
from mambaloc.runtime.localization import Localization
from mambaloc.runtime.localizer import Localizer
from mambaloc.runtime.pose_filter import PoseFilter, smooth
from mambaloc.runtime.sources import SourceFrame, frames_of
from mambaloc.runtime.trajectory import write_tum

_NO_NAME = re.compile(r"[^\w.-]")  # in a scene's name: what no file's may have

FILTERS = ("causal", "smooth")
"""How a video's poses may be filtered: each from those until then, or from all."""


@dataclass(frozen=True)
class VideoResult:
    """What became of a source's frames.

    Args:
        scene: the place; of a network that knows several, each that was recognised and how often.
        count: frames that were localized.
        lost: frames without a pose, as a map alone may leave.
        from_map: of the poses, those that the map found; None unless it stands beside a network.
        outliers: of the poses, those that a filter left out; None where there was no filter.
        latency_ms: median of a frame.
        unfamiliar: of the frames, those that do not look like the place; None if the model does not estimate it.
        radii: medians of what nine of ten poses are within, in metres and degrees; None if unknown.
        files: the trajectories that were written.
    """

    scene: str
    count: int
    lost: int
    from_map: int | None
    outliers: int | None
    latency_ms: float
    unfamiliar: int = 0
    radii: tuple[float, float] | None = None
    files: tuple[Path, ...] = ()

    def __str__(self) -> str:
        """Format for a terminal: one line, and another with the uncertainty of poses where it is known."""
        details = [] if self.outliers is None else [f"{self.outliers} outliers"]
        if self.from_map is not None:
            details += [f"{self.from_map} from the map, {self.count - self.from_map} from the network"]
        if self.lost:
            details += [f"{self.lost} frames without a pose"]
        poses = f"{self.count} poses" + (f" ({', '.join(details)})" if details else "")
        line = f"{poses} in {self.scene}, median {self.latency_ms:.1f} ms a frame"
        if self.radii is None:
            return line
        metres, degrees = self.radii
        unfamiliar = f"; {self.unfamiliar} do not look like the place" if self.unfamiliar else ""
        return f"{line}\nnine of ten within {metres:.2g} m and {degrees:.2g}°{unfamiliar}"


def localize_video(
    localizer: Localizer,
    source: str,
    out: Path,
    filtering: str | None = None,
    intrinsics: ArrayLike | None = None,
    counts: Counts | None = None,
    is_distorted: bool = False,
    on_frame: Callable[[SourceFrame, Localization], None] | None = None,
) -> VideoResult:
    """Localize every frame of a source with a progress bar on stderr, and write a TUM trajectory.

    Ctrl-C ends it; what was found is written then, and also where a frame cannot be localized. The trajectory's times
    are those that the filter takes: seconds since the first frame. It leaves out frames without a pose. A network that
    knows several scenes answers in the frame of the one that it recognises, so each gets a trajectory of its own,
    ``poses_SCENE.tum`` where ``out`` is ``poses.tum``.

    Args:
        localizer: of the model.
        source: as :func:`~mambaloc.runtime.sources.frames_of` takes it.
        out: the trajectory.
        filtering: one of :data:`FILTERS`; poses are written as found unless given.
        intrinsics: of every frame, (3, 3) in pixels; the training camera's unless given.
        counts: black and white of 16-bit images, as the scene's were.
        is_distorted: frames are as the training camera stores them, and are undistorted by its lens.
        on_frame: is given each frame and what was found of it, unfiltered.

    Raises:
        InputError: where there is no such source, it has no frame, one cannot be localized, none has a pose, or
            ``out`` has no folder.
    """
    if out.is_dir() or not out.absolute().parent.is_dir():
        raise InputError(f"--out {out}: its folder does not exist; make it, or choose another")
    frames, count = frames_of(source, counts=counts)
    console = Console(stderr=True)
    found: list[tuple[float, Localization]] = []
    kept: list[tuple[float, Localization]] = []
    files: list[Path] = []
    outliers = None
    try:
        watched = track(frames, "Localizing", count, console=console, transient=True)
        for frame in watched:
            pose = localizer.localize(frame.image, intrinsics, is_distorted)
            found.append((frame.time_s, pose))  # at once, so that Ctrl-C leaves as many times as poses
            if on_frame is not None:
                on_frame(frame, pose)
    except KeyboardInterrupt:
        pass
    finally:
        kept = [each for each in found if each[1].source is not None]
        if kept:
            with console.status("Filtering"):
                files, outliers = _write_trajectories(out, kept, filtering)
    if not found:
        raise InputError(f"{source}: has no frame; give another video")
    if not kept:
        raise InputError(f"{source}: none of its {len(found)} frames was localized. Give frames of the map's place.")
    return replace(summarize(localizer, [pose for _, pose in found], outliers), files=tuple(files))


def _write_trajectories(
    out: Path, found: Sequence[tuple[float, Localization]], filtering: str | None
) -> tuple[list[Path], int | None]:
    """Write a trajectory for each scene that was recognised; return them, and how many poses a filter left out."""
    by_scene: dict[str | None, list[tuple[float, Localization]]] = {}
    for each in found:
        by_scene.setdefault(each[1].scene, []).append(each)
    files, outliers = [], 0
    for scene, answers in by_scene.items():
        times_s, poses = zip(*answers, strict=True)
        positions_m, quaternions, left_out = _filtered(filtering, times_s, poses)
        outliers += left_out
        files.append(out if scene is None else out.with_stem(f"{out.stem}_{_NO_NAME.sub('_', scene)}"))
        write_tum(files[-1], times_s, positions_m, quaternions)
    return files, None if filtering is None else outliers


def summarize(localizer: Localizer, found: Sequence[Localization], outliers: int | None = None) -> VideoResult:
    """Say what became of frames.

    Args:
        localizer: that found their poses.
        found: a frame's each, at least one with a pose.
        outliers: as of :class:`VideoResult`.
    """
    poses = [pose for pose in found if pose.source is not None]
    has_both = localizer.contract is not None and localizer.sparse_map is not None
    recognized = Counter(pose.scene for pose in poses if pose.scene is not None)
    return VideoResult(
        ", ".join(f"{scene} ({count})" for scene, count in recognized.most_common()) or localizer.scene,
        len(poses),
        len(found) - len(poses),
        sum(pose.source == "map" for pose in poses) if has_both else None,
        outliers,
        1000 * float(np.median([pose.latency_s for pose in found])),
        sum(pose.is_unfamiliar for pose in poses),
        _median_radii(poses),
    )


def _median_radii(poses: Sequence[Localization]) -> tuple[float, float] | None:
    radii = [(pose.position_radius_m, pose.rotation_radius_deg) for pose in poses if pose.position_radius_m is not None]
    return tuple(np.median(np.array(radii, np.float64), axis=0).tolist()) if radii else None


def _filtered(
    filtering: str | None, times_s: Sequence[float], poses: Sequence[Localization]
) -> tuple[NDArray[np.floating], NDArray[np.floating], int]:
    """Positions (N, 3), quaternions (N, 4), and how many were left out, by a filter."""
    positions_m, quaternions = (np.stack([getattr(pose, of) for pose in poses]) for of in ("position_m", "quaternion"))
    if filtering is None:
        return positions_m, quaternions, 0
    if filtering == "smooth":
        estimates = smooth(times_s, positions_m, quaternions)
    else:
        estimates = [*map(PoseFilter().update, times_s, positions_m, quaternions)]
    positions_m, quaternions = (np.stack([getattr(e, of) for e in estimates]) for of in ("position_m", "quaternion"))
    return positions_m, quaternions, sum(estimate.is_outlier for estimate in estimates)
