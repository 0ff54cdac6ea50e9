"""Bundles: everything that an app needs of a trained system, verified before the folder gets its name."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from rich.console import Console

from mambaloc.data import MultiSceneDataModule, PoseDataModule
from mambaloc.errors import InputError
from mambaloc.export.maps import check_scene, describe_map, map_vector
from mambaloc.export.onnx import contract_of_training, export_onnx
from mambaloc.export.pages import write_pages
from mambaloc.export.precision import half_precision, write_ort
from mambaloc.export.preprocessing import ties_rounded_otherwise, with_preprocessing
from mambaloc.export.quantization import QuantizedModel, eight_bit
from mambaloc.files import atomic_folder, sha256
from mambaloc.geometry import canonical, rotation_error_deg
from mambaloc.images import Image, read_image
from mambaloc.models import LitPoseRegressor
from mambaloc.runtime.bundle import CONTRACT_FILE, Deviation, replay, verify_bundle
from mambaloc.runtime.contract import METADATA_KEY, MODEL_FILES, Contract
from mambaloc.runtime.maps import MAP_FILE, MapLocalizer, SparseMap
from mambaloc.uncertainty import UncertaintyHead, fit_uncertainty

FORMATS = tuple(MODEL_FILES)
TRAJECTORY_FILE = "trajectory.json"
_FRAMES = 5
_ALLOWED = {"onnx": (1.0, 0.1), "ort": (1.0, 0.1), "fp16": (20.0, 1.0)}
"""Largest deviation in millimetres and degrees, per metre of the scene's size; int8 has a gate of its own."""
_TIES_ALLOWED = 2.0
"""Where the model resizes: that many times the change of a frame's pose when all its ties are rounded the other way."""


@dataclass(frozen=True)
class WrittenBundle:
    """What was written.

    Args:
        deviations: of each model in the bundle from PyTorch.
        int8: how quantisation went, where it was asked for; left out unless it is ``within_tolerance``.
        unsure: why the models estimate no uncertainty, if they do not.
    """

    deviations: list[Deviation]
    int8: QuantizedModel | None
    unsure: str | None


def write_bundle(
    system: LitPoseRegressor,
    data: PoseDataModule | MultiSceneDataModule,
    out: Path,
    formats: Sequence[str] = ("onnx", "fp16"),
    target: str = "android",
    raw_input: bool = True,
    sparse_map: Path | None = None,
) -> WrittenBundle:
    """Write a bundle's folder; it appears once every model in it has found the poses that the system finds.

    Int8 is left out where it loses too much; see :func:`~mambaloc.export.quantization.eight_bit`.

    Args:
        system: trained.
        data: what it was trained with; a few of its test frames go into the bundle.
        out: the folder, which must not be there yet.
        formats: of ``FORMATS``.
        target: of ``TARGETS``, which its page on integration is about.
        raw_input: resize, crop and scale inside the models, which then take RGB of any size, as every page on
            integration has it; otherwise they take what :class:`~mambaloc.runtime.contract.Preprocessing` makes of
            an image.
        sparse_map: file of a map of the scene, which is copied into the bundle; None for several scenes.

    Raises:
        InputError: where the folder is there or cannot be written, the test frames are not there, a model deviates, the
            map is damaged or of another scene, or nothing is left to write.
    """
    if out.exists():
        raise InputError(f"{out}: already exists; choose another folder with --out, or remove it")
    scenes = data.each_scene()
    if isinstance(data, MultiSceneDataModule) and (sparse_map or "int8" in formats):
        what = f"{sparse_map}: a map is of one scene" if sparse_map else "--to int8: is decided on one scene's frames"
        raise InputError(f"{what}, and this network knows {len(scenes)}. Leave it out.")
    data.setup("test")
    status = Console(stderr=True).status(f"exporting {system.registry_name}")
    with status, atomic_folder(out, "choose another folder with --out") as partial:
        try:
            uncertainty, unsure = fit_uncertainty(system, data), None
        except InputError as error:
            uncertainty, unsure = None, f"the models estimate no uncertainty: {error}"
        in_map = None if sparse_map is None else _copy_map(sparse_map, scenes[0], partial)
        contract, int8 = _write_models(system, data, partial, formats, raw_input, uncertainty)
        written = [name for name in formats if (partial / MODEL_FILES[name]).is_file()]
        if not written:
            raise InputError(f"{out}: nothing to write: {int8}")
        frames = _write_frames(system, data, partial, contract, in_map)
        if len(scenes) == 1:  # others have no frame of reference in common
            _write_trajectory(scenes[0], partial)
        size_m = max(1.0, float(system.network.head.position_scale.scale_m.max()))
        models = [MODEL_FILES[name] for name in written]
        write_pages(
            partial, contract, scenes[0].hparams["dataset"], models, target, None if in_map is None else in_map.map
        )
        described = {} if in_map is None else {"map": describe_map(in_map.map)}
        _write_contract(partial, contract, frames, written, size_m, int8, described)
        deviations = verify_bundle(partial)
        if bad := [each for each in deviations if not each.within]:
            worst = f"{bad[0].position_mm:.2g} mm and {bad[0].rotation_deg:.2g} deg"
            raise InputError(f"{out / bad[0].file}: deviates by {worst} from its original, so no bundle was written")
    return WrittenBundle(deviations, int8, unsure)


