"""Images as a camera stores them become those of a pinhole: against OpenCV, and against colours that name a ray."""

from __future__ import annotations

import copy
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from test_other_lenses import CONTRACT

from mambaloc.errors import InputError
from mambaloc.export.pages import TARGETS, write_pages
from mambaloc.runtime.camera_models import FisheyeModel, OpenCVModel, Pinhole
from mambaloc.runtime.contract import Contract
from mambaloc.runtime.localization import Localization
from mambaloc.runtime.localizer import Localizer
from mambaloc.runtime.undistortion import Undistortion, sampled_at, undistorted

STORED = (320, 240)
FOCAL, CENTER = (250.0, 245.0), (152.0, 123.0)
PINHOLE = Undistortion(
    OpenCVModel(FOCAL, CENTER, (-0.2, 0.05, 0.003, -0.002, 0.01)), STORED, Pinhole(*STORED, (275.0, 269.5), CENTER), ""
)
FISHEYE = Undistortion(
    FisheyeModel(FOCAL, CENTER, (0.02, -0.01, 0.002, -0.001)), STORED, Pinhole(*STORED, (262.5, 257.25), CENTER), ""
)
lenses = pytest.mark.parametrize("known", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
SPREAD = 150.0  # grey levels a unit of ray


def matrix(told):
    return np.array([[told.focal_px[0], 0, told.center_px[0]], [0, told.focal_px[1], told.center_px[1]], [0, 0, 1]])


def stored_picture(known, size):
    """What the camera stores, resized to a size: red and green say where a pixel's ray meets the plane at depth 1.

    OpenCV undoes its own models, with its criteria made fine.
    """
    scale = np.array(size) / STORED
    columns, rows = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    pixels = ((np.stack((columns, rows), axis=-1) + 0.5) / scale - 0.5).reshape(-1, 1, 2).astype(np.float64)
    lens, fine = known.lens, (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    undo = cv2.fisheye.undistortPoints if isinstance(lens, FisheyeModel) else cv2.undistortPoints
    rays = undo(pixels, matrix(lens), np.array(lens.coefficients), criteria=fine)
    image = np.full((size[1], size[0], 3), 128, np.uint8)
    image[..., :2] = np.clip(np.rint(128 + SPREAD * rays.reshape(size[1], size[0], 2)), 0, 255)
    return image


@lenses
@pytest.mark.parametrize("size", [STORED, (160, 120), (640, 480), (427, 320)])
def test_a_pixels_color_is_that_of_its_ray(known, size):
    """Whole or resized, what comes out is a pinhole's image with the matrix that comes with it."""
    image, intrinsics = known.apply(stored_picture(known, size), "a")
    assert image.shape == (size[1], size[0], 3)
    columns, rows = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    rays = np.stack((columns, rows, np.ones_like(rows)), axis=-1) @ np.linalg.inv(intrinsics).T
    off = np.abs(image[..., :2].astype(float) - 128 - SPREAD * rays[..., :2])[2:-2, 2:-2]
    assert off.max() < 1.5  # levels: rounding twice


@lenses
def test_what_is_left_is_cropped_to_its_middle(known):
    left = replace(known.leaves, width=300, center_px=(CENTER[0] - 10, CENTER[1]))
    whole, _ = known.apply(stored_picture(known, STORED), "a")
    middle, intrinsics = replace(known, leaves=left).apply(stored_picture(known, STORED), "a")
    np.testing.assert_array_equal(middle, whole[:, 10:310])
    np.testing.assert_allclose(intrinsics, matrix(left))
    resized, _ = replace(known, leaves=left).apply(stored_picture(known, (160, 120)), "a")
    assert resized.shape == (120, 150, 3)


@lenses
def test_pictures_are_those_of_opencv(known):
    """Guess: OpenCV's own functions agree to a level on a smooth image; they round places to 1/32 pixel."""
    picture = stored_picture(known, STORED)
    lens, left = known.lens, matrix(known.leaves)
    if isinstance(lens, FisheyeModel):
        told = cv2.fisheye.undistortImage(picture, matrix(lens), np.array(lens.coefficients), Knew=left)
    else:
        told = cv2.undistort(picture, matrix(lens), np.array(lens.coefficients), None, left)
    found, intrinsics = known.apply(picture, "a")
    np.testing.assert_array_equal(intrinsics, left)
    assert np.abs(found.astype(int) - told)[2:-2, 2:-2].max() <= 1


@lenses
def test_rays_are_projected_as_opencv_does(known):
    rays = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 2))
    points, lens = np.column_stack((rays, np.ones(200)))[:, None], known.lens
    project = cv2.fisheye.projectPoints if isinstance(lens, FisheyeModel) else cv2.projectPoints
    told = project(points, np.zeros(3), np.zeros(3), matrix(lens), np.array(lens.coefficients))[0].reshape(-1, 2)
    np.testing.assert_allclose(lens(rays), told, atol=1e-9)
    halved = (told + 0.5) * (0.5, 0.25) - 0.5
    np.testing.assert_allclose(lens.scaled((0.5, 0.25))(rays), halved, atol=1e-9)


def test_rays_that_no_lens_sees_repeat_the_border():
    picture = np.random.default_rng(0).integers(0, 256, (4, 5, 3), dtype=np.uint8)
    for strange in (np.nan, np.inf, -np.inf, 1e30):
        maps = sampled_at(lambda rays, value=strange: np.full_like(rays, value), Pinhole(5, 4, (5.0, 5.0), (2.0, 1.5)))
        corner = picture[-1, -1] if strange > 0 else picture[0, 0]
        assert (undistorted(picture, maps) == corner).all()


