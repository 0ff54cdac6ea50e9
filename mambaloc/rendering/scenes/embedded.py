"""The embedded scene: a small furnished room that is rendered where there is no dataset yet."""

from __future__ import annotations

import json
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from filelock import FileLock

from mambaloc.errors import InputError
from mambaloc.rendering.quads import Room, Vectors
from mambaloc.rendering.room import furnished_room
from mambaloc.rendering.scenes.layouts import (
    GENERATOR_VERSION,
    add_depth,
    depth_file,
    has_depth,
    scene_note,
    write_7scenes,
)
from mambaloc.rendering.scenes.shots import Frame, frames_of_sequences
from mambaloc.rendering.trajectories import smooth_trajectory

EMBEDDED_SCENE = "room"
"""Name of its scene folder."""

_INSIDE_M = ((-1.25, -1.0, 1.1), (1.25, 1.0, 1.7))
_SIZE = (320, 240)
_SEED = 0
_FRAMES = 120  # in a training sequence; half as many in a test sequence
_STEP_DEG = 2.4  # as if every other frame of a hand-held recording was kept
_STARTS_DEG = {1: 0.0, 2: 45.0, 3: 90.0, 4: 180.0, 5: 225.0, 6: 270.0}
_TEST = (2, 5)
_DEPTH_EVERY = 10  # frames between lend each other their points


def ensure_embedded_scene(root: Path) -> Path:
    """The folder of the embedded scene under ``root``, rendered there on first use (seconds), in the 7-Scenes layout.

    Every tenth frame has depth, also in a scene that was rendered before there was any.

    Two processes may call this at once: one renders, the other waits. A scene that another version of the
    generator made is left alone, and the new one gets another name.

    Raises:
        InputError: if both names are taken by something else.
    """
    shots = embedded_frames()
    note = scene_note(shots, _SIZE, _SEED)
    names = (EMBEDDED_SCENE, f"{EMBEDDED_SCENE}-v{GENERATOR_VERSION}")
    if folder := _rendered(root, names, note):
        _add_missing_depth(folder, shots)
        return folder
    try:
        root.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{root}: cannot be written ({error.strerror}); choose another root") from None
    with FileLock(root / f".{EMBEDDED_SCENE}.lock"):
        if folder := _rendered(root, names, note):  # by whoever held the lock before
            return folder
        for name in names:
            if not (root / name).exists():
                room = embedded_room()
                return write_7scenes(
                    root, name, shots, room=room, size=_SIZE, seed=_SEED, depth=True, depth_every=_DEPTH_EVERY
                )
    raise InputError(f"{root / names[-1]}: was rendered by another version; remove it, or choose another root")


def embedded_frames() -> list[Frame]:
    """The frames of the embedded scene: four sequences to train on and two to test on, in the same volume."""
    sequences = {
        number: embedded_walk(_FRAMES // 2 if number in _TEST else _FRAMES, number, start_deg, _STEP_DEG)
        for number, start_deg in _STARTS_DEG.items()
    }
    return frames_of_sequences(sequences, _TEST, "seq-{sequence:02d}/frame-{frame:06d}.color.jpg")


def embedded_room() -> Room:
    """What there is to see in it."""
    return furnished_room(_INSIDE_M, _SEED)


def embedded_walk(frames: int, seed: int, start_deg: float, step_deg: float) -> Vectors:
    """A way through it, ``world_from_cam`` (frames, 4, 4); see :func:`smooth_trajectory`."""
    return smooth_trajectory(frames, seed=seed, inside_m=_INSIDE_M, start_deg=start_deg, step_deg=step_deg)


def _add_missing_depth(folder: Path, shots: Iterable[Frame]) -> None:
    due = [shot for shot in shots if has_depth(shot, _DEPTH_EVERY)]
    if all((folder / depth_file(shot)).is_file() for shot in due):
        return
    with suppress(OSError), FileLock(folder.parent / f".{EMBEDDED_SCENE}.lock"):  # read-only, it stays as it is
        if missing := [shot for shot in due if not (folder / depth_file(shot)).is_file()]:
            add_depth(folder, missing, embedded_room(), _SIZE)


def _rendered(root: Path, names: Iterable[str], note: object) -> Path | None:
    """The first of the folders whose ``scene.json`` holds this note."""
    for name in names:
        try:
            if json.loads((root / name / "scene.json").read_text()) == note:
                return root / name
        except (OSError, ValueError):
            continue
    return None