def _copy_map(path: Path, data: PoseDataModule, folder: Path) -> MapLocalizer:
    sparse_map = SparseMap.load(path)
    check_scene(path, sparse_map, data)
    shutil.copyfile(path, folder / MAP_FILE)
    return MapLocalizer(sparse_map)


def _write_models(
    system: LitPoseRegressor,
    data: PoseDataModule | MultiSceneDataModule,
    folder: Path,
    formats: Sequence[str],
    raw_input: bool,
    uncertainty: UncertaintyHead | None,
) -> tuple[Contract, QuantizedModel | None]:
    plain = contract_of_training(system, data, uncertainty)
    contract = replace(plain, preprocessing=replace(plain.preprocessing, in_model=raw_input))
    network = folder / MODEL_FILES["onnx"]
    export_onnx(system, network, plain, uncertainty)
    model = onnx.load(network)
    int8 = eight_bit(model, data.each_scene()[0]) if "int8" in formats else None
    models, focal_px = {"onnx": model}, contract.intrinsics[0][0] if contract.intrinsics else None
    if "fp16" in formats:
        models["fp16"] = half_precision(model)
    if int8 and int8.within_tolerance:
        models["int8"] = int8.model
    for name, each in models.items():
        whole = with_preprocessing(each, contract.preprocessing, focal_px) if raw_input else each
        _write_metadata(whole, contract)
        onnx.save(whole, folder / MODEL_FILES[name])
    if "ort" in formats:
        write_ort(network, folder / MODEL_FILES["ort"])
    if "onnx" not in formats:
        network.unlink()
    return contract, int8


def _write_metadata(model: onnx.ModelProto, contract: Contract) -> None:
    del model.metadata_props[:]
    model.metadata_props.add(key=METADATA_KEY, value=contract.to_json())


