"""The torch-free runtime against the system that a file was exported from."""

import json
import subprocess
import sys
from dataclasses import replace
from unittest import mock

import cv2
import numpy as np
import onnx
import pytest
import torch

from mambaloc.data.augmentation import center_crop
from mambaloc.errors import InputError
from mambaloc.export import contract_of, export_onnx
from mambaloc.geometry import canonical
from mambaloc.images import as_rgb, read_image
from mambaloc.models.student import LitStudent
from mambaloc.runtime import Contract, Localizer, PoseFilter, Preprocessing, frames_of, smooth
from mambaloc.runtime.sources import IMAGES_HZ
from mambaloc.runtime.video import localize_video

DATA = {"dataset": "7scenes", "scene": "heads", "short_side": 48}


@pytest.fixture(scope="module")
def student():
    torch.manual_seed(0)
    system = LitStudent(backbone="resnet10t", width=16, image_size=(40, 56))
    system.network.head.position_scale.fit(torch.randn(9, 3) * 4)
    with torch.no_grad():
        system.network.head.rotation[0].bias.zero_()
    system.provenance = {"commit": "abc", "seed": 3}
    return system.eval()


@pytest.fixture(scope="module")
def model(student, tmp_path_factory):
    path = tmp_path_factory.mktemp("runtime") / "model.onnx"
    export_onnx(student, path, contract_of(student, DATA))
    return path


def picture(height=90, width=120, seed=0):
    coarse = np.random.default_rng(seed).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)


def test_a_picture_is_localized_as_training_sees_it(student, model, tmp_path):
    rgb = picture()
    cv2.imwrite(str(tmp_path / "a.png"), rgb[..., ::-1])
    small = cv2.resize(rgb, (64, 48), interpolation=cv2.INTER_AREA)  # as the cache decodes frames
    with torch.no_grad():
        expected = student(center_crop(torch.from_numpy(small.transpose(2, 0, 1))[None], student.image_size))
    for given in (rgb, tmp_path / "a.png", str(tmp_path / "a.png")):
        found = Localizer(model).localize(given)
        np.testing.assert_allclose(found.position_m, expected.position_m[0], atol=1e-4)
        np.testing.assert_allclose(found.quaternion, canonical(expected.quaternion)[0], atol=1e-5)
        assert found.latency_s > 0


def test_the_contract_travels_with_the_model(student, model):
    contract = Localizer(model).contract
    assert contract == contract_of(student, DATA)
    assert contract.preprocessing == Preprocessing(48, (40, 56))
    assert contract.trained == {"commit": "abc", "seed": 3}
    assert Contract.from_json(contract.to_json(), "here") == contract


