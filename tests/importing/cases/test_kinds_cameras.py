"""Generated captures of each kind: cameras against colours that say what a pixel sees, paths against strings."""

from __future__ import annotations

import os
import string
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import pytest
from captures import capture_of, line, poses_at
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mambaloc.errors import InputError
from mambaloc.importing.capture import Camera
from mambaloc.importing.formats.finding import find_images
from mambaloc.importing.undistort.fitting import common_sizes, fitted
from mambaloc.importing.undistort.images import write_images
from mambaloc.runtime.camera_models import OpenCVModel

SPREAD = 90.0  # grey levels a unit of ray

# --- cameras ---------------------------------------------------------------------------------------------------------


def seen(width, height, focal, center, k1):
    """An image whose red and green say where the ray of a pixel meets the plane at depth 1."""
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    rays = np.stack(((columns - center[0]) / focal[0], (rows - center[1]) / focal[1]), axis=-1)
    ideal = rays.copy()
    for _ in range(60):  # Brown's model undone by fixed-point iteration
        ideal = rays / (1 + k1 * (ideal**2).sum(axis=-1, keepdims=True))
    image = np.full((height, width, 3), 128, np.uint8)
    image[..., 2:0:-1] = np.clip(np.rint(128 + SPREAD * ideal), 0, 255)  # BGR
    return image


@st.composite
def devices(draw):
    """Cameras of (width, height, focal, centre from the corner, k1) for images of (width, height), of their shape."""
    width, height = draw(st.sampled_from([(48, 36), (36, 48), (64, 36), (40, 40)]))
    width, height = width + draw(st.integers(-1, 1)), height + draw(st.integers(-1, 1))
    scale = draw(st.sampled_from([1, 1, 1, 2, 4]))
    fx, fy = (draw(st.floats(0.8, 1.3)) * width * scale for _ in range(2))
    cx, cy = (draw(st.floats(0.45, 0.55)) * side * scale for side in (width, height))
    return (width, height), (width * scale, height * scale, (fx, fy), (cx, cy), draw(st.sampled_from([0.0, -0.08])))


@settings(max_examples=25, deadline=None)
@given(devices=st.lists(devices(), min_size=1, max_size=5))
def test_written_pictures_show_what_their_cameras_say(devices):
    """Whatever sizes are mixed: scaled, cropped and undistorted, a pixel's colour is that of its ray."""
    with TemporaryDirectory() as name:
        folder, cameras, images = Path(name), {}, []
        for number, (size, (width, height, focal, center, k1)) in enumerate(devices):
            scale = size[0] / width
            middle = tuple(at * scale - 0.5 for at in center)
            images.append(folder / f"{number}.png")
            cv2.imwrite(str(images[-1]), seen(*size, [f * scale for f in focal], middle, k1))
            center_px = (center[0] - 0.5, center[1] - 0.5)
            lens = OpenCVModel(focal, center_px, (k1, 0, 0, 0, 0)) if k1 else None
            cameras[f"camera-{number}"] = Camera(width, height, focal, center_px, lens)
        capture = capture_of(
            poses_at(line(len(images))), images=tuple(images), cameras=cameras, camera_of=tuple(cameras)
        )
        written = write_images(capture, folder / "out")
        assert written.rules == {}
        assert len(written.capture.images) == len(devices)
        for image, camera_name, size in zip(
            written.capture.images, written.capture.camera_of, written.sizes, strict=True
        ):
            camera = written.capture.cameras[camera_name]
            shown = cv2.imread(str(image)).astype(float)
            assert shown.shape[1::-1] == size == (camera.width, camera.height)
            columns, rows = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
            for color, places, focal, center in zip(
                (2, 1), (columns, rows), camera.focal_px, camera.center_px, strict=True
            ):
                off = np.abs(shown[..., color] - (128 + SPREAD * (places - center) / focal))
                assert off.max() < 1.6  # two roundings, and the border's last hundredth of a pixel


@settings(max_examples=100)
@given(st.lists(st.tuples(st.integers(20, 60), st.integers(20, 60)), min_size=1, max_size=12))
def test_sizes_are_cropped_a_little_and_to_few(sizes):
    found = common_sizes(sizes)
    assert set(found) == set(sizes)
    for (width, height), (crop_width, crop_height) in found.items():
        assert 0.89 * width <= crop_width <= width
        assert 0.89 * height <= crop_height <= height
    most = max(sizes, key=sizes.count)
    near = [(w, h) for w, h in sizes if abs(w - most[0]) <= 0.05 * most[0] and abs(h - most[1]) <= 0.05 * most[1]]
    if sizes.count(most) > max([0, *(sizes.count(size) for size in set(sizes) - {most})]):
        assert {found[size] for size in near} == {(min(w for w, _ in near), min(h for _, h in near))}


