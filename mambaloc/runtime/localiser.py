"""Poses from images with an exported model."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from mambaloc.errors import InputError
from mambaloc.images import Image, as_rgb, read_image, resized_size
from mambaloc.runtime.contract import METADATA_KEY, MODEL_FILES, Contract
from mambaloc.runtime.sources import SourceFrame, frames_of


@dataclass(frozen=True)
class Localisation:
    """Where one image was taken: ``world_from_cam``.

    Shape:
        ``position_m`` (3,) camera centre in metres; ``quaternion`` (4,) unit, wxyz, ``w >= 0``.

    Args:
        position_m: in the scene's frame.
        quaternion: likewise.
        latency_s: seconds that preprocessing and the network took.
        position_radius_m: the share of poses that the contract says, nine of ten, are within this; None where the
            model does not tell.
        rotation_radius_deg: likewise.
        unfamiliarity: how far the image is from those that the model was trained on; over 1, hardly any frame of the
            place is.
    """

    position_m: NDArray[np.float32]
    quaternion: NDArray[np.float32]
    latency_s: float
    position_radius_m: float | None = None
    rotation_radius_deg: float | None = None
    unfamiliarity: float | None = None

    @property
    def is_unfamiliar(self) -> bool:
        """Whether the image does not look like the place, so that the pose says nothing; never, where none can tell."""
        return self.unfamiliarity is not None and not self.unfamiliarity <= 1


class Localiser:
    """A model on ONNX Runtime.

    Args:
        model: an ``.onnx`` or ``.ort`` file that ``tools/export.py`` wrote, or a bundle's folder.
        threads: that one image may use; ONNX Runtime's choice unless given.

    Raises:
        InputError: where there is no such model, it cannot be run, or it carries no contract.
    """

    def __init__(self, model: str | Path, threads: int | None = None) -> None:
        self.path = _model_file(Path(model))
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3
        options.intra_op_num_threads = threads or 0
        try:
            self._session = onnxruntime.InferenceSession(str(self.path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # ONNX Runtime's own exceptions share no base
            reason = str(error).splitlines()[0]
            raise InputError(f"{self.path}: ONNX Runtime cannot load it ({reason}); export it anew") from None
        metadata = self._session.get_modelmeta().custom_metadata_map
        if METADATA_KEY not in metadata:
            raise InputError(f"{self.path}: carries no contract of its input; export it with tools/export.py")
        self.contract = Contract.from_json(metadata[METADATA_KEY], str(self.path))
        self._check_input()

    def localise(self, image: str | Path | Image) -> Localisation:
        """Localise one image.

        Args:
            image: a file; or RGB (H, W, 3), or grey (H, W), ``uint8``, of any size.

        Raises:
            InputError: for a file that is missing or no whole image, or an array of another kind.
        """
        rgb = read_image(image) if isinstance(image, str | Path) else as_rgb(image)
        start = time.perf_counter()
        said = self._session.run(None, {self._session.get_inputs()[0].name: self._fed(rgb)})
        taken_s, (position_m, quaternion, *uncertainty) = time.perf_counter() - start, (each[0] for each in said)
        return Localisation(position_m, quaternion, taken_s, *map(float, uncertainty))

    def localise_each(self, source: str | Path | Iterable[SourceFrame]) -> Iterator[tuple[float, Localisation]]:
        """Localise a source's frames one after another, each with its time in seconds since the first.

        Args:
            source: as :func:`~mambaloc.runtime.sources.frames_of` takes it, or the frames that it gives.

        Raises:
            InputError: where there is no such source, or a frame cannot be localised.
        """
        for frame in frames_of(source)[0] if isinstance(source, str | Path) else source:
            yield frame.time_s, self.localise(frame.image)

    def _check_input(self) -> None:
        """The metadata and the graph may come from two hands."""
        outputs = [output.name for output in self._session.get_outputs()]
        if outputs != list(self.contract.outputs):
            raise InputError(f"{self.path}: says {outputs}, as its contract does not; export it anew")
        told, given = self.contract.preprocessing, self._session.get_inputs()[0]
        expected = ("tensor(uint8)", [3]) if told.in_model else ("tensor(float)", [3, *told.crop])
        if (given.type, given.shape[-len(expected[1]) :]) != expected:
            raise InputError(
                f"{self.path}: takes {given.type} {given.shape}, as its contract does not say; export it anew"
            )

    def _fed(self, rgb: Image) -> NDArray[np.generic]:
        preprocessing = self.contract.preprocessing
        size = resized_size(rgb.shape[:2], preprocessing.short_side)
        if size[0] < preprocessing.crop[0] or size[1] < preprocessing.crop[1]:
            given, needed = (f"{width}x{height}" for height, width in (rgb.shape[:2], preprocessing.crop))
            raise InputError(
                f"image of {given}: resized to short side {preprocessing.short_side} it does not hold the model's crop "
                f"of {needed}; give frames shaped as in training"
            )
        if preprocessing.in_model:
            return np.ascontiguousarray(rgb)
        return (preprocessing.apply(rgb).transpose(2, 0, 1)[None] / np.float32(255)).astype(np.float32)


def _model_file(path: Path) -> Path:
    if path.is_dir():
        found = [path / name for name in MODEL_FILES.values() if (path / name).is_file()]
        if not found:
            raise InputError(
                f"{path}: holds none of {', '.join(MODEL_FILES.values())}; give a bundle of tools/export.py"
            )
        return found[0]
    if not path.is_file():
        raise InputError(f"{path}: no such model; tools/export.py writes them")
    return path