def test_the_runtime_needs_no_torch(model, map_of_den, tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), picture())
    program = (
        "import sys\nfor name in ('torch', 'rich', 'filelock', 'yaml', 'onnx'): sys.modules[name] = None\n"
        "import mambaloc\nfrom mambaloc.runtime import Localizer\n"
        f"localizer = Localizer({str(model)!r}, sparse_map={str(map_of_den)!r})\n"
        f"print(localizer.localize({str(tmp_path / 'a.png')!r}).position_m.tolist())\n"
        "heavy = {'lightning', 'timm', 'torchvision'} & set(sys.modules)\nassert not heavy, heavy"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert len(json.loads(result.stdout)) == 3


# --- images of every kind ------------------------------------------------------------------------------------------


def test_grey_and_transparent_pictures_are_rgb(model, tmp_path):
    grey = picture()[..., 0]
    as_three = np.repeat(grey[..., None], 3, axis=-1)
    expected = Localizer(model).localize(as_three)
    cv2.imwrite(str(tmp_path / "grey.png"), grey)
    cv2.imwrite(str(tmp_path / "rgba.png"), np.dstack([as_three, np.full_like(grey, 7)]))
    for given in (grey, grey[..., None], np.dstack([as_three, grey]), tmp_path / "grey.png", tmp_path / "rgba.png"):
        np.testing.assert_array_equal(Localizer(model).localize(given).position_m, expected.position_m)


def test_a_turned_photograph_is_made_upright(tmp_path):
    """EXIF orientation 6: the camera was turned, the image must be turned back by 90 degrees."""
    rgb = picture()
    _, jpeg = cv2.imencode(".jpg", rgb[..., ::-1])
    exif = (
        b"Exif\x00\x00II*\x00\x08\x00\x00\x00\x01\x00\x12\x01\x03\x00\x01\x00\x00\x00\x06\x00\x00\x00\x00\x00\x00\x00"
    )
    segment = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
    (tmp_path / "a.jpg").write_bytes(bytes(jpeg)[:2] + segment + bytes(jpeg)[2:])
    (tmp_path / "b.jpg").write_bytes(bytes(jpeg))
    turned = np.rot90(read_image(tmp_path / "b.jpg"), k=-1)
    np.testing.assert_array_equal(read_image(tmp_path / "a.jpg"), turned)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "cannot be decoded"),
        (b"no image", "cannot be decoded"),
        (None, "cannot be read"),
        ("half", "truncated"),
    ],
)
def test_what_is_no_picture(content, message, model, tmp_path):
    path = tmp_path / "bad.png"
    if content == "half":
        content = cv2.imencode(".png", picture())[1].tobytes()[:200]
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=message) as error:
        Localizer(model).localize(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize("array", [np.zeros((4, 4, 3)), np.zeros((4, 4, 2), np.uint8), np.zeros((0, 4, 3), np.uint8)])
def test_arrays_of_other_kinds_are_refused(array):
    with pytest.raises(InputError, match="give uint8 RGB"):
        as_rgb(array)


def test_a_picture_too_narrow_for_the_crop_is_refused(model):
    with pytest.raises(InputError, match="does not hold the model's crop of 56x40"):
        Localizer(model).localize(picture(120, 120))


def test_huge_and_tiny_pictures_are_localized(model):
    for size in ((3000, 4000), (6, 8)):
        assert np.isfinite(Localizer(model).localize(picture(*size)).position_m).all()


# --- models of every kind --------------------------------------------------------------------------------------------


def test_what_is_no_model(model, tmp_path):
    def refused(path, message):
        with pytest.raises(InputError, match=message) as error:
            Localizer(path)
        assert "\n" not in str(error.value)

    refused(tmp_path / "nothing.onnx", "no such model")
    refused(tmp_path, "contains no model.onnx")
    refusal = RuntimeError("Load model failed:\nProtobuf parsing failed.")  # as ONNX Runtime refuses a damaged file
    with mock.patch("onnxruntime.InferenceSession", side_effect=refusal):
        refused(model, r"ONNX Runtime cannot load it \(Load model failed:\); export it again")
    plain = onnx.load(model)
    del plain.metadata_props[:]
    onnx.save(plain, tmp_path / "plain.onnx")
    refused(tmp_path / "plain.onnx", "has no contract")
    other = onnx.load(model)
    for change in ({"crop": (8, 8)}, {"in_model": True}):
        contract = Localizer(model).contract
        told = replace(contract, preprocessing=replace(contract.preprocessing, **change))
        other.metadata_props[0].value = told.to_json()
        onnx.save(other, tmp_path / "other.onnx")
        refused(tmp_path / "other.onnx", "does not match its contract")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"contract": 2}, "version 2, but version 1 is expected"),
        ({"preprocessing": {"short_side": 48}}, "cannot be read"),
        ({"preprocessing": {"short_side": 48, "crop": [1, 2, 3], "in_model": False}}, "cannot be read"),
        ({"trained": 3}, "cannot be read"),
        ({"preprocessing": {"short_side": 48, "crop": [0, 9], "in_model": False}}, "pixels go from 1"),
        ({"preprocessing": {"short_side": 10**9, "crop": [9, 9], "in_model": False}}, "pixels go from 1"),
        ({"preprocessing": {"short_side": 48, "crop": [float("inf"), 9], "in_model": False}}, "cannot be read"),
    ],
)
def test_contracts_are_checked(change, message, student):
    contract = json.loads(contract_of(student, DATA).to_json())
    with pytest.raises(InputError, match=message):
        Contract.from_json(json.dumps({**contract, **change}), "contract.json")
    with pytest.raises(InputError, match="cannot be read"):
        Contract.from_json("{", "contract.json")


