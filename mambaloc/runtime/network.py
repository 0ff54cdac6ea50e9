"""Poses from images with an exported network."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import ArrayLike, NDArray

from mambaloc.errors import InputError
from mambaloc.images import Image
from mambaloc.runtime.contract import INTRINSICS_INPUT, METADATA_KEY, SCENE_PROBABILITY, UNCERTAINTY, Contract
from mambaloc.runtime.localization import Localization
from mambaloc.runtime.maps.features import check_intrinsics


class Network:
    """A network on ONNX Runtime.

    Args:
        path: an ``.onnx`` or ``.ort`` file that ``mambaloc export`` wrote.
        threads: that one image may use; ONNX Runtime's choice unless given.

    Raises:
        InputError: where there is no such model, it cannot be run, or it carries no contract.
    """

    def __init__(self, path: Path, threads: int | None = None) -> None:
        if not path.is_file():
            raise InputError(f"{path}: no such model; mambaloc export writes them")
        self.path = path
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3
        options.intra_op_num_threads = threads or 0
        try:
            self._session = onnxruntime.InferenceSession(str(self.path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # ONNX Runtime's own exceptions share no base
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise InputError(f"{self.path}: ONNX Runtime cannot load it ({reason}); export it again") from None
        metadata = self._session.get_modelmeta().custom_metadata_map
        if METADATA_KEY not in metadata:
            raise InputError(f"{self.path}: has no contract (metadata of its input). Export it with mambaloc export.")
        self.contract = Contract.from_json(metadata[METADATA_KEY], str(self.path))
        self._check_input()

    def localize(
        self, images: Sequence[Image], intrinsics: Sequence[ArrayLike | None] | None = None
    ) -> list[Localization]:
        """Localize RGB images (H, W, 3), ``uint8``: together, or one after another if the model takes raw input.

        Args:
            images: N images, of any sizes.
            intrinsics: (3, 3) pinhole matrix in the pixels of each, which a model that takes none leaves unread; the
                training camera's where None.

        Returns:
            N poses. The latency of each is that of the batch, divided by its size.

        Raises:
            InputError: for intrinsics that cannot be the image's; and, without them, for an image that does not hold
                the crop that the network takes.
        """
        if self.contract.intrinsics is None or intrinsics is None:
            intrinsics = [None] * len(images)
        start = time.perf_counter()
        feeds = [self._feeds(rgb, matrix) for rgb, matrix in zip(images, intrinsics, strict=True)]
        if self.contract.preprocessing.in_model:
            outputs = [self._session.run(None, feed) for feed in feeds]
        else:
            outputs = [self._session.run(None, {name: np.concatenate([f[name] for f in feeds]) for name in feeds[0]})]
        latency_s = (time.perf_counter() - start) / len(images)
        rows = (row for batch in outputs for row in zip(*batch, strict=True))
        return [self._localization(dict(zip(self.contract.outputs, row, strict=True)), latency_s) for row in rows]

    def _localization(self, found: dict[str, NDArray[Any]], latency_s: float) -> Localization:
        radius_m, radius_deg, unfamiliarity = (float(found[name]) if name in found else None for name in UNCERTAINTY)
        answer = Localization(
            found["position_m"], found["quaternion_wxyz"], latency_s, radius_m, radius_deg, unfamiliarity
        )
        if not self.contract.scenes:
            return answer
        likeliest = int(found[SCENE_PROBABILITY].argmax())
        return replace(
            answer,
            scene=self.contract.scenes[likeliest].name,
            scene_probability=float(found[SCENE_PROBABILITY][likeliest]),
        )

    def _check_input(self) -> None:
        """The metadata and the graph may come from two hands."""
        outputs = [output.name for output in self._session.get_outputs()]
        if outputs != list(self.contract.outputs):
            raise InputError(f"{self.path}: outputs {outputs} do not match its contract. Export the model again.")
        preprocessing, (given, *others) = self.contract.preprocessing, self._session.get_inputs()
        expected = ("tensor(uint8)", [3]) if preprocessing.in_model else ("tensor(float)", [3, *preprocessing.crop])
        if (given.type, given.shape[-len(expected[1]) :]) != expected:
            raise InputError(
                f"{self.path}: input {given.type} {given.shape} does not match its contract. Export the model again."
            )
        cameras = [(other.name, other.type, other.shape[-2:]) for other in others]
        if cameras != ([] if self.contract.intrinsics is None else [(INTRINSICS_INPUT, "tensor(float)", [3, 3])]):
            named = [other.name for other in others]
            raise InputError(f"{self.path}: input {named} does not match its contract. Export the model again.")

    def _feeds(self, rgb: Image, intrinsics: ArrayLike | None) -> dict[str, NDArray[np.generic]]:
        contract, size = self.contract, rgb.shape[:2]
        preprocessing = contract.preprocessing
        if intrinsics is not None:
            check_intrinsics(intrinsics, (size[1], size[0]))
            preprocessing = contract.preprocessing_for(size, intrinsics)
        elif not preprocessing.holds_crop(size):
            given, needed = (f"{width}x{height}" for height, width in (size, preprocessing.crop))
            raise InputError(
                f"image of {given}: resized to short side {preprocessing.short_side} it does not hold the model's crop "
                f"of {needed}; give frames shaped as in training"
                + ("" if contract.intrinsics is None else ", or their intrinsics")
            )
        if preprocessing.in_model:
            fed: NDArray[np.generic] = np.ascontiguousarray(rgb)
        else:
            fed = (preprocessing.apply(rgb).transpose(2, 0, 1)[None] / np.float32(255)).astype(np.float32)
        feeds = {self._session.get_inputs()[0].name: fed}
        if contract.intrinsics is not None:
            crop_from_image = preprocessing.crop_from_image(size)
            own = (
                np.linalg.solve(crop_from_image, contract.intrinsics) if intrinsics is None else np.asarray(intrinsics)
            )
            matrix = own if preprocessing.in_model else crop_from_image @ own
            feeds[INTRINSICS_INPUT] = matrix[None].astype(np.float32)
        return feeds
