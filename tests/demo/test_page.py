"""The page in a real browser finds what Python finds."""

import json
import shutil
import time
import warnings

import cv2
import numpy as np
import pytest

from mambaloc.errors import InputWarning
from mambaloc.runtime import Localizer
from mambaloc.runtime.rotations import rotation_error_deg

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def address(site, served):
    with served(site) as server:
        yield f"http://127.0.0.1:{server.server_port}/"


@pytest.fixture(scope="module")
def raw_address(raw_site, served):
    with served(raw_site) as server:
        yield f"http://127.0.0.1:{server.server_port}/"


@pytest.fixture(scope="module")
def map_address(map_site, served):
    with served(map_site) as server:
        yield f"http://127.0.0.1:{server.server_port}/"


@pytest.fixture(scope="module")
def lens_address(lens_site, served):
    with served(lens_site) as server:
        yield f"http://127.0.0.1:{server.server_port}/"


@pytest.fixture(scope="module")
def load(browser):
    """Loads the page of an address, once; gives it with the errors in its console."""
    context = browser.new_context()
    loaded = {}

    def load_(where):
        if where not in loaded:
            page, mistakes = context.new_page(), []
            page.on("pageerror", lambda error: mistakes.append(str(error)))
            page.on("console", lambda message: mistakes.append(message.text) if message.type == "error" else None)
            page.goto(f"{where}?source=frames&backend=wasm")
            page.wait_for_selector("body:not([data-state=loading])", timeout=60_000)
            loaded[where] = page, mistakes
        return loaded[where]

    yield load_
    context.close()


CHOOSE = """(source) => {
    for (const name of [source === "photo" ? "frames" : "photo", source])
        document.querySelector(`[name=source][value=${name}]`).click();
    window.localizedBefore = Number(document.querySelector("#pose").dataset.frame ?? 0);
}"""


@pytest.fixture
def opened(load, address):
    """Opens the page at a source, as it is after another one; its console contains no error when the test ends."""
    console = []

    def open_(source, where=address):
        page, mistakes = load(where)
        console.append(mistakes)
        page.evaluate(CHOOSE, source)
        return page

    yield open_
    for mistakes in console:
        said = mistakes.copy()
        mistakes.clear()  # of this test, not of the next
        assert not said


def pose_of(page, count=1):
    """What the page says after so many localizations since it was opened."""
    count += page.evaluate("window.localizedBefore")
    page.wait_for_selector(f'#pose[data-frame="{count}"]', timeout=30_000)
    read = [json.loads(page.get_attribute("#pose", f"data-{name}")) for name in ("position-m", "quaternion-wxyz")]
    return tuple(np.array(each) for each in read)


def check(found, expected, mm=1.0, deg=0.1):
    position_m, quaternion = found
    assert 1000 * np.linalg.norm(position_m - expected.position_m) < mm
    assert rotation_error_deg(quaternion, expected.quaternion) < deg


def test_poses_of_the_frames_are_pythons(opened, bundle):
    page, localizer = opened("frames"), Localizer(bundle)
    frames = json.loads((bundle / "contract.json").read_text())["frames"]
    for count, frame in enumerate(frames, start=1):
        page.click(f'[data-frame-file="{frame["file"]}"]')
        check(pose_of(page, count), localizer.localize(bundle / frame["file"]))
    assert page.get_attribute("body", "data-backend") == "wasm"
    assert page.evaluate(expression="crossOriginIsolated") is True


def test_a_bundle_that_takes_pictures_as_they_are(opened, raw_bundle, raw_address):
    page = opened("frames", raw_address)
    page.click('[data-frame-file="frames/1.png"]')
    check(pose_of(page), Localizer(raw_bundle).localize(raw_bundle / "frames/1.png"))


