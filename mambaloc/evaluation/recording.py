"""Test frames as a recording for the Rerun viewer: what the trajectory's figure shows, with the images."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mambaloc.data.cameras import frame_intrinsics
from mambaloc.errors import InputError
from mambaloc.evaluation.trained import Trained
from mambaloc.evaluation.with_map import Answers, MeasuredMap
from mambaloc.images import read_image
from mambaloc.metrics import PoseErrorTable
from mambaloc.runtime.localization import Localization
from mambaloc.uncertainty import uncertainty_of_test
from mambaloc.viz.rerun_recording import rerun_recording


def record_test_frames(
    path: Path, trained: Trained, table: PoseErrorTable, beside: MeasuredMap | None = None, both: Answers | None = None
) -> None:
    """Record test frames with true and predicted poses, and radii where the model states them.

    Test frames carry no times, so they count as one a second. Where no camera is known there are no frusta.

    Args:
        path: the recording, ending in ``.rrd``.
        trained: the system and its data.
        table: its predictions.
        beside: a map of the place, whose points are shown.
        both: answers of both together, which are recorded in place of the network's.

    Raises:
        InputError: as :func:`~mambaloc.viz.rerun_recording.rerun_recording`, or for a bad image.
    """
    frames, scene = trained.data.frames("test"), trained.data.hparams["scene"]
    poses: Sequence[Localization] = _network(trained, table) if both is None else both.poses
    try:
        cameras = list(frame_intrinsics(trained.data.hparams["dataset"], trained.data.folder, frames))
    except InputError:
        cameras = []
    with rerun_recording(path, str(scene)) as recording:
        if beside is not None:
            recording.add_map(beside.localizer.map)
        for number, pose in enumerate(poses):
            index = int(table.index[number])
            recording.add_frame(
                read_image(frames.image_paths[index]),
                pose,
                float(number),
                cameras[index] if cameras else None,
                (frames.position_m[index], frames.quaternion[index]),
            )


def _network(trained: Trained, table: PoseErrorTable) -> list[Localization]:
    """A network's poses, each with its radii."""
    stated = uncertainty_of_test(trained.system, trained.data)
    radii = itertools.repeat((None, None, None)) if stated is None else stated.by_frame()
    poses = zip(table.predicted_position_m.cpu().numpy(), table.predicted_quaternion.cpu().numpy(), strict=True)
    answers = [Localization(*pose, 0.0, *three) for pose, three in zip(poses, radii, strict=False)]
    return [each if np.isfinite(each.position_m).all() else replace(each, source=None) for each in answers]
