"""Bundles: everything that an app needs of a trained system, verified before the folder gets its name."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch

from mambaloc.data import PoseDataModule
from mambaloc.data.download.origins import SOURCES
from mambaloc.errors import InputError
from mambaloc.export.onnx import contract_of, export_onnx
from mambaloc.export.precision import half_precision, write_ort
from mambaloc.export.preprocessing import with_preprocessing
from mambaloc.files import sha256, whole_folder
from mambaloc.geometry import canonical
from mambaloc.models import LitPoseRegressor
from mambaloc.runtime.bundle import CONTRACT_FILE, Deviation, verify_bundle
from mambaloc.runtime.contract import METADATA_KEY, Contract
from mambaloc.runtime.localiser import read_image

FORMATS = ("onnx", "fp16", "ort")
_FRAMES = 5
_ALLOWED = {"onnx": (1.0, 0.1), "ort": (1.0, 0.1), "fp16": (20.0, 1.0)}
"""Largest deviation in millimetres and degrees, per metre of the scene's size."""

_FILES = {"onnx": "model.onnx", "fp16": "model.fp16.onnx", "ort": "model.ort"}


def write_bundle(
    system: LitPoseRegressor,
    data: PoseDataModule,
    out: Path,
    formats: Sequence[str] = ("onnx", "fp16"),
    target: str = "android",
    raw_input: bool = False,
) -> list[Deviation]:
    """Write a bundle's folder; it appears once every model in it has found the poses that the system finds.

    Args:
        system: trained.
        data: what it was trained with; a few of its test frames go into the bundle.
        out: the folder, which must not be there yet.
        formats: of ``FORMATS``.
        target: machine that the ORT format is optimised for.
        raw_input: resize, crop and scale inside of the models, which then take RGB of any size.

    Raises:
        InputError: where the folder is there or cannot be written, the test frames are not there, or a model deviates.
    """
    if out.exists():
        raise InputError(f"{out}: is there already; choose another folder with --out, or remove it")
    with whole_folder(out, "choose another folder with --out") as partial:
        contract = _write_models(system, data, partial, formats, target, raw_input)
        frames = _write_frames(system, data, partial, contract)
        size_m = max(1.0, float(system.network.head.position_scale.scale_m))
        _write_contract(partial, contract, frames, formats, size_m)
        (partial / "README.md").write_text(_card(contract, data, formats), encoding="utf-8")
        deviations = verify_bundle(partial)
        if bad := [each for each in deviations if not each.within]:
            worst = f"{bad[0].position_mm:.2g} mm and {bad[0].rotation_deg:.2g} deg"
            raise InputError(f"{out / bad[0].file}: deviates by {worst} from PyTorch, so no bundle was written")
    return deviations


def _write_models(
    system: LitPoseRegressor, data: PoseDataModule, folder: Path, formats: Sequence[str], target: str, raw_input: bool
) -> Contract:
    plain = contract_of(system, data.hparams)
    contract = replace(plain, preprocessing=replace(plain.preprocessing, in_model=raw_input))
    network = folder / _FILES["onnx"]
    export_onnx(system, network, plain)
    for name in ("fp16", "onnx") if "fp16" in formats else ("onnx",):  # the plain one last: the other is made from it
        model = onnx.load(network)
        model = half_precision(model) if name == "fp16" else model
        if raw_input:
            model = with_preprocessing(model, contract.preprocessing)
        _tell(model, contract)
        onnx.save(model, folder / _FILES[name])
    if "ort" in formats:
        write_ort(network, folder / _FILES["ort"], target)
    if "onnx" not in formats:
        network.unlink()
    return contract


def _tell(model: onnx.ModelProto, contract: Contract) -> None:
    del model.metadata_props[:]
    model.metadata_props.add(key=METADATA_KEY, value=contract.to_json())


def _write_frames(
    system: LitPoseRegressor, data: PoseDataModule, folder: Path, contract: Contract
) -> list[dict[str, Any]]:
    """Copy test frames, evenly spread, with the poses that the system itself finds."""
    data.setup("test")
    paths = data.frames("test").image_paths
    chosen = [paths[row] for row in np.linspace(0, len(paths) - 1, min(_FRAMES, len(paths))).round().astype(int)]
    (folder / "frames").mkdir()
    told = []
    for number, path in enumerate(chosen):
        copy = Path("frames", f"{number}{path.suffix.lower()}")
        shutil.copyfile(path, folder / copy)
        cropped = contract.preprocessing.apply(read_image(path))
        image = torch.from_numpy(np.ascontiguousarray(cropped.transpose(2, 0, 1)))[None].float() / 255
        with torch.inference_mode():
            prediction = system.cpu().eval()(image)
        told.append(
            {
                "file": copy.as_posix(),
                "position_m": prediction.position_m[0].tolist(),
                "quaternion_wxyz": canonical(prediction.quaternion)[0].tolist(),
            }
        )
    return told


def _write_contract(
    folder: Path, contract: Contract, frames: list[dict[str, Any]], formats: Sequence[str], size_m: float
) -> None:
    files: dict[str, dict[str, Any]] = {}
    for name in formats:
        path = folder / _FILES[name]
        mm, deg = _ALLOWED[name]
        allowed = {"position_mm": mm * size_m, "rotation_deg": deg}
        files[path.name] = {"sha256": sha256(path), "bytes": path.stat().st_size, "allowed": allowed}
    for frame in frames:
        files[frame["file"]] = {"sha256": sha256(folder / frame["file"])}
    bundle = {**json.loads(contract.to_json()), "files": files, "frames": frames}
    (folder / CONTRACT_FILE).write_text(json.dumps(bundle, indent=2) + "\n", encoding="utf-8")


def _card(contract: Contract, data: PoseDataModule, formats: Sequence[str]) -> str:
    source = SOURCES.get(data.hparams["dataset"])
    terms = f"{source.title}: {source.licence}. {source.terms}" if source else "see who made them."
    models = "\n".join(f"- `{_FILES[name]}`" for name in formats)
    trained = "\n".join(
        f"- {name}: {_in_words(value)}" for name, value in contract.trained.items() if value is not None
    )
    return f"""# {contract.model} on {contract.scene}

Camera pose of one RGB image, {contract.pose}.

{models}
- `{CONTRACT_FILE}`: what the models are fed and say, digests, and the poses of `frames/` that a port must find

Check it with `python tools/verify_bundle.py FOLDER`.

## Trained

{trained}

## Licence

The code and the architecture: Apache-2.0. The weights follow the terms of the frames they were trained on, of which
`frames/` holds some. {terms}
"""


def _in_words(value: Any) -> str:
    return ", ".join(f"{k} {v}" for k, v in value.items()) if isinstance(value, dict) else str(value)