def test_poses_through_another_lens_are_pythons(opened, bundles_for_lenses, lens_address):
    folder = bundles_for_lenses / "tensors"
    page, localizer = opened("frames", lens_address), Localizer(folder)
    frames = json.loads((folder / "contract.json").read_text())["frames"]
    for count, frame in enumerate(frames, start=1):
        page.click(f'[data-frame-file="{frame["file"]}"]')
        check(pose_of(page, count), localizer.localize(folder / frame["file"], frame["intrinsics"]), deg=0.05)
    assert page.is_hidden("#lens")  # the contract says what took them


def test_the_page_is_told_what_lens_took_a_photo(opened, bundles_for_lenses, lens_address, tmp_path):
    folder, path = bundles_for_lenses / "tensors", tmp_path / "upright.png"
    upright = cv2.imread(str(folder / "frames/2.png"))[:, 20:110]
    cv2.imwrite(str(path), upright)
    page, localizer = opened("photo", lens_address), Localizer(folder)
    page.fill("#focal", "")
    page.set_input_files("#photo", path)
    page.wait_for_selector("body[data-state=error]", timeout=30_000)
    assert "or say what lens took it" in page.inner_text("#error")
    page.fill("#focal", "30")
    page.press("#focal", "Enter")  # and the photo is localized again
    focal_px = 30 * np.hypot(90, 120) / np.hypot(36, 24)
    intrinsics = [[focal_px, 0, 44.5], [0, focal_px, 59.5], [0, 0, 1]]
    check(pose_of(page), localizer.localize(path, intrinsics), deg=0.05)
    assert page.is_hidden("#error")


def test_how_sure_a_model_is(opened, raw_bundle, raw_address, tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (240, 320, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "noise.png"), noise)
    localizer, page = Localizer(raw_bundle), opened("photo", raw_address)
    for count, path in enumerate((raw_bundle / "frames/3.png", tmp_path / "noise.png"), start=1):
        page.set_input_files("#photo", path)
        check(pose_of(page, count), found := localizer.localize(path))
        radii = [page.text_content(f'[data-show="radius-{of}"]') for of in ("position", "rotation")]
        assert radii == [f"±{found.position_radius_m:.2f} m", f"±{found.rotation_radius_deg:.1f}°"]
        assert page.get_attribute("#uncertainty", "data-within") == str(not found.is_unfamiliar).lower()
        assert page.is_visible("#uncertainty")


def test_a_model_that_does_not_tell_how_sure_it_is(opened):
    page = opened("frames")
    page.click('[data-frame-file="frames/1.png"]')
    pose_of(page)
    assert not page.is_visible("#uncertainty")


def test_the_page_checks_the_bundle_by_itself(opened):
    page = opened("frames")
    page.click("#check")
    page.wait_for_selector("#verdict:has-text('Yes')", timeout=30_000)


DRAWN = """() => {
    const canvas = document.querySelector("#matches");
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    return data.filter((value, i) => i % 4 === 3 && value).length;
}"""


def test_the_map_answers_as_in_python(opened, map_bundle, map_address):
    """Python's test vectors, the runtime without torch, and the page find one pose."""
    page, localizer = opened("frames", map_address), Localizer(map_bundle)
    frames = json.loads((map_bundle / "contract.json").read_text())["frames"]
    for count, frame in enumerate(frames, start=1):
        page.click(f'[data-frame-file="{frame["file"]}"]')
        found = pose_of(page, count)
        expected = localizer.localize(map_bundle / frame["file"], frame["intrinsics"])
        assert expected.source == page.get_attribute("#pose", "data-answer") == page.inner_text("[data-show=answer]")
        assert expected.source == "map"
        check(found, expected, mm=10.0, deg=0.3)
        vector = frame["map"]
        assert 1000 * np.linalg.norm(found[0] - vector["position_m"]) < 10
        assert rotation_error_deg(found[1], np.array(vector["quaternion_wxyz"])) < 0.3
        inliers = int(page.get_attribute("#pose", "data-inliers"))
        assert abs(inliers - vector["inliers"]) <= 3
        assert page.inner_text("[data-show=answer-detail]").startswith(f"{inliers} of ")
        assert page.evaluate(DRAWN) > 10 * inliers  # a dot each
        radius_m = float(page.text_content("[data-show=radius-position]").strip("±m "))
        assert radius_m == pytest.approx(expected.position_radius_m, abs=0.002)
    page.click("#check")
    page.wait_for_selector("#verdict:has-text('Yes')", timeout=60_000)
    assert "map" in page.inner_text("#verdict")


