"""The page's module and the pages on integration, run in Node and in Python for real."""

import json
import re
import subprocess
import sys
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from mambaloc.runtime import Contract, Localizer, Preprocessing
from mambaloc.runtime.rotations import rotation_error_deg

pytestmark = pytest.mark.slow
HERE = Path(__file__).parent
WEB = resources.files("mambaloc.demo") / "web"


@pytest.mark.parametrize(
    ("which", "model"),
    [("bundle", "model.onnx"), ("raw_bundle", "model.onnx"), ("raw_bundle", "model.fp16.onnx")],
)
def test_poses_in_node_are_pythons(which, model, modules, request, node):
    folder = request.getfixturevalue(which)
    found = json.loads(node(HERE / "replay.mjs", modules, WEB, folder, model))
    localizer = Localizer(folder / model)
    frames = json.loads((folder / "contract.json").read_text())["frames"]
    assert len(found) == len(frames) == 5
    for pose, frame in zip(found, frames, strict=True):
        expected = localizer.localize(folder / frame["file"])
        assert 1000 * np.linalg.norm(np.array(pose["position_m"]) - expected.position_m) < 1
        assert rotation_error_deg(np.array(pose["quaternion_wxyz"]), expected.quaternion) < 0.1


@pytest.mark.parametrize(("kind", "model"), [("tensors", "model.onnx"), ("pictures", "model.ort")])
def test_poses_through_another_lens_in_node_are_pythons(kind, model, bundles_for_lenses, modules, node):
    folder = bundles_for_lenses / kind
    found = json.loads(node(HERE / "replay.mjs", modules, WEB, folder, model))
    localizer = Localizer(folder / model)
    frames = json.loads((folder / "contract.json").read_text())["frames"]
    assert len(found) == len(frames) == 6
    for pose, frame in zip(found, frames, strict=True):
        expected = localizer.localize(folder / frame["file"], frame["intrinsics"])
        assert 1000 * np.linalg.norm(np.array(pose["position_m"]) - expected.position_m) < 1
        assert rotation_error_deg(np.array(pose["quaternion_wxyz"]), expected.quaternion) < 0.05


@pytest.mark.parametrize("model", ["model.onnx", "model.fp16.onnx"])
def test_the_scene_in_node_is_pythons(model, bundle_of_two, modules, node):
    found = json.loads(node(HERE / "replay.mjs", modules, WEB, bundle_of_two, model))
    localizer = Localizer(bundle_of_two / model)
    frames = json.loads((bundle_of_two / "contract.json").read_text())["frames"]
    for pose, frame in zip(found, frames, strict=True):
        expected = localizer.localize(bundle_of_two / frame["file"])
        assert pose["scene"] == expected.scene
        assert pose["scene_probability"] == pytest.approx(expected.scene_probability, abs=0.01)
        assert pose["offset_m"] == list(localizer.world_of(expected).offset_m)


CASES = [  # (height, width) of the image, short side, crop
    ((480, 640), 256, (224, 224)),
    ((240, 320), 78, (72, 96)),
    ((720, 1280), 78, (72, 96)),
    ((512, 683), 256, (224, 320)),  # exactly halved one way
    ((512, 640), 256, (224, 224)),  # exactly halved
    ((97, 151), 36, (32, 34)),
    ((640, 480), 256, (224, 224)),
    ((100, 130), 128, (96, 128)),  # enlarged
    ((78, 104), 78, (72, 96)),  # as it is
    ((480, 640), 60, (72, 96)),  # black beyond the border
    ((40, 60), 50, (72, 96)),  # likewise, enlarged
    ((40, 61), 97, (97, 148)),  # enlarged, all of it
]


def test_pictures_look_to_the_page_as_to_opencv(tmp_path, node):
    told = []
    for number, ((height, width), short_side, crop) in enumerate(CASES):
        rgb = np.random.default_rng(number).integers(0, 256, (height, width, 3), dtype=np.uint8)
        (tmp_path / f"{number}.rgb").write_bytes(rgb.tobytes())
        told.append({"width": width, "height": height, "preprocessing": {"short_side": short_side, "crop": crop}})
    (tmp_path / "cases.json").write_text(json.dumps(told))
    node(HERE / "preprocess.mjs", WEB, tmp_path)
    for number, ((height, width), short_side, crop) in enumerate(CASES):
        rgb = np.frombuffer((tmp_path / f"{number}.rgb").read_bytes(), np.uint8).reshape(height, width, 3)
        expected = Preprocessing(short_side, crop).apply(rgb).transpose(2, 0, 1)
        found = np.frombuffer((tmp_path / f"{number}.f32").read_bytes(), np.float32).reshape(3, *crop)
        np.testing.assert_array_equal((found * 255).round(), expected, err_msg=str(CASES[number]))


TRAINED = ((120.0, 0.0, 64.5), (0.0, 121.0, 47.0), (0.0, 0.0, 1.0))
CAMERAS = [  # (height, width) of the image, focal length and centre
    ((480, 640), (533, 533, 322, 236)),
    ((480, 640), (426, 430, 322, 236)),
    ((480, 640), (700, 700, 322, 236)),
    ((640, 480), (533, 533, 238, 321)),
    ((300, 300), (390, 390, 180, 120)),
    ((720, 1280), (60, 60, 640, 360)),
]


