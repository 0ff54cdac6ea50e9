"""Images of a bag: each encoding against OpenCV or the pixels themselves, cameras by hand, and topics to choose."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from bag_writing import FIRST_NS, KINDS, png, recording_in

from mambaloc.bags.images import camera_of, camera_topic, image_topic, images_of
from mambaloc.bags.reading import is_bag, open_bag
from mambaloc.errors import InputError

SIZE = (64, 48)
K = np.array([[60.0, 0, 31.0], [0, 61.0, 24.5], [0, 0, 1]])


@pytest.fixture(scope="module")
def rgb():
    """Smooth, so that neighbours of a mosaic's pixels tell the missing colours."""
    columns, rows = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    return np.stack((3 * columns, 4 * rows, 250 - 2 * columns - rows), axis=-1).astype(np.uint8)


@pytest.fixture
def record(tmp_path):
    """Record with a function of a :class:`bag_writing.Recorder`, in a kind of bag, and give the path."""

    return recording_in(tmp_path)


def only(path):
    with open_bag(path) as bag:
        (picture,) = images_of(bag, image_topic(bag))
    return picture


def swapped(rgb, alpha=False):
    bgr = rgb[..., ::-1]
    return np.dstack((bgr, np.full(bgr.shape[:2], 7, np.uint8))) if alpha else bgr


@pytest.mark.parametrize("pad", [0, 5])
@pytest.mark.parametrize("kind", KINDS)
def test_colors_are_kept(record, rgb, kind, pad):
    with_alpha = np.dstack((rgb, np.full(rgb.shape[:2], 7, np.uint8)))
    written = {
        "rgb8": rgb,
        "bgr8": swapped(rgb),
        "8UC3": swapped(rgb),
        "rgba8": with_alpha,
        "bgra8": swapped(rgb, True),
    }

    def write(bag):
        for at, (encoding, pixels) in enumerate(written.items()):
            bag.image("/eye/image_raw", FIRST_NS + at, "/eye", pixels, encoding, pad)

    path = record(write, kind)
    assert is_bag(path)
    with open_bag(path) as bag:
        found = list(images_of(bag, image_topic(bag)))
    assert [(each.number, each.ns, each.frame) for each in found] == [(k, FIRST_NS + k, "eye") for k in range(5)]
    for each in found:
        np.testing.assert_array_equal(each.image, rgb)


def test_a_single_file_of_a_ros_2_bag_is_one(record, rgb):
    (file,) = record(lambda bag: bag.image("/image", FIRST_NS, "eye", rgb)).glob("*.mcap")
    assert is_bag(file)
    np.testing.assert_array_equal(only(file).image, rgb)


def test_grey_becomes_rgb(record, rgb):
    path = record(lambda bag: bag.image("/image", FIRST_NS, "eye", rgb[..., 0], "mono8", 3))
    np.testing.assert_array_equal(only(path).image, np.repeat(rgb[..., :1], 3, axis=-1))


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_mosaics_are_filled(record, rgb, pattern):
    """Guess: OpenCV's BayerRGGB is ROS's rggb, the first two letters those of the first row. It is."""
    mosaic = np.empty(rgb.shape[:2], np.uint8)
    for at, letter in enumerate(pattern):
        row, column = divmod(at, 2)
        mosaic[row::2, column::2] = rgb[row::2, column::2, "rgb".index(letter)]
    path = record(lambda bag: bag.image("/image", FIRST_NS, "eye", mosaic, f"bayer_{pattern}8"))
    np.testing.assert_allclose(only(path).image[2:-2, 2:-2].astype(int), rgb[2:-2, 2:-2], atol=2)


@pytest.mark.parametrize(("encoding", "order"), [("uyvy", (1, 0)), ("yuv422", (1, 0)), ("yuyv", (0, 1))])
def test_packed_yuv(record, encoding, order):
    """A red of BT.601's video levels, by hand: Y = 81, U = 90, V = 240."""
    pixels = np.zeros((48, 64, 2), np.uint8)
    pixels[..., order[0]] = 81
    pixels[:, 0::2, order[1]], pixels[:, 1::2, order[1]] = 90, 240
    path = record(lambda bag: bag.image("/image", FIRST_NS, "eye", pixels, encoding))
    np.testing.assert_allclose(only(path).image.reshape(-1, 3).astype(int), [(254, 0, 0)] * 48 * 64, atol=2)


@pytest.mark.parametrize("kind", KINDS)
def test_compressed_pictures_are_decoded_and_their_files_kept(record, rgb, kind):
    jpeg = cv2.imencode(".jpg", rgb[..., ::-1])[1].tobytes()

    def write(bag):
        for at, file in enumerate((jpeg, png(rgb), jpeg[:-40])):
            bag.compressed("/eye/compressed", FIRST_NS + at, "eye", file)

    with open_bag(record(write, kind)) as bag:
        first, second, third = images_of(bag, image_topic(bag))
    np.testing.assert_array_equal(first.image, cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR_RGB))
    np.testing.assert_array_equal(second.image, rgb)
    assert (first.file, second.file, third.image) == (jpeg, png(rgb), "image is truncated")