def test_the_network_answers_where_the_map_does_not(opened, map_bundle, map_address, tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (120, 160, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "noise.png"), noise)
    cv2.imwrite(str(tmp_path / "wide.png"), cv2.imread(str(map_bundle / "frames/1.png"))[:90])  # by an unknown camera
    page, localizer = opened("photo", map_address), Localizer(map_bundle)
    for count, name in enumerate(("noise.png", "wide.png"), start=1):
        page.set_input_files("#photo", tmp_path / name)
        with warnings.catch_warnings(action="ignore", category=InputWarning):
            expected = localizer.localize(tmp_path / name)
        check(pose_of(page, count), expected)
        assert expected.source == page.get_attribute("#pose", "data-answer") == "network"
        assert page.evaluate(DRAWN) == 0


def test_the_film_of_the_maps_room_is_localized_to_centimetres(opened, map_address):
    page = opened("film", map_address)
    page.wait_for_selector("#pose[data-film-frame]", timeout=30_000)
    for _ in range(5):
        page.wait_for_timeout(300)
        error_m = float(page.inner_text("[data-show=error-position]").removesuffix(" m"))
        assert page.get_attribute("#pose", "data-answer") == "map"
        assert error_m < 0.05


def test_a_bundle_without_a_map_says_nothing_of_one(opened):
    page = opened("frames")
    page.click('[data-frame-file="frames/1.png"]')
    pose_of(page)
    assert not page.is_visible("#answer")
    assert not page.is_visible(".key .points")
    assert page.evaluate(DRAWN) == 0


@pytest.mark.parametrize("kind", ["colour", "grey", "turned"])
def test_photos_are_localized(opened, bundle, tmp_path, kind):
    page = opened("photo")
    picture = cv2.imread(str(bundle / "frames/3.png"))
    path = tmp_path / "photo.png"
    if kind == "turned":  # lying on its side, and its EXIF says so
        path = tmp_path / "photo.jpg"
        on_its_side = cv2.rotate(picture, cv2.ROTATE_90_COUNTERCLOCKWISE)
        jpeg = bytes(cv2.imencode(".jpg", on_its_side, [cv2.IMWRITE_JPEG_QUALITY, 100])[1])
        exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"
        path.write_bytes(jpeg[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + jpeg[2:])
    else:
        cv2.imwrite(str(path), picture[..., 1] if kind == "grey" else picture)
    page.set_input_files("#photo", path)
    lossy = {"mm": 10.0, "deg": 0.5} if kind == "turned" else {}  # no two decoders agree on a JPEG
    check(pose_of(page), Localizer(bundle).localize(path), **lossy)


SAID = "() => { const said = document.querySelector('#pose').dataset; return [said.filmFrame, said.positionM] }"


def test_the_film_runs_beside_its_true_poses(opened, bundle, film):
    page, localizer = opened("film"), Localizer(bundle)
    capture = cv2.VideoCapture(str(film / "film.webm"))
    pictures = [picture for read, picture in iter(capture.read, (False, None)) if read]
    found, deadline_s = {}, time.monotonic() + 30
    while len(found) < 8 and time.monotonic() < deadline_s:  # it runs in a loop
        page.wait_for_timeout(100)
        number, position = page.evaluate(SAID)
        if number is not None and 2 <= int(number) < len(pictures) - 2:
            found[int(number)] = np.array(json.loads(position))
    assert len(found) > 3
    near = {}
    for shift in (-2, 0, 2):
        expected = {n: localizer.localize(pictures[n + shift][..., ::-1].copy()).position_m for n in found}
        near[shift] = np.median([np.linalg.norm(found[n] - expected[n]) for n in found])
    assert near[0] < 0.03  # decoders differ by centimetres
    assert near[0] < min(near[-2], near[2])  # and the number is that of the image
    assert page.inner_text("[data-show=error-position]").endswith(" m")


def test_a_camera_is_localized(opened):
    page = opened("camera")
    page.wait_for_selector("body[data-state=running]", timeout=30_000)
    assert page.get_attribute("#pose", "data-source") == "camera"
    assert np.isfinite(json.loads(page.get_attribute("#pose", "data-position-m"))).all()


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ((120, 60, 3), "too narrow"),
        (None, "is not an image that this browser can read"),
        ((120, 160, 4), "has transparent parts"),
    ],
)
def test_a_picture_that_cannot_be_localized_is_one_clear_line(opened, tmp_path, shape, message):
    page, path = opened("photo"), tmp_path / "photo.png"
    path.write_bytes(b"noise" if shape is None else cv2.imencode(".png", np.zeros(shape, np.uint8))[1].tobytes())
    page.set_input_files("#photo", path)
    page.wait_for_selector("body[data-state=error]", timeout=30_000)
    assert message in page.inner_text("#error")