@given(width=st.integers(100, 5000), height=st.integers(100, 5000), by=st.sampled_from([2, 3, 4, 8]), up=st.booleans())
def test_a_side_may_be_rounded_either_way(width, height, by, up):
    camera = Camera(width, height, (100.0, 100.0), (width / 2 - 0.5, height / 2 - 0.5))
    small = tuple(-(-side // by) if up else side // by for side in (width, height))
    found = fitted(camera, small)
    assert found is not None
    assert found.center_px == pytest.approx((small[0] / 2 - 0.5, small[1] / 2 - 0.5))
    assert found.focal_px == pytest.approx((100 * small[0] / width, 100 * small[1] / height))
    assert fitted(camera, (small[0], small[1] + 4 + small[1] // 4)) is None


# --- paths -----------------------------------------------------------------------------------------------------------

WORDS = st.sampled_from(["images", "rgb", "cam 0", "a", "Räume", "x(1)"])
FILES = st.sampled_from(["1.png", "2.png", "IMG 3.JPG", "é.png"])
PREFIXES = st.sampled_from(
    ["", "./", "../", "./../", "C:\\scans\\room\\", "D:/", "/home/user/data/", "\\\\server\\share\\", "old/place/"]
)


def by_strings(name: str, files: list[str]) -> set[str]:
    """The files that have the longest end in common with a name."""
    parts = [part for part in name.replace("\\", "/").split("/") if part not in ("", ".")]
    for length in range(len(parts), 0, -1):
        end = "/".join(parts[-length:]).casefold()
        found = {file for file in files if f"/{file}".casefold().endswith(f"/{end}")}
        if found:
            return found
    return set()


@settings(max_examples=100, deadline=None)
@given(
    files=st.lists(st.tuples(st.lists(WORDS, max_size=2), FILES), min_size=1, max_size=6, unique_by=str),
    prefix=PREFIXES,
    data=st.data(),
)
def test_a_picture_is_found_by_the_longest_end_of_its_path(files, prefix, data):
    paths = ["/".join((*folders, name)) for folders, name in files]
    told = data.draw(st.sampled_from(paths))
    dropped = data.draw(st.integers(0, told.count("/")))
    name = prefix + "/".join(told.split("/")[dropped:])
    if "\\" in prefix:
        name = name.replace("/", "\\")
    with TemporaryDirectory() as folder:
        root = Path(folder) / "root"
        for path in paths:
            (root / path).parent.mkdir(parents=True, exist_ok=True)
            (root / path).touch()
        (Path(folder) / told.split("/")[-1]).touch()  # outside of the root, where ../ would lead
        expected = by_strings(name, paths)
        if prefix in ("", "./") and name.removeprefix("./") in paths:  # it is where it says
            expected = {name.removeprefix("./")}
        exact = {path for path in expected if path.split("/")[-1] == told.split("/")[-1]}
        expected = exact if len(exact) == 1 else expected
        if len(expected) > 1:
            with pytest.raises(InputError, match=r"which may be .* or .* in .*\. Give the folder of the images with"):
                find_images(root, [(name, "here")])
        else:
            (found,) = find_images(root, [(name, "here")]).files
            assert {found.relative_to(root).as_posix()} == expected


def test_a_bare_name_does_not_stand_for_another_folders_picture(tmp_path):
    """Frames of one recording are numbered as another's: without its folder an image stays missing."""
    for path in ("seq2/1.png", "seq3/1.png", "seq3/2.png"):
        (tmp_path / path).parent.mkdir(exist_ok=True)
        (tmp_path / path).touch()
    found = find_images(tmp_path, [("seq1/1.png", "a"), ("seq3/1.png", "b"), ("seq3/2.png", "c")])
    assert [file.is_file() for file in found.files] == [False, True, True]
    assert found.elsewhere == ""


def test_links_that_lead_out_are_not_searched(tmp_path):
    (tmp_path / "root/images").mkdir(parents=True)
    (tmp_path / "secret").mkdir()
    (tmp_path / "secret/key.png").touch()
    (tmp_path / "root/folder").symlink_to(tmp_path / "secret")
    (tmp_path / "root/images/key.png").symlink_to(tmp_path / "secret/key.png")
    with pytest.raises(InputError, match="which is not a file inside"):
        find_images(tmp_path / "root", [("/home/user/images/key.png", "here")])


def made(root: Path, *paths: str) -> Path:
    for path in paths:
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        (root / path).touch()
    return root


@pytest.mark.parametrize(
    ("name", "files", "place"),
    [
        ("images/1.jpg", ["images_4/1.png"], "images_4/1.png"),
        ("images/1.jpg", ["images_8/1.png", "images_2/1.png"], "images_2/1.png"),
        ("C:\\scans\\images\\1.jpg", ["room/images_4/1.png", "depth/1.png"], "room/images_4/1.png"),
        ("images/1.JPG", ["1.webp", "depth/1.png"], "1.webp"),
        ("images/1.jpg", ["images/1.png", "images_4/1.jpg"], "images_4/1.jpg"),
    ],
)
def test_a_picture_with_another_suffix_is_found_by_its_stem(tmp_path, name, files, place):
    found = find_images(made(tmp_path, *files), [(name, "here")])
    assert found.files == (tmp_path / place,)
    assert found.missing == frozenset()
    assert found.elsewhere.endswith(f" is {place}") or Path(name).name == Path(place).name


def test_a_stem_of_several_pictures_or_of_another_folder_is_not_taken(tmp_path):
    """A folder of another name may hold depth."""
    made(tmp_path, "images_4/1.png", "images_4/1.webp", "depth/2.png", "cam/3.jpg", "cam_2/3.jpg")
    with pytest.raises(InputError, match=r"may be images_4/1\.png or images_4/1\.webp"):
        find_images(tmp_path, [("images/1.jpg", "here")])
    with pytest.raises(InputError, match=r"^\S+: has no image with a pose; 1 are named and missing") as refusal:
        find_images(tmp_path, [("images/2.jpg", "here")])
    assert str(refusal.value).count("--images") == 1
    made(tmp_path, "masks/4.jpg")
    with pytest.raises(InputError, match=r"has no image with a pose; 1 are named and missing, such as '4\.jpg'"):
        find_images(tmp_path, [("4.jpg", "here")])
    with pytest.raises(InputError, match=r"may be cam/3\.jpg or cam_2/3\.jpg"):
        find_images(tmp_path, [("3.jpg", "here")])


# --- texts of COLMAP -------------------------------------------------------------------------------------------------

NAMES = st.text(string.ascii_letters + string.digits + " ()[]{}#,;'-_äß日", min_size=1, max_size=12).map(
    lambda text: f"{text.strip() or 'a'}.jpg"
)
EOLS = st.sampled_from(["\n", "\r\n"])


@settings(max_examples=60, deadline=None)
@given(
    names=st.lists(NAMES, min_size=1, max_size=5, unique=True),
    points=st.lists(st.sampled_from([None, "", "1.5 2.5 -1", "1 2 7 3 4 -1 5 6 -1 7 8 9"]), min_size=5, max_size=5),
    eol=EOLS,
    exponents=st.booleans(),
    has_points=st.booleans(),
    encoding=st.sampled_from(["utf-8", "utf-8-sig", "utf-16"]),
)
@example(["a b.jpg", "c.jpg"], [None] * 5, "\r\n", True, False, "utf-16")
def test_a_text_model_is_read_whole(names, points, eol, exponents, has_points, encoding):
    """``None`` of points is a second line that was left out."""
    pytest.importorskip("pycolmap", reason="pycolmap, the extra [colmap], reads the models")
    from mambaloc.data.colmap import load_colmap

    lines = ["# Image list"]
    for number, (name, seen_points) in enumerate(zip(names, points, strict=False), start=1):
        x = f"{number}.25000e+000" if exponents else str(number + 0.25)
        lines += [f"{number} 1 0 0 0 {x} 2 3 1 {name}", *([] if seen_points is None else [seen_points])]
    texts = {"cameras.txt": f"1 PINHOLE 160 120 144 144 80 60{eol}", "images.txt": eol.join(lines) + eol}
    if has_points:
        texts["points3D.txt"] = f"# none{eol}"
    with TemporaryDirectory() as folder:
        for file, text in texts.items():
            (Path(folder) / file).write_bytes(text.encode(encoding))
        images = load_colmap(Path(folder)).images
    assert {number: image.name for number, image in images.items()} == dict(enumerate(names, start=1))
    for number, image in images.items():
        np.testing.assert_allclose(image.cam_from_world().translation, (number + 0.25, 2, 3))
        assert len(image.points2D) == len((points[number - 1] or "").split()) // 3


def test_a_failing_search_walks_the_folder_once(tmp_path, monkeypatch):
    walks, walk = [], os.walk
    monkeypatch.setattr(os, "walk", lambda top: walks.append(top) or walk(top))
    made(tmp_path, "images/1.png")
    with pytest.raises(InputError, match=r"such as 'images/2\.png', while 'images/1\.png' is there"):
        find_images(tmp_path, [("images/2.png", "here")])
    assert walks == [tmp_path]
