"""Rendered scenes on disk, in the official layouts of 7-Scenes and Cambridge Landmarks."""

from __future__ import annotations

import json
import os
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from mambaloc.errors import InputError
from mambaloc.rendering.quads import Image, Room
from mambaloc.rendering.renderer import default_intrinsics, render, sensor
from mambaloc.rendering.room import room_around
from mambaloc.rendering.scenes.shots import Frame
from mambaloc.rendering.scenes.tracks import write_nvm
from mambaloc.runtime.rotations import quaternion_from_matrix

GENERATOR_VERSION = 1
"""Raised with every change that renders other images."""

JPEG_QUALITY = 95
_CAMBRIDGE_HEADER = "Visual Landmark Dataset V1\nImageFile, Camera Position [X Y Z W P Q R]\n\n"
_SPLIT_TITLES = {"train": "Train", "test": "Test"}


def write_7scenes(
    root: Path,
    scene: str,
    shots: Sequence[Frame],
    *,
    room: Room | None = None,
    size: tuple[int, int] = (320, 240),
    seed: int = 0,
    depth: bool = False,
    depth_every: int = 1,
) -> Path:
    """Render a scene into ``root/scene`` as 7-Scenes lays it out; a run that is cut off leaves nothing there.

    Args:
        root: folder of the scenes.
        scene: the new folder's name.
        shots: what to render, named ``seq-NN/frame-NNNNNN.color.png`` (or ``.jpg``), whole sequences in one split.
        room: what there is to see; by default a room around the shots' cameras.
        size: ``(width, height)`` of the images, taken with :func:`default_intrinsics`.
        seed: of the room and of the sensor's noise.
        depth: also write ``.depth.png``: ``uint16`` millimetres, 65535 where there is nothing or it is farther.
        depth_every: that of frames whose number this divides, as real captures have it.

    Returns:
        The scene's folder. Beside the frames, ``scene.json`` says how it was made.

    Raises:
        InputError: if the folder exists, or the shots do not fit the layout.
    """
    sequences: dict[int, str] = {}
    for shot in shots:
        match = re.fullmatch(r"seq-(\d+)/frame-\d+\.color\.(png|jpg)", shot.image)
        if not match:
            raise InputError(f"{shot.image}: a 7-Scenes frame is named seq-NN/frame-NNNNNN.color.png; rename it")
        if sequences.setdefault(int(match[1]), shot.split) != shot.split:
            raise InputError(f"{shot.image}: 7-Scenes splits by whole sequences; put sequence {match[1]} in one split")

    def write_labels(image: Path, shot: Frame, depth_m: NDArray[np.float32]) -> None:
        stem = image.name.partition(".")[0]
        np.savetxt(image.with_name(f"{stem}.pose.txt"), shot.world_from_cam, fmt="% .10e", delimiter="\t")
        if depth and has_depth(shot, depth_every):
            _write_depth(folder / depth_file(shot), depth_m)

    with _new_folder(root, scene) as folder:
        _render_all(folder, shots, room, size, seed, write_labels)
        for split, title in _SPLIT_TITLES.items():
            lines = [f"sequence{number}\n" for number, of in sorted(sequences.items()) if of == split]
            (folder / f"{title}Split.txt").write_text("".join(lines))
    return root / scene


def write_cambridge(
    root: Path,
    scene: str,
    shots: Sequence[Frame],
    *,
    room: Room | None = None,
    size: tuple[int, int] = (320, 240),
    seed: int = 0,
    points: bool = False,
) -> Path:
    """Render a scene into ``root/scene`` as Cambridge Landmarks lays it out; the arguments of :func:`write_7scenes`.

    The label files hold the camera centre and the **world-to-camera** quaternion, as the official ones do. With
    ``points`` there is a ``reconstruction.nvm``, too; until it is written every depth is held, two bytes a pixel.
    """
    depths_m: dict[str, NDArray[np.float16]] = {}

    def keep_depth(image: Path, shot: Frame, depth_m: NDArray[np.float32]) -> None:
        depths_m[shot.image] = depth_m.astype(np.float16)

    with _new_folder(root, scene) as folder:
        _render_all(folder, shots, room, size, seed, keep_depth if points else None)
        if points:
            write_nvm(folder / "reconstruction.nvm", shots, depths_m, default_intrinsics(size), seed)
        for split in _SPLIT_TITLES:
            lines = [_cambridge_line(shot) for shot in shots if shot.split == split]
            (folder / f"dataset_{split}.txt").write_text(_CAMBRIDGE_HEADER + "".join(lines))
    return root / scene