def test_a_picture_larger_than_a_phones_canvas(opened, bundle, tmp_path):
    path = tmp_path / "large.png"
    cv2.imwrite(str(path), cv2.resize(cv2.imread(str(bundle / "frames/3.png")), (5712, 4284)))
    page = opened("photo")
    page.set_input_files("#photo", path)
    check(pose_of(page), Localizer(bundle).localize(path))
    assert page.evaluate("() => document.querySelector('#still').width") == 1024


def test_a_browser_whose_threads_fail_gets_one(browser, address):
    page = browser.new_page()
    page.add_init_script("""
        const Real = Worker;
        let count = 0;
        window.Worker = class extends Real {
            postMessage(message, ...rest) {
                if (message.type === "start" && !message.threads)
                    setTimeout(() => this.onerror({ message: "out of memory" }));
                else super.postMessage(message, ...rest);
            }
        };
    """)
    page.goto(f"{address}?source=frames")
    page.wait_for_selector("body[data-state=ready]", timeout=60_000)
    assert "1 thread" in page.inner_text("#wasm-name")
    assert "out of memory" in page.inner_text("#note")
    page.close()


def test_without_the_map_the_network_answers(browser, map_site, tmp_path, served):
    changed = shutil.copytree(map_site, tmp_path / "site")
    with (changed / "bundle/map.safetensors").open("r+b") as file:
        file.truncate(1000)
    with served(changed) as server:
        page = browser.new_page()
        page.goto(f"http://127.0.0.1:{server.server_port}/?source=frames&backend=wasm")
        page.wait_for_selector("body[data-state=ready]", timeout=60_000)
        assert "The network answers without the map." in page.inner_text("#note")
        page.click('[data-frame-file="frames/1.png"]')
        page.wait_for_selector('#pose[data-frame="1"]', timeout=30_000)
        assert page.get_attribute("#pose", "data-answer") == "network"
        page.close()


def test_a_changed_model_is_refused(browser, site, tmp_path, served):
    changed = shutil.copytree(site, tmp_path / "site")
    model = changed / "bundle/model.onnx"
    content = bytearray(model.read_bytes())
    content[len(content) // 2] ^= 1
    model.write_bytes(content)
    with served(changed) as server:
        page = browser.new_page()
        page.goto(f"http://127.0.0.1:{server.server_port}/?backend=wasm")
        page.wait_for_selector("body[data-state=error]", timeout=60_000)
        assert "is not the file that its contract was written with" in page.inner_text("#error")
        page.close()
