"""Images without poses: frames chosen for sharpness and movement, and posed where they were taken."""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
from rich.progress import Progress
from scipy.spatial.transform import Rotation

from mambaloc.errors import InputError
from mambaloc.importing.frame_choice import FAR, NEAR, Reference, choose_frames, sharpness, small_grey
from mambaloc.importing.registry import read_capture
from mambaloc.importing.sfm import process
from mambaloc.importing.sfm.process import Job
from mambaloc.importing.sfm.structure import read_structure
from mambaloc.rendering import default_intrinsics, furnished_room, render, smooth_trajectory
from mambaloc.runtime.sources import SourceFrame

SIZE = (320, 240)
INSIDE_M = ((-1.25, -1.0, 1.1), (1.25, 1.0, 1.7))
FILM_FRAMES = 48


# --- which frames ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def wall():
    """A wide image with texture of several sizes, to move along."""
    rng = np.random.default_rng(0)
    octaves = [rng.integers(0, 256, (6 * k, 30 * k, 3)).astype(np.float32) for k in (1, 3, 10)]
    layers = [cv2.resize(octave, (1800, 360), interpolation=cv2.INTER_CUBIC) for octave in octaves]
    return np.clip(np.mean(layers, axis=0), 0, 255).astype(np.uint8)


def film(wall, shifts, blurred=()):
    for number, shift in enumerate(shifts):
        view = wall[:, shift : shift + 480]
        view = cv2.GaussianBlur(view, (0, 0), 3) if number in blurred else view
        yield SourceFrame(str(number), number / 10, np.ascontiguousarray(view))


def test_displacement_is_the_shift(wall):
    first, second = (small_grey(wall[:, shift : shift + 480]) for shift in (0, 36))
    assert Reference(first).displacement(second) == pytest.approx(36 / 480, abs=0.002)
    assert Reference(first).displacement(first) == pytest.approx(0, abs=1e-4)
    assert Reference(first).displacement(small_grey(wall[:, 900:1380])) == np.inf
    assert Reference(first).displacement(np.zeros_like(first)) == np.inf
    assert Reference(np.zeros_like(first)).displacement(first) == 0


def test_a_camera_at_rest_is_one_frame(wall):
    assert [frame.name for frame in choose_frames(film(wall, [0] * 20))] == ["0"]


def test_chosen_frames_are_apart_by_no_less_and_no_more(wall):
    shifts = np.cumsum(np.random.default_rng(1).integers(0, 13, 80)).tolist()
    chosen = [int(frame.name) for frame in choose_frames(film(wall, shifts))]
    steps = np.diff([shifts[number] for number in chosen]) / 480
    assert len(chosen) > 8
    assert (steps > NEAR - 0.003).all()
    assert (steps < FAR + 0.03).all()  # a frame's own movement comes on top


def test_the_sharpest_of_each_stretch_is_chosen(wall):
    shifts = list(range(0, 700, 7))  # from four to six of them to a stretch
    blurred = {number for number in range(len(shifts)) if number % 3}
    chosen = [int(frame.name) for frame in choose_frames(film(wall, shifts, blurred))]
    assert len(chosen) > 10
    assert not blurred & set(chosen[:-1])  # the last stretch ends with the video, after a frame or two


def test_a_jump_is_followed(wall):
    chosen = [int(frame.name) for frame in choose_frames(film(wall, [0] * 5 + [900] * 5))]
    assert chosen[0] < 5 <= chosen[-1]


def test_blur_is_less_sharp(wall):
    grey = small_grey(wall[:, :480])
    assert sharpness(cv2.GaussianBlur(grey, (0, 0), 2)) < sharpness(grey) / 4


# --- poses -----------------------------------------------------------------------------------------------------------


def aligned(found, true):
    """Umeyama (1991): the similarity that takes found centres onto the true ones; scale, rotation, translation."""
    found_mean, true_mean = found.mean(axis=0), true.mean(axis=0)
    rotation, _ = Rotation.align_vectors(true - true_mean, found - found_mean)
    turned = rotation.apply(found - found_mean)
    scale = (turned * (true - true_mean)).sum() / (turned**2).sum()
    return scale, rotation, true_mean - scale * rotation.apply(found_mean)