def scene_note(shots: Sequence[Frame], size: tuple[int, int], seed: int) -> dict[str, Any]:
    """What ``scene.json`` says: enough to render the scene again, and that it is not the real one."""
    return {
        "rendered_by": "mambaloc.rendering",
        "generator_version": GENERATOR_VERSION,
        "seed": seed,
        "size_px": list(size),
        "intrinsics_px": default_intrinsics(size).tolist(),
        "frames": dict(Counter(shot.split for shot in shots)),
    }


def has_depth(shot: Frame, every: int) -> bool:
    """Whether a 7-Scenes frame is among those with depth: every so many-th of its sequence, by its number."""
    return int(Path(shot.image).name.partition(".")[0].removeprefix("frame-")) % every == 0


def depth_file(shot: Frame) -> str:
    """Where a 7-Scenes frame's depth lies, relative to the scene's folder."""
    return f"{shot.image.partition('.')[0]}.depth.png"


def add_depth(folder: Path, shots: Sequence[Frame], room: Room, size: tuple[int, int]) -> None:
    """Write the depth frames of some shots of a scene that is there already, each complete or not at all."""
    with TemporaryDirectory(prefix=".depth-", dir=folder) as draft, ThreadPoolExecutor(os.cpu_count()) as pool:

        def take(number: int) -> None:
            _, depth_m = render(room, default_intrinsics(size), shots[number].world_from_cam, size)
            _write_depth(Path(draft) / f"{number}.png", depth_m)
            (Path(draft) / f"{number}.png").replace(folder / depth_file(shots[number]))

        list(pool.map(take, range(len(shots))))


@contextmanager
def _new_folder(root: Path, scene: str) -> Iterator[Path]:
    """A folder to fill, which becomes ``root/scene`` when all went well."""
    if scene != Path(scene).name or scene in ("", "..") or scene.startswith("."):
        raise InputError(f"scene {scene!r}: must be the plain name of a folder; give one such as 'room'")
    if (root / scene).exists():
        raise InputError(f"{root / scene}: already exists; remove it, or choose another name or root")
    root.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=f".{scene}-", dir=root) as draft:
        folder = Path(draft) / scene
        folder.mkdir()
        yield folder
        try:
            folder.replace(root / scene)
        except OSError as error:
            raise InputError(f"{root / scene}: was created by another process ({error}); remove it") from None


def _render_all(
    folder: Path,
    shots: Sequence[Frame],
    room: Room | None,
    size: tuple[int, int],
    seed: int,
    write_labels: Callable[[Path, Frame, NDArray[np.float32]], None] | None = None,
) -> None:
    """Take every image into its file, and write what all layouts share."""
    if not shots:
        raise InputError(f"{folder.name}: a scene has at least one frame; give more poses")
    view = room or room_around(np.stack([shot.world_from_cam for shot in shots]), seed)
    intrinsics = default_intrinsics(size)
    lower, upper = view.inside_m

    def take(number: int) -> None:
        shot, image = shots[number], folder / shots[number].image
        # A label that is wrong by a mile still has an image: taken in the room, as the real ones were.
        seen_from = shot.world_from_cam.copy()
        seen_from[:3, 3] = np.clip(seen_from[:3, 3], lower, upper)
        rgb, depth_m = render(view, intrinsics, seen_from, size)
        rgb = sensor(rgb, np.random.default_rng([seed, number]))
        _write_image(image, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
        if write_labels:
            write_labels(image, shot, depth_m)

    for parent in {(folder / shot.image).parent for shot in shots}:
        parent.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        frames = pool.map(take, range(len(shots)))
        console = Console(stderr=True)
        for _ in track(frames, f"rendering {folder.name}", len(shots), console=console, transient=True):
            pass
    np.savetxt(folder / "camera-intrinsics.txt", intrinsics)
    (folder / "scene.json").write_text(json.dumps(scene_note(shots, size, seed), indent=2) + "\n")


def _write_image(path: Path, image: Image | NDArray[np.uint16]) -> None:
    options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if path.suffix == ".jpg" else []
    if not cv2.imwrite(str(path), image, options):
        raise OSError(f"{path}: could not be written")


def _write_depth(path: Path, depth_m: NDArray[np.float32]) -> None:
    depth_mm = np.where((depth_m > 0) & (depth_m < 65.535), depth_m * 1000, 65535)
    _write_image(path, depth_mm.astype(np.uint16))


def _cambridge_line(shot: Frame) -> str:
    # The inverse of a rotation is its transpose: the labels turn the world into the camera.
    cam_from_world = quaternion_from_matrix(shot.world_from_cam[:3, :3].T)
    numbers = [*shot.world_from_cam[:3, 3], *cam_from_world]
    return f"{shot.image} {' '.join(f'{number:.9f}' for number in numbers)}\n"
