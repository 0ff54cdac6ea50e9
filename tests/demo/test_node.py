"""The page's module and the pages on integration, run in Node and in Python for real."""

import json
import re
import subprocess
import sys
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from mambaloc.runtime import Localiser, Preprocessing
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
    localiser = Localiser(folder / model)
    frames = json.loads((folder / "contract.json").read_text())["frames"]
    assert len(found) == len(frames) == 5
    for pose, frame in zip(found, frames, strict=True):
        expected = localiser.localise(folder / frame["file"])
        assert 1000 * np.linalg.norm(np.array(pose["position_m"]) - expected.position_m) < 1
        assert rotation_error_deg(np.array(pose["quaternion_wxyz"]), expected.quaternion) < 0.1


CASES = [  # (height, width) of the picture, short side, crop
    ((480, 640), 256, (224, 224)),
    ((240, 320), 78, (72, 96)),
    ((720, 1280), 78, (72, 96)),
    ((512, 683), 256, (224, 320)),  # exactly halved one way
    ((512, 640), 256, (224, 224)),  # exactly halved
    ((97, 151), 36, (32, 34)),
    ((640, 480), 256, (224, 224)),
    ((100, 130), 128, (96, 128)),  # enlarged
    ((78, 104), 78, (72, 96)),  # as it is
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


def code_of(page, language, holding):
    text = (resources.files("mambaloc.export") / "integration" / page).read_text()
    (code,) = [block for block in re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL) if holding in block]
    return code


@pytest.mark.parametrize("model", ["model.onnx", "model.fp16.onnx"])
def test_the_page_on_pcs_in_python(raw_bundle, model, tmp_path):
    (tmp_path / "localise.py").write_text(code_of("pc.md", "python", "class Localiser"))
    command = [sys.executable, tmp_path / "localise.py", raw_bundle, model]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout == "the port is right\n", done.stderr


def test_the_page_on_pcs_in_node(raw_bundle, modules, tmp_path, node):
    (tmp_path / "node_modules").symlink_to(modules)
    (tmp_path / "localise.mjs").write_text(code_of("pc.md", "js", "localise.mjs"))
    assert node(tmp_path / "localise.mjs", raw_bundle, cwd=tmp_path) == "the port is right\n"


def test_the_page_on_the_web(raw_bundle, modules, tmp_path, node):
    """Its class and its check, with the build for Node in place of the browser's."""
    (tmp_path / "node_modules").symlink_to(modules)
    code = code_of("web.md", "js", "// localiser.js").replace("./ort/ort.wasm.min.mjs", "onnxruntime-web")
    code = code.replace("ort.env.wasm.wasmPaths = new URL('./ort/', import.meta.url).href;", "")
    (tmp_path / "localiser.mjs").write_text(code)
    (tmp_path / "check.mjs").write_text(
        """
        import { readFile } from "node:fs/promises";
        import { PNG } from "pngjs";
        import { Localiser, checkPort } from "./localiser.mjs";
        const [bundle] = process.argv.slice(2);
        const contract = JSON.parse(await readFile(`${bundle}/contract.json`, "utf8"));
        const localiser = await Localiser.create(new Uint8Array(await readFile(`${bundle}/model.onnx`)), contract);
        await checkPort(localiser, "model.onnx", async (file) => PNG.sync.read(await readFile(`${bundle}/${file}`)));
        console.log("the port is right");
        """
    )
    assert node(tmp_path / "check.mjs", raw_bundle, cwd=tmp_path) == "the port is right\n"