def errors(capture, true):
    """Per frame: position in m and rotation in degrees after alignment, and the extent of the true centres."""
    centers = capture.world_from_cam[:, :3, 3]
    scale, rotation, translation = aligned(centers, true[:, :3, 3])
    position_m = np.linalg.norm(scale * rotation.apply(centers) + translation - true[:, :3, 3], axis=1)
    turns = (rotation * Rotation.from_matrix(capture.world_from_cam[:, :3, :3])).inv()
    rotation_deg = np.degrees((turns * Rotation.from_matrix(true[:, :3, :3])).magnitude())
    extent_m = np.linalg.norm(np.ptp(true[:, :3, 3], axis=0))
    return position_m, rotation_deg, extent_m


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """A video of a room, where each of its frames and others after it was taken, and the images of all."""
    poses = smooth_trajectory(72, seed=5, inside_m=INSIDE_M, step_deg=1.5)
    room = furnished_room(INSIDE_M, seed=0, px_per_m=140)
    pictures = [render(room, default_intrinsics(SIZE), pose, SIZE)[0] for pose in poses]
    path = tmp_path_factory.mktemp("film") / "room.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 15, SIZE)
    for rgb in pictures[:FILM_FRAMES]:
        writer.write(rgb[..., ::-1])
    writer.release()
    return path, poses, pictures


@pytest.mark.slow
def test_a_film_is_posed_where_it_was_taken(walk):
    pytest.importorskip("pycolmap", reason="structure from motion is pycolmap's, the extra [colmap]")
    path, poses, _ = walk
    capture = read_capture(path)
    assert (capture.kind, capture.unit) == ("structure_from_motion", "unknown")
    numbers = [int(image.stem) for image in capture.images]
    np.testing.assert_allclose(capture.time_s, np.array(numbers) / 15, atol=1e-3)
    assert numbers == sorted(numbers)
    position_m, rotation_deg, extent_m = errors(capture, poses[numbers])
    print(capture.choices, f"{position_m.max():.4f} m of {extent_m:.2f} m, {rotation_deg.max():.3f} deg")
    assert position_m.max() < 0.02 * extent_m
    assert rotation_deg.max() < 1  # mostly the turn of the whole that centimetres make of it
    assert "registered" in capture.choices
    (camera,) = capture.cameras.values()
    assert camera.focal_px[0] == pytest.approx(default_intrinsics(SIZE)[0, 0], rel=0.03)


@pytest.mark.slow
def test_a_few_photographs_are_posed_alike_twice(walk, tmp_path):
    pytest.importorskip("pycolmap", reason="structure from motion is pycolmap's, the extra [colmap]")
    _, poses, pictures = walk
    chosen = range(0, 72, 6)
    for number in chosen:
        cv2.imwrite(str(tmp_path / f"{number}.jpg"), pictures[number][..., ::-1])
    first = read_structure(tmp_path)
    assert first.choices["frames"] == f"all {len(chosen)} photos"
    assert first.time_s is None
    rows = [list(chosen)[int(image.stem)] for image in first.images]
    position_m, rotation_deg, extent_m = errors(first, poses[rows])
    assert position_m.max() < 0.03 * extent_m
    assert rotation_deg.max() < 1
    kept = first.images[0].parents[1]
    assert read_structure(tmp_path).images == first.images  # found again
    shutil.rmtree(kept)
    again = read_structure(tmp_path, threads=1)
    np.testing.assert_array_equal(again.world_from_cam, first.world_from_cam)


def test_too_few_frames_are_refused_with_advice(tmp_path, refused):
    pytest.importorskip("pycolmap", reason="structure from motion is pycolmap's, the extra [colmap]")
    grey = np.full((60, 80, 3), 128, np.uint8)
    for number in range(3):
        cv2.imwrite(str(tmp_path / f"{number}.jpg"), grey)
    refused(read_structure, tmp_path, "shows 3 frames that differ, of 5 at least", "sideways")
    for number in range(3, 8):
        cv2.imwrite(str(tmp_path / f"{number}.jpg"), grey)
    refused(read_structure, tmp_path, "only 0 of 8 frames could be placed", "sideways")
    (tmp_path / "7.jpg").write_bytes(b"no image")
    refused(read_structure, tmp_path, "7.jpg: image cannot be decoded")


def job_of(folder, names=("0.jpg",)):
    (folder / "images").mkdir()
    return Job(folder / "images", names, folder / "out", one_camera=True, neighbours=None, threads=1, seed=0)