@pytest.mark.parametrize("in_model", [False, True], ids=["tensors", "pictures"])
def test_cameras_are_to_the_page_what_they_are_to_python(in_model, node):
    contract = Contract("echo", "den", Preprocessing(108, (96, 128), in_model), {}, "0", None, TRAINED)
    told, cases, expected = json.loads(contract.to_json()), [], []
    for (height, width), (fx, fy, cx, cy) in CAMERAS:
        intrinsics = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        cases.append({"image": {"width": width, "height": height}, "intrinsics": intrinsics.tolist()})
        preprocessing = contract.preprocessing_for((height, width), intrinsics)
        of_crop = preprocessing.crop_from_image((height, width)) @ intrinsics
        expected.append((preprocessing.short_side, intrinsics if in_model else of_crop))
    for height, width in ((480, 640), (720, 1280), (120, 160)):  # of unknown cameras
        cases.append({"image": {"width": width, "height": height}})
        crop_from_image = contract.preprocessing.crop_from_image((height, width))
        expected.append((108, np.linalg.inv(crop_from_image) @ TRAINED if in_model else TRAINED))
    phone = {"image": {"width": 4000, "height": 3000}, "lens_mm": 26}
    upright = {"image": {"width": 480, "height": 640}}
    asked = [{**case, "contract": told} for case in (*cases, phone, upright)]
    *found, of_phone, refused = json.loads(node(HERE / "framing.mjs", WEB, input=json.dumps(asked)))
    for each, (short_side, camera) in zip(found, expected, strict=True):
        assert each["short_side"] == short_side
        np.testing.assert_allclose(each["camera"], camera, rtol=1e-12, atol=1e-9)
    diagonal_deg = 2 * np.degrees(np.arctan(np.hypot(36, 24) / 2 / 26))  # what a lens of 26 mm sees on film
    focal_px = np.hypot(4000, 3000) / 2 / np.tan(np.radians(diagonal_deg / 2))
    assert of_phone["short_side"] == round(3000 * 120 / focal_px)
    if in_model:
        np.testing.assert_allclose(of_phone["camera"], [[focal_px, 0, 1999.5], [0, focal_px, 1499.5], [0, 0, 1]])
    assert refused["message"].endswith("turn the camera sideways, or say what lens took it.")


def code_of(page, language, holding):
    text = (resources.files("mambaloc.export") / "integration" / page).read_text()
    (code,) = [block for block in re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL) if holding in block]
    return code


@pytest.fixture(params=["usual", "lenses"])
def pictures(request):
    """A bundle of models that take images as they are, and perhaps their cameras."""
    if request.param == "usual":
        return request.getfixturevalue("raw_bundle")
    return request.getfixturevalue("bundles_for_lenses") / "pictures"


@pytest.mark.parametrize("precision", ["", "fp16."])
def test_the_page_on_pcs_in_python(pictures, precision, tmp_path):
    model = f"model.{precision}onnx"
    if not (pictures / model).is_file():
        pytest.skip("an untrained DenseLoc is not exported in float16")
    (tmp_path / "localize.py").write_text(code_of("pc.md", "python", "class Localizer"))
    command = [sys.executable, tmp_path / "localize.py", pictures, model]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout == "the port is right\n", done.stderr


def test_the_page_on_pcs_in_node(pictures, modules, tmp_path, node):
    (tmp_path / "node_modules").symlink_to(modules)
    (tmp_path / "localize.mjs").write_text(code_of("pc.md", "js", "localize.mjs"))
    assert node(tmp_path / "localize.mjs", pictures, cwd=tmp_path) == "the port is right\n"


def test_the_page_on_the_web(pictures, modules, tmp_path, node):
    """Its class and its check, with the build for Node in place of the browser's."""
    (tmp_path / "node_modules").symlink_to(modules)
    code = code_of("web.md", "js", "// localizer.js").replace("./ort/ort.wasm.min.mjs", "onnxruntime-web")
    code = code.replace("ort.env.wasm.wasmPaths = new URL('./ort/', import.meta.url).href;", "")
    (tmp_path / "localizer.mjs").write_text(code)
    (tmp_path / "check.mjs").write_text(
        """
        import { readFile } from "node:fs/promises";
        import { PNG } from "pngjs";
        import { Localizer, checkPort } from "./localizer.mjs";
        const [bundle] = process.argv.slice(2);
        const contract = JSON.parse(await readFile(`${bundle}/contract.json`, "utf8"));
        const localizer = await Localizer.create(new Uint8Array(await readFile(`${bundle}/model.onnx`)), contract);
        await checkPort(localizer, "model.onnx", async (file) => PNG.sync.read(await readFile(`${bundle}/${file}`)));
        console.log("the port is right");
        """
    )
    assert node(tmp_path / "check.mjs", pictures, cwd=tmp_path) == "the port is right\n"