# --- files -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("told", [PINHOLE, FISHEYE, Undistortion(), Undistortion(unknown="they are of 2 cameras")])
def test_a_contract_brings_it_back(told):
    contract = replace(CONTRACT, undistortion=told)
    assert Contract.from_json(contract.to_json(), "a") == contract


def test_an_older_contract_knows_no_lens():
    told = json.loads(CONTRACT.to_json())
    del told["undistortion"]
    assert Contract.from_json(json.dumps(told), "a").undistortion == Undistortion()


def test_a_contract_names_the_function_and_what_it_leaves():
    told = json.loads(replace(CONTRACT, undistortion=PINHOLE).to_json())["undistortion"]
    assert "INTER_LINEAR" in told["function"]
    assert told["lens"] == {
        "opencv": "pinhole", "width": 320, "height": 240, "focal_px": [250, 245], "centre_px": [152, 123],
        "coefficients": [-0.2, 0.05, 0.003, -0.002, 0.01],
    }  # fmt: skip
    assert told["leaves"] == {"width": 320, "height": 240, "focal_px": [275, 269.5], "centre_px": [152, 123]}


@pytest.mark.parametrize(
    ("where", "value"),
    [
        ((), 7),
        (("lens",), 7),
        (("lens",), None),
        (("leaves",), None),
        (("lens", "opencv"), "plumb"),
        (("lens", "opencv"), [1]),
        (("lens", "coefficients"), [0.1, 0.2, 0.3]),
        (("lens", "coefficients"), [0.1, 0.2, 0.3, float("nan")]),
        (("lens", "coefficients"), ["a", 0.2, 0.3, 0.4]),
        (("lens", "coefficients"), [9.0, 9.0, 0.0, 0.0]),  # sees less than what is left
        (("lens", "width"), 0),
        (("lens", "width"), 10**9),
        (("lens", "width"), float("inf")),
        (("lens", "focal_px"), [250]),
        (("lens", "focal_px"), [250, float("nan")]),
        (("leaves", "focal_px"), [275, 0]),
        (("leaves", "focal_px"), [27.5, 26.9]),  # looks past the stored image
        (("leaves", "centre_px"), [1e9, 0]),
        (("leaves", "width"), 321),  # larger than what is stored
        (("leaves", "height"), "x"),
    ],
)
def test_a_damaged_lens_is_refused_in_one_line(where, value):
    told = json.loads(replace(CONTRACT, undistortion=PINHOLE).to_json())
    changed = copy.deepcopy(told)
    inner = changed
    for key in ("undistortion", *where)[:-1]:
        inner = inner[key]
    inner[("undistortion", *where)[-1]] = value
    with pytest.raises(InputError, match="a: its contract cannot be read") as caught:
        Contract.from_json(json.dumps(changed), "a")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("target", TARGETS)
def test_every_page_says_what_pictures_must_be(target, tmp_path):
    page = tmp_path / "INTEGRATION.md"
    write_pages(tmp_path, replace(CONTRACT, undistortion=FISHEYE), "7scenes", ["model.onnx"], target, None)
    said = page.read_text()
    assert "Images must be without lens distortion" in said
    assert "as 320x240, through a lens of OpenCV's fisheye model" in said
    assert "262.50 0 152.00, 0 257.25 123.00, 0 0 1" in said
    write_pages(tmp_path, CONTRACT, "7scenes", ["model.onnx"], target, None)
    assert "The lens of their camera is not known here:\nnone was kept with it." in page.read_text()


# --- a localizer -----------------------------------------------------------------------------------------------------


class Echo:
    """A network that keeps what it was given."""

    def __init__(self, undistortion: Undistortion) -> None:
        self.contract = replace(CONTRACT, undistortion=undistortion)

    def localize(self, images, intrinsics=None):
        self.given = images[0], intrinsics[0]
        return [Localization(np.zeros(3), np.array([1.0, 0, 0, 0]), 0.0)]


def localizer_of(undistortion):
    localizer = Localizer.__new__(Localizer)
    localizer._network, localizer._map, localizer._path = Echo(undistortion), None, "den.onnx"
    return localizer


def test_a_network_is_given_the_undistorted_picture_and_its_camera():
    picture, localizer = stored_picture(PINHOLE, STORED), localizer_of(PINHOLE)
    localizer.localize(picture, is_distorted=True)
    for given, expected in zip(localizer._network.given, PINHOLE.apply(picture, "a"), strict=True):
        np.testing.assert_array_equal(given, expected)
    localizer.localize(picture)
    np.testing.assert_array_equal(localizer._network.given[0], picture)
    assert localizer._network.given[1] is None


@pytest.mark.parametrize(
    ("undistortion", "size", "intrinsics", "says"),
    [
        (
            Undistortion(unknown="they are of 2 cameras"),
            STORED,
            None,
            r"den.onnx: .* not known \(they are of 2",
        ),
        (PINHOLE, (320, 180), None, "den.onnx: an image of 320x180 has another shape than 320x240"),
        (PINHOLE, (240, 320), None, "den.onnx: an image of 240x320 has another shape than 320x240"),
        (PINHOLE, STORED, np.eye(3), "intrinsics: distorted images have those of their lens"),
    ],
)
def test_wrong_uses_are_told_in_one_line(undistortion, size, intrinsics, says):
    with pytest.raises(InputError, match=says) as caught:
        localizer_of(undistortion).localize(np.zeros((size[1], size[0], 3), np.uint8), intrinsics, is_distorted=True)
    assert "\n" not in str(caught.value)