def _write_frames(
    system: LitPoseRegressor,
    data: PoseDataModule | MultiSceneDataModule,
    folder: Path,
    contract: Contract,
    in_map: MapLocalizer | None,
) -> list[dict[str, Any]]:
    """Write test frames, evenly spread, with the poses that the system itself finds, and those that its map finds.

    For a system that takes intrinsics there is one of another lens besides: a part of the first frame, not its middle.
    As PNG: no two decoders agree on a JPEG.
    """
    images, cameras = [], np.empty((0, 3, 3))
    for each in data.each_scene():
        frames = each.frames("test")
        rows = frames.evenly_spread(max(1, _FRAMES // len(data.each_scene())))
        images += [read_image(frames.image_paths[row]) for row in rows]
        cameras = np.concatenate([cameras, each.scene.parts["test"].data.cameras.intrinsics[rows]])
    if contract.intrinsics is not None:
        left = images[0].shape[1] // 8
        images.append(images[0][:, left:])
        cameras = np.concatenate([cameras, cameras[:1] - [[0, 0, left], [0, 0, 0], [0, 0, 0]]])
    (folder / "frames").mkdir()
    entries: list[dict[str, Any]] = []
    for number, (rgb, intrinsics) in enumerate(zip(images, cameras, strict=True)):
        copy = f"frames/{number}.png"
        (folder / copy).write_bytes(cv2.imencode(".png", rgb[..., ::-1])[1].tobytes())
        described = {"file": copy, **_network_vector(system, contract, rgb, intrinsics)}
        if contract.intrinsics is not None or in_map is not None:
            described["intrinsics"] = intrinsics.tolist()
        if in_map is not None:
            described["map"] = map_vector(in_map, rgb, intrinsics)
        entries.append(described)
    return entries


def _network_vector(
    system: LitPoseRegressor, contract: Contract, rgb: Image, intrinsics: NDArray[np.float64]
) -> dict[str, Any]:
    preprocessing, camera = contract.preprocessing, None
    if contract.intrinsics is not None:
        preprocessing = contract.preprocessing_for(rgb.shape[:2], intrinsics)
        camera = torch.from_numpy(preprocessing.crop_from_image(rgb.shape[:2]) @ intrinsics).float()[None]
    crops = np.stack([preprocessing.apply(rgb), ties_rounded_otherwise(rgb, preprocessing)])
    images = torch.from_numpy(np.ascontiguousarray(crops.transpose(0, 3, 1, 2))).float() / 255
    with torch.inference_mode():
        predictions = [system.cpu().eval()(image[None], camera) for image in images]
    positions = [each.position_m[0].double() for each in predictions]
    quaternions = [canonical(each.quaternion)[0] for each in predictions]
    return {
        "position_m": predictions[0].position_m[0].tolist(),
        "quaternion_wxyz": quaternions[0].tolist(),
        "by_rounding": {
            "position_mm": 1000 * float((positions[0] - positions[1]).norm()),
            "rotation_deg": float(rotation_error_deg(*quaternions)),
        },
    }


def _write_trajectory(data: PoseDataModule, folder: Path) -> None:
    """Write where the training frames were taken, x y z qw qx qy qz a frame, for an app to draw."""
    try:
        frames = data.listed_training_frames()
    except InputError:  # a test split alone can be exported too
        return
    poses = np.concatenate([frames.position_m, frames.quaternion], axis=1).round(5)
    sequences = {name: poses[rows].tolist() for name, rows in frames.by_sequence().items()}
    (folder / TRAJECTORY_FILE).write_text(json.dumps({"sequences": sequences}) + "\n", encoding="utf-8")


def _write_contract(
    folder: Path,
    contract: Contract,
    frames: list[dict[str, Any]],
    formats: Sequence[str],
    size_m: float,
    int8: QuantizedModel | None,
    described_map: dict[str, Any],
) -> None:
    """Write ``contract.json``, last of all files, since it digests them."""
    others = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    files: dict[str, dict[str, Any]] = {MODEL_FILES[name]: {} for name in formats}
    files |= {name: {} for path in others if (name := path.relative_to(folder).as_posix()) not in files}
    for name, entry in files.items():
        entry |= {"sha256": sha256(folder / name), "bytes": (folder / name).stat().st_size}
    for name in formats:
        if name == "int8":
            assert int8 is not None
            mm, deg, _ = replay(folder / MODEL_FILES[name], frames)
            # Its gate was the median error; this is for ports: its kernels round otherwise on another processor.
            allowed_mm, allowed_deg = 1.5 * mm + 5, 1.5 * deg + 0.25
            files[MODEL_FILES[name]]["quantised"] = _in_figures(int8)
        else:
            allowed_mm, allowed_deg = _ALLOWED[name][0] * size_m, _ALLOWED[name][1]
            if contract.preprocessing.in_model:
                allowed_mm += _TIES_ALLOWED * max(frame["by_rounding"]["position_mm"] for frame in frames)
                allowed_deg += _TIES_ALLOWED * max(frame["by_rounding"]["rotation_deg"] for frame in frames)
        files[MODEL_FILES[name]]["allowed"] = {"position_mm": allowed_mm, "rotation_deg": allowed_deg}
    bundle = {**json.loads(contract.to_json()), **described_map, "files": files, "frames": frames}
    (folder / CONTRACT_FILE).write_text(json.dumps(bundle, indent=2) + "\n", encoding="utf-8")


def _in_figures(int8: QuantizedModel) -> dict[str, Any]:
    return {
        "layers": int8.kind,
        "position_error_m": int8.position_error_m,
        "rotation_error_deg": int8.rotation_error_deg,
        "loss": int8.loss,
        "measured_on": f"{int8.frames} test frames, on which the kind was decided",
    }
