"""What an exported model promises: what it must be fed, what it says, where it came from."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mambaloc.errors import InputError
from mambaloc.images import Image, center_corner, center_cropped, resized, resized_size
from mambaloc.runtime.maps.features import check_intrinsics
from mambaloc.runtime.undistortion import Undistortion
from mambaloc.runtime.world import World

VERSION = 1
_MAX_PIXELS = 8192  # of a side
MAX_ENLARGEMENT = 4
"""How many times as large as the training camera's images another camera's are made at most; it bounds the memory."""
METADATA_KEY = "mambaloc"
IMAGE_INPUT = "image"
"""Name of the input of models that take what :class:`Preprocessing` makes of an image, in 0..1."""
RAW_INPUT = "rgb"
"""Name of the input of models that resize, crop and scale by themselves."""
INTRINSICS_INPUT = "intrinsics"
"""Name of the second input of models whose poses depend on the camera. It is never optional: ONNX Runtime uses the
value of an optional input in Python, ignores it in Node.js and refuses it on the web."""
MODEL_FILES = {"onnx": "model.onnx", "fp16": "model.fp16.onnx", "int8": "model.int8.onnx", "ort": "model.ort"}
"""What a bundle's models are called, by format, the most exact first."""

UNCERTAINTY = ("position_radius_m", "rotation_radius_deg", "unfamiliarity")
"""Outputs of a model that estimates its uncertainty."""

SCENE_PROBABILITY = "scene_probability"
"""Output of a model that knows several scenes: how likely the image shows each, (batch, scenes), of sum 1."""

POSE = (
    "world_from_cam: camera centre in metres, unit quaternion wxyz with w >= 0; "
    "OpenCV camera axes (x right, y down, z forward)"
)


@dataclass(frozen=True)
class Preprocessing:
    """What an image goes through before the network sees it.

    Args:
        short_side: what the shorter side is resized to, in pixels, averaging areas.
        crop: (height, width) taken from the middle.
        in_model: the model does it, and is fed (height, width, 3) ``uint8`` of any size.
    """

    short_side: int
    crop: tuple[int, int]
    in_model: bool = False

    def apply(self, image: Image) -> Image:
        """Resize and crop an RGB image; (H, W, 3) -> (*crop, 3)."""
        return center_cropped(resized(image, self.short_side), self.crop)

    def crop_from_image(self, size: tuple[int, int]) -> NDArray[np.float64]:
        """Where pixels go: (3, 3), homogeneous ``(x, y)`` of an image of ``size`` (height, width) to its crop's.

        Its product with the image's pinhole matrix is the crop's.
        """
        height, width = resized_size(size, self.short_side)
        y, x = height / size[0], width / size[1]
        top, left = center_corner((height, width), self.crop)
        return np.array([[x, 0, (x - 1) / 2 - left], [0, y, (y - 1) / 2 - top], [0, 0, 1]])

    def holds_crop(self, size: tuple[int, int]) -> bool:
        """Whether an image of ``size`` (height, width) is large enough once it is resized."""
        height, width = resized_size(size, self.short_side)
        return height >= self.crop[0] and width >= self.crop[1]


@dataclass(frozen=True)
class SceneFrame:
    """One of several scenes that a model knows.

    Args:
        name: of the scene.
        world: where its frame lies in that of the data it was made of.
    """

    name: str
    world: World = field(default_factory=World)