@pytest.mark.parametrize(
    ("ends", "says"),
    [
        ("print('free(): invalid pointer', file=sys.stderr); os.kill(os.getpid(), 9)", "SIGKILL, free(): invalid"),
        ("sys.exit(3)", "(exit code 3)"),
        ("print('*** Aborted at 5', file=sys.stderr); raise OSError('no space')", "exit code 1, OSError: no space"),
    ],
)
def test_a_process_that_ends_is_a_line(tmp_path, monkeypatch, ends, says):
    """COLMAP's process may end at any step; ours goes on. What ends here is a program of the test's own."""
    program = tmp_path / "program.py"
    program.write_text(f'import os, sys; print(\'{{"step": "Matching frames"}}\', flush=True); {ends}')
    monkeypatch.setattr(process, "_PROGRAM", program)
    with Progress(disable=True) as progress, pytest.raises(InputError) as caught:
        process.reconstruct(job_of(tmp_path), tmp_path / "a.mp4", "film slowly", progress)
    message = str(caught.value)
    assert says in message
    assert "ended at 'Matching frames'" in message
    assert "\n" not in message
    assert {path.name for path in tmp_path.iterdir()} == {"images", "program.py"}  # its database is gone


def test_progress_of_the_process_is_passed_on(tmp_path, monkeypatch):
    program, line = tmp_path / "program.py", "print(json.dumps({}))\n"
    told = [{"step": "Placing frames", "of": 3}, {"advance": 1}, {"advance": 1}, {"placed": 2}]
    program.write_text("import json\n" + "".join(line.format(message) for message in told))
    monkeypatch.setattr(process, "_PROGRAM", program)
    with Progress(disable=True) as progress:
        assert process.reconstruct(job_of(tmp_path), tmp_path, "", progress) == 2
    assert [(task.description, task.completed, task.total) for task in progress.tasks][1:] == [("Placing frames", 2, 3)]


def test_what_colmap_throws_is_passed_on(tmp_path):
    pytest.importorskip("pycolmap", reason="structure from motion is pycolmap's, the extra [colmap]")
    job = replace(job_of(tmp_path), seed=-5)  # COLMAP asks for a seed of at least -1
    with Progress(disable=True) as progress, pytest.raises(InputError, match=r"COLMAP stopped \(.+\); film slowly"):
        process.reconstruct(job, tmp_path, "film slowly", progress)


def test_the_process_holds_no_opencv():
    """Guess: pycolmap and OpenCV get along. Each holds a copy of zlib: pycolmap 4.2.1 loaded before OpenCV 5.0 ends a
    process at its next PNG."""
    pytest.importorskip("pycolmap", reason="structure from motion is pycolmap's, the extra [colmap]")
    code = (
        f"import runpy, sys; runpy.run_path({str(process._PROGRAM)!r}); import pycolmap;"
        "sys.exit(any(name in sys.modules for name in ('cv2', 'mambaloc', 'torch', 'PIL')))"
    )
    assert subprocess.run([sys.executable, "-P", "-c", code], check=False).returncode == 0


def test_a_model_is_read_with_opencv_loaded_first():
    """Our own process reads models by pycolmap: OpenCV, which then finds its own zlib, is there before."""
    pytest.importorskip("pycolmap", reason="needs pycolmap, the extra [colmap]")
    code = (
        "import sys; from pathlib import Path; from mambaloc.data.colmap import import_pycolmap;"
        "assert 'cv2' in sys.modules; import_pycolmap(Path('a'));"
        "import cv2, numpy; print(len(cv2.imencode('.png', numpy.eye(64, dtype=numpy.uint8))[1]) > 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert (done.returncode, done.stdout.strip()) == (0, "True")


def test_what_is_no_film(tmp_path, refused):
    pytest.importorskip("pycolmap", reason="structure from motion is pycolmap's, the extra [colmap]")
    (tmp_path / "a.mp4").write_bytes(b"no video")
    refused(read_structure, tmp_path / "a.mp4", "cannot be opened")
    refused(read_structure, tmp_path / "none", "no folder contains an image")


def test_without_pycolmap_the_extra_is_named(tmp_path, refused, monkeypatch):
    (tmp_path / "a.jpg").touch()
    monkeypatch.setitem(__import__("sys").modules, "pycolmap", None)
    refused(read_structure, tmp_path, "pip install 'mambaloc[colmap]'")
