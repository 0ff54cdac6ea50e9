"""From a capture in anyone's format to a scene that every recipe trains on."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mambaloc.errors import InputError
from mambaloc.files import atomic_folder
from mambaloc.importing.canonical import Imported, write_frames, write_scene
from mambaloc.importing.capture import Capture
from mambaloc.importing.checks import sanity
from mambaloc.importing.checks.agreement import Agreement, agreement, check_agreement
from mambaloc.importing.checks.conventions import check_axes, check_up, up_of
from mambaloc.importing.checks.findings import Finding, verdict_of
from mambaloc.importing.formats.ros_bag import BagTopics
from mambaloc.importing.motion import Motion, motion_of
from mambaloc.importing.registry import read_capture
from mambaloc.importing.report import write_report
from mambaloc.importing.splits.advisor import propose
from mambaloc.importing.splits.selection import ASKED, SelectedSplit, SplitCandidate, choose
from mambaloc.importing.undistort.images import Written, write_images
from mambaloc.importing.world import in_its_world

_MAX_SCALE = 1e6


def import_scene(
    source: Path,
    out: Path,
    kind: str | None = None,
    metres_per_unit: float | None = None,
    split: str = "auto",
    command: str = "",
    with_adjusted: bool = False,
    images: Path | None = None,
    topics: BagTopics | None = None,
) -> Imported:
    """Read a capture, check it, split it, and write it as a scene's folder, which appears once it is whole.

    Args:
        source: the capture.
        out: the scene's folder, which must not be there yet.
        kind: the capture's format; found out unless given.
        metres_per_unit: what the source's unit is; as the source states by default.
        split: of :data:`~mambaloc.importing.splits.selection.ASKED`.
        command: that this was asked for with.
        with_adjusted: also write poses that are adjusted to the images, in a file of their own.
        images: the folder of the capture's images, where its format names them by paths; found unless given.
        topics: what to read of a ROS bag.

    Raises:
        InputError: for an invalid source, a folder that is there or cannot be written, or a split that cannot be
            made.
    """
    if out.exists():
        raise InputError(f"{out}: already exists; remove it, or choose another --out")
    if split not in ASKED:
        raise InputError(f"--split {split}: choose one of {', '.join(ASKED)}")
    if metres_per_unit is not None and not 1 / _MAX_SCALE <= metres_per_unit <= _MAX_SCALE:
        raise InputError(
            f"--metres-per-unit {metres_per_unit}: give a number from {1 / _MAX_SCALE:g} to {_MAX_SCALE:g}"
        )
    capture = read_capture(source, kind, images, topics)
    named = capture.left_out
    capture, lost = in_its_world(capture, metres_per_unit)
    with atomic_folder(out, "choose another folder with --out") as partial:
        written = write_images(capture, partial)
        imported = _checked(written, {**named, **lost, **written.rules}, split, with_adjusted)
        write_frames(imported, partial)
        if imported.capture.tracks:
            imported.capture.tracks.write(partial)
        write_report(imported, partial, out.name)
        write_scene(imported, partial, source, command)
    return imported


def _checked(written: Written, left_out: Mapping[str, str], asked: str, with_adjusted: bool) -> Imported:
    """Check what was written, and split it."""
    capture = written.capture
    findings = [sanity.check_frames(capture, left_out), sanity.check_missing(capture)]
    proposals: list[SplitCandidate] = []
    chosen: SelectedSplit | None = None
    agreeing: Agreement | None = None
    split = np.full(len(capture.images), "unused", dtype="<U6")
    if not any(finding.is_fatal for finding in findings):
        motion = motion_of(capture)
        agreeing = agreement(capture, motion, with_adjusted)
        findings += [sanity.check_sizes(written.sizes), sanity.check_pixels(written.decoding)]
        findings += [*check_agreement(agreeing), *_of_poses(capture, motion, agreeing)]
        if not any(finding.is_fatal for finding in findings):
            proposals = propose(capture, motion)
            chosen = choose(proposals, asked, capture)
            split = chosen.proposal.split
            findings.append(Finding("split", f"by {chosen.proposal.kind}: {chosen.proposal.how}", chosen.warning))
    adjusted = None if agreeing is None else agreeing.adjusted
    return Imported(
        capture=capture,
        lenses=written.lenses,
        split=tuple(split.tolist()),
        findings=tuple(findings),
        verdict=verdict_of(findings),
        proposals=tuple(proposals),
        chosen=chosen,
        left_out=left_out,
        agreement=agreeing,
        adjusted=None if adjusted is None else np.asarray(adjusted.world_from_cam, np.float64),
    )


def _of_poses(capture: Capture, motion: Motion, agreeing: Agreement) -> list[Finding]:
    unit = "m" if capture.unit == "metre" else "units"
    return [
        check_up(capture, up_of(capture), bool(agreeing.contradiction)),
        check_axes(capture),
        sanity.check_extent(capture, motion, unit),
        sanity.check_steps(capture, motion, unit),
        sanity.check_duplicates(capture, motion),
        sanity.check_times(capture),
    ]