@dataclass(frozen=True)
class Contract:
    """The contract of one model; written into the ONNX file's metadata and into a bundle's ``contract.json``.

    Args:
        model: registry name of the system.
        scene: dataset and scene that it knows.
        preprocessing: of its input.
        trained: provenance of its training: commit, seed, device, versions.
        weights_sha256: of its parameters and buffers, whatever precision they are stored in.
        uncertainty: how its radii were measured, if the model has them: the share of poses within, on how many frames.
        intrinsics: the training camera's pinhole matrix in pixels of the crop, for a model that takes intrinsics; what
            it is fed where the camera is unknown.
        pose: frame, units and order of its outputs.
        world: where the scene's frame lies in that of the data it was made of.
        undistortion: how the training images were made of what their camera stored.
        scenes: of a model that knows several, in the order of its probabilities; poses are in the likeliest's frame.
    """

    model: str
    scene: str
    preprocessing: Preprocessing
    trained: dict[str, Any]
    weights_sha256: str
    uncertainty: dict[str, Any] | None = None
    intrinsics: tuple[tuple[float, float, float], ...] | None = None
    pose: str = POSE
    world: World = field(default_factory=World)
    undistortion: Undistortion = field(default_factory=Undistortion)
    scenes: tuple[SceneFrame, ...] = ()

    @property
    def outputs(self) -> dict[str, list[str | int]]:
        """Names and shapes of what the model says of an image, in their order."""
        outputs: dict[str, list[str | int]] = {"position_m": ["batch", 3], "quaternion_wxyz": ["batch", 4]}
        if self.uncertainty is not None:
            outputs |= {name: ["batch"] for name in UNCERTAINTY}
        if self.scenes:
            outputs[SCENE_PROBABILITY] = ["batch", len(self.scenes)]
        return outputs

    def preprocessing_for(self, size: tuple[int, int], intrinsics: ArrayLike) -> Preprocessing:
        """Resizing that shows things as large as the training camera does; the crop may then be black at its border.

        Networks know things at one scale: with the focal length of the training camera errors stay as they were, with
        another one they grow by half, although the intrinsics are right.

        Args:
            size: (height, width) of the camera's images.
            intrinsics: (3, 3) pinhole matrix in pixels of the cropped image.
        """
        assert self.intrinsics is not None  # of a model that takes them
        preprocessing = self.preprocessing
        as_large = round(min(size) * self.intrinsics[0][0] / np.asarray(intrinsics)[0, 0])
        return replace(preprocessing, short_side=min(max(as_large, 1), MAX_ENLARGEMENT * preprocessing.short_side))

    def to_json(self) -> str:
        """Write it down, with what its input looks like for those who read no code."""
        height, width = self.preprocessing.crop
        raw = self.preprocessing.in_model
        tensor = {
            "name": RAW_INPUT if raw else IMAGE_INPUT,
            "dtype": "uint8" if raw else "float32",
            "shape": ["height", "width", 3] if raw else ["batch", 3, height, width],
            "range": [0, 255] if raw else [0, 1],
            "colour": "RGB",
        }
        inputs: dict[str, Any] = {"undistortion": self.undistortion.to_json(), "input": tensor}
        if self.intrinsics is not None:
            inputs["intrinsics_input"] = {
                "name": INTRINSICS_INPUT,
                "dtype": "float32",
                "shape": [1 if raw else "batch", 3, 3],
                "in_pixels_of": tensor["name"],
            }
        return json.dumps({"contract": VERSION, **asdict(self), **inputs, "outputs": self.outputs}, indent=2)

    @classmethod
    def from_json(cls, text: str, where: str) -> Contract:
        """Read it.

        Args:
            text: what :meth:`to_json` wrote.
            where: the file, for messages.

        Raises:
            InputError: for anything else.
        """
        try:
            data = json.loads(text)
            version, preprocessing = data["contract"], data["preprocessing"]
            if version != VERSION:
                raise InputError(
                    f"{where}: contract of version {version!r}, but version {VERSION} is expected. Export the "
                    "model again."
                )
            height, width = map(int, preprocessing["crop"])
            short_side = int(preprocessing["short_side"])
            if not all(1 <= pixels <= _MAX_PIXELS for pixels in (height, width, short_side)):
                raise ValueError(f"pixels go from 1 to {_MAX_PIXELS}")
            return cls(
                str(data["model"]),
                str(data["scene"]),
                Preprocessing(short_side, (height, width), bool(preprocessing["in_model"])),
                dict(data["trained"]),
                str(data["weights_sha256"]),
                None if data.get("uncertainty") is None else dict(data["uncertainty"]),
                None if data.get("intrinsics") is None else _matrix(data["intrinsics"], (width, height)),
                str(data["pose"]),
                World.from_json(data.get("world")),
                Undistortion.from_json(data.get("undistortion")),
                tuple(
                    SceneFrame(str(each["name"]), World.from_json(each["world"])) for each in data.get("scenes") or ()
                ),
            )
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
            reason = f"{type(error).__name__}: {error}"
            raise InputError(f"{where}: its contract cannot be read ({reason}); export the model again") from None


def _matrix(rows: Any, size: tuple[int, int]) -> tuple[tuple[float, float, float], ...]:
    try:
        check_intrinsics(rows, size)
    except InputError as error:
        raise ValueError(error) from None
    return tuple((float(x), float(y), float(z)) for x, y, z in rows)