def test_a_picture_with_too_few_bytes_is_named(record, rgb):
    def write(bag):
        name = "sensor_msgs/msg/Image"
        told = {"height": 48, "width": 64, "encoding": "rgb8", "is_bigendian": 0, "step": 192}
        header, data = bag.header(FIRST_NS, "eye"), np.zeros(100, np.uint8)
        bag.write("/image", name, bag.make(name, header=header, **told, data=data), FIRST_NS)

    assert only(record(write)).image == "image of 64x48 has 100 bytes, less than it needs"


@pytest.mark.parametrize(
    ("write", "says"),
    [
        (lambda bag, rgb: bag.image("/a", FIRST_NS, "eye", rgb[..., 0].astype(np.uint16), "mono16"), "'mono16'"),
        (lambda bag, rgb: bag.image("/a", 0, "eye", rgb), "message 0: its header has no time"),
        (lambda bag, rgb: [bag.image("/a", FIRST_NS, of, rgb) for of in "bc"], "the frames 'b' and 'c'"),
        (lambda bag, rgb: [bag.image(f"/{of}", FIRST_NS, of, rgb) for of in "bc"], "images in /b, /c. Choose one"),
        (lambda bag, rgb: bag.pose_stamped("/a", FIRST_NS, "map", np.eye(4)), "has no topic of images"),
        (lambda bag, rgb: bag.image("/a", FIRST_NS, "eye", rgb[..., 0].astype(np.uint16), "16UC1"), "no topic of imag"),
    ],
)
def test_what_is_not_read_is_refused(record, rgb, write, says):
    path = record(lambda bag: write(bag, rgb))
    with pytest.raises(InputError) as caught:
        only(path)
    assert says in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_of_several_topics_that_with_a_camera_is_taken(record, rgb):
    def write(bag):
        bag.image("/left/image_raw", FIRST_NS, "left", rgb)
        bag.image("/right/image_raw", FIRST_NS, "right", rgb)
        bag.camera("/right/camera_info", FIRST_NS, "right", SIZE, K)

    path = record(write)
    with open_bag(path) as bag:
        assert image_topic(bag) == "/right/image_raw"
        assert image_topic(bag, "/left/image_raw") == "/left/image_raw"
        assert camera_of(bag, "/left/image_raw") is None
        with pytest.raises(InputError, match=r"--topic /up: .*Choose one of /left/image_raw, /right/image_raw"):
            image_topic(bag, "/up")


def test_the_camera_beside_a_topic_is_its_own():
    bag = SimpleNamespace(topics={"/a/b/camera_info": "sensor_msgs/msg/CameraInfo"})
    assert camera_topic(bag, "/a/b/image_raw/compressed") == camera_topic(bag, "/a/b/image_raw") == "/a/b/camera_info"
    assert camera_topic(bag, "/a/image_raw") is None


@pytest.mark.parametrize("kind", KINDS)
def test_cameras_by_hand(record, rgb, kind):
    """Binned by 2 after a region is cut out: column u of the region is (u + 0.5) / 2 - 0.5 of the image."""
    p = [[50, 0, 30, 0], [0, 50, 20, 0], [0, 0, 1, 0]]

    def write(bag):
        for of in ("a", "b"):
            bag.image(f"/{of}/image_raw", FIRST_NS, of, rgb)
        bag.image("/a/image_rect", FIRST_NS, "a", rgb)
        bag.camera("/a/camera_info", FIRST_NS, "a", SIZE, K, d=[0.1, 0, 0, 0, 0], p=p)
        bag.camera("/b/camera_info", FIRST_NS, "b", (140, 100), K, binning=2, roi=(10, 4, 128, 96), d=[0.0] * 5)

    with open_bag(record(write, kind)) as bag:
        raw, straight, cut = (camera_of(bag, f"/{name}") for name in ("a/image_raw", "a/image_rect", "b/image_raw"))
    np.testing.assert_array_equal(raw.matrix, K)
    assert (raw.size, raw.model, raw.coefficients) == (SIZE, "plumb_bob", (0.1, 0, 0, 0, 0))
    np.testing.assert_array_equal(straight.matrix, np.array(p)[:, :3])
    assert straight.coefficients == cut.coefficients == ()
    np.testing.assert_allclose(cut.matrix, [[30, 0, 10.25], [0, 30.5, 10.0], [0, 0, 1]])
    assert cut.size == SIZE


def test_a_camera_that_was_not_calibrated_is_refused(record, rgb):
    def write(bag):
        bag.image("/a/image", FIRST_NS, "a", rgb)
        bag.camera("/a/camera_info", FIRST_NS, "a", SIZE, np.zeros((3, 3)))

    with open_bag(record(write)) as bag, pytest.raises(InputError, match="/a/camera_info: is not calibrated"):
        camera_of(bag, "/a/image")