# --- sources ---------------------------------------------------------------------------------------------------------


def test_a_folder_is_read_by_name(tmp_path):
    for name, seed in (("b.png", 1), ("a.png", 0), ("c.txt", 2)):
        (tmp_path / name).write_bytes(cv2.imencode(".png", picture(seed=seed))[1].tobytes())
    frames, count = frames_of(tmp_path)
    listed = list(frames)
    assert count == 2
    assert [(frame.name, frame.time_s) for frame in listed] == [("a.png", 0.0), ("b.png", 1 / IMAGES_HZ)]
    assert [frame.time_s for frame in frames_of(tmp_path, images_hz=8)[0]] == [0, 1 / 8]
    np.testing.assert_array_equal(listed[0].image[..., ::-1], picture(seed=0))


def test_a_video_is_read_with_its_times(tmp_path):
    writer = cv2.VideoWriter(str(tmp_path / "film.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10, (120, 90))
    for seed in range(4):
        writer.write(picture(seed=seed)[..., ::-1])
    writer.release()
    frames, count = frames_of(tmp_path / "film.avi")
    listed = list(frames)
    assert count == len(listed) == 4
    assert [frame.time_s for frame in listed] == pytest.approx([0, 0.1, 0.2, 0.3], abs=1e-3)
    assert np.abs(listed[2].image.astype(int) - picture(seed=2)).mean() < 6  # JPEG


class FakeCapture:
    """A stream of four frames with the time stamps that it is told to have."""

    def __init__(self, stamps_ms, fps):
        self.left, self.fps, self.stamp_ms = list(stamps_ms), fps, 0.0

    def isOpened(self):
        return True

    def read(self):
        if not self.left:
            return False, None
        self.stamp_ms = self.left.pop(0)
        return True, picture()

    def get(self, what):
        return {cv2.CAP_PROP_FPS: self.fps, cv2.CAP_PROP_POS_MSEC: self.stamp_ms}.get(what, 0.0)

    def release(self):
        pass


@pytest.mark.parametrize(
    ("stamps_ms", "fps", "times_s"),
    [
        ([0, 0, 0, 0], 20, [0, 0.05, 0.1, 0.15]),  # a raw stream has none
        ([0, 0, 0, 0], 0, [0, 1 / 30, 2 / 30, 3 / 30]),
        ([500, 600, 0, 800], 10, [0, 0.1, 0.2, 0.3]),
    ],
)
def test_times_grow_where_stamps_do_not(stamps_ms, fps, times_s, tmp_path, monkeypatch):
    (tmp_path / "film.h264").write_bytes(b"any")
    monkeypatch.setattr(cv2, "VideoCapture", lambda what: FakeCapture(stamps_ms, fps))
    assert [frame.time_s for frame in frames_of(tmp_path / "film.h264")[0]] == pytest.approx(times_s)


def test_a_cameras_times_are_the_clocks(monkeypatch):
    clock_s = iter([100.0, 100.1, 100.4, 100.5])
    monkeypatch.setattr(cv2, "VideoCapture", lambda what: FakeCapture([0] * 4, 30))
    monkeypatch.setattr("mambaloc.runtime.sources.time.monotonic", lambda: next(clock_s))
    assert [frame.time_s for frame in frames_of("0")[0]] == pytest.approx([0, 0.1, 0.4, 0.5])


def test_a_source_is_localized_frame_by_frame(model, tmp_path):
    for name, seed in (("a.png", 0), ("b.png", 1)):
        cv2.imwrite(str(tmp_path / name), picture(seed=seed)[..., ::-1])
    localizer = Localizer(model)
    found = list(localizer.localize_each(tmp_path))
    assert [time_s for time_s, _ in found] == [0, 1 / IMAGES_HZ]
    np.testing.assert_array_equal(found[1][1].position_m, localizer.localize(picture(seed=1)).position_m)
    slower = localizer.localize_each(frames_of(tmp_path, images_hz=8)[0])
    assert [time_s for time_s, _ in slower] == [0, 1 / 8]


def test_what_was_found_before_a_bad_picture_is_kept(model, tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), picture())
    (tmp_path / "b.png").write_bytes(b"noise")
    out = tmp_path / "poses.tum"
    with pytest.raises(InputError, match=r"b\.png: image cannot be decoded"):
        localize_video(Localizer(model), str(tmp_path), out)
    assert len(out.read_text().splitlines()) == 2  # a comment, and the first


@pytest.fixture
def pictures(tmp_path):
    folder = tmp_path / "pictures"
    folder.mkdir()
    for seed in range(40):
        cv2.imwrite(str(folder / f"{seed:02d}.png"), picture(seed=seed)[..., ::-1])
    return folder


@pytest.mark.parametrize("filtering", ["causal", "smooth"])
def test_a_filters_poses_are_written(filtering, model, pictures, tmp_path):
    found = [pose for _, pose in Localizer(model).localize_each(pictures)]
    positions_m, quaternions = (np.stack([getattr(p, of) for p in found]) for of in ("position_m", "quaternion"))
    times_s = np.arange(40) / 30
    if filtering == "smooth":
        expected = smooth(times_s, positions_m, quaternions)
    else:
        keep = PoseFilter()
        expected = [keep.update(*pose) for pose in zip(times_s, positions_m, quaternions, strict=True)]
    done = localize_video(Localizer(model), str(pictures), tmp_path / "poses.tum", filtering)
    written = np.loadtxt(tmp_path / "poses.tum")
    assert (done.count, done.outliers) == (40, sum(pose.is_outlier for pose in expected))
    np.testing.assert_allclose(written[:, 0], times_s, atol=1e-8)  # what the filter was given
    np.testing.assert_allclose(written[:, 1:4], [pose.position_m for pose in expected], atol=1e-6)
    np.testing.assert_allclose(written[:, [7, 4, 5, 6]], [pose.quaternion for pose in expected], atol=1e-6)
    jerks = (np.abs(np.diff(way, 2, axis=0)).mean() for way in (written[:, 1:4], positions_m))
    assert next(jerks) < 0.8 * next(jerks)


@pytest.mark.parametrize("filtering", [None, "causal", "smooth"])
def test_ctrl_c_writes_what_was_found(filtering, model, pictures, tmp_path, monkeypatch):
    localizer = Localizer(model)
    localize, left = localizer.localize, iter(range(5))

    def interrupted(image, *how):
        if next(left, None) is None:
            raise KeyboardInterrupt
        return localize(image, *how)

    monkeypatch.setattr(localizer, "localize", interrupted)
    assert localize_video(localizer, str(pictures), tmp_path / "poses.tum", filtering).count == 5
    assert np.loadtxt(tmp_path / "poses.tum").shape == (5, 8)


def test_where_poses_go_is_asked_before_the_work(model, tmp_path):
    for out in (tmp_path, tmp_path / "none/poses.tum"):
        with pytest.raises(InputError, match=r"--out .*: its folder does not exist"):
            localize_video(Localizer(model), "nothing at all", out)


def test_what_is_no_source(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "film.mp4").write_bytes(b"no video")
    for source, message in (("empty", "contains no image"), ("film.mp4", "cannot be opened"), ("none", "no such file")):
        with pytest.raises(InputError, match=message):
            frames_of(tmp_path / source)
    for rate_hz in (0, -1, float("nan"), float("inf")):
        with pytest.raises(InputError, match="must be a positive number of frames per second"):
            frames_of(tmp_path, images_hz=rate_hz)
