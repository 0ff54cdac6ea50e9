"""Poses from images with an exported network, a sparse map, or both."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import deprecated

from mambaloc.errors import InputError, InputWarning
from mambaloc.images import Image, as_rgb, read_image
from mambaloc.runtime.contract import MODEL_FILES, Contract
from mambaloc.runtime.localization import Localization, combined
from mambaloc.runtime.maps import MAP_FILE, CameraPose, MapLocalization, MapLocalizer, SparseMap
from mambaloc.runtime.maps.features import rescaled_intrinsics
from mambaloc.runtime.network import Network
from mambaloc.runtime.sources import SourceFrame, frames_of
from mambaloc.runtime.undistortion import Undistortion
from mambaloc.runtime.world import World


class Localizer:
    """A network, and a sparse map beside it.

    The map's pose is the answer where it is accepted, or likelier to be right than the network's. What keeps the map
    from being used, such as a damaged file or an image whose camera is unknown, is a warning, and the network answers.

    Args:
        model: an ``.onnx`` or ``.ort`` file that ``mambaloc export`` wrote; a bundle's folder; or a ``.safetensors``
            file that ``mambaloc map`` wrote, or its folder, to localize in the map alone.
        threads: that the network may use for one image; ONNX Runtime's choice unless given.
        sparse_map: the map to use beside a network, or its file. True takes the bundle's own, if it has one; False
            leaves it out.

    Raises:
        InputError: where there is no such model, it cannot be run, or it carries no contract; and where a map that was
            named cannot be read.
    """

    def __init__(
        self, model: str | Path, threads: int | None = None, sparse_map: SparseMap | str | Path | bool = True
    ) -> None:
        path, file = Path(model), _model_file(Path(model))
        is_map = file.suffix == Path(MAP_FILE).suffix
        self._network = None if is_map else Network(file, threads)
        found = SparseMap.load(file) if is_map else _map_beside(path, sparse_map)
        self._map = None if found is None else MapLocalizer(found)
        self._path = path

    @property
    def contract(self) -> Contract | None:
        """The network's; None of a map alone."""
        return None if self._network is None else self._network.contract

    @property
    def sparse_map(self) -> SparseMap | None:
        """The map that is used."""
        return None if self._map is None else self._map.map

    @property
    def runs_batches(self) -> bool:
        """Whether images that come together take less time: of a network that takes tensors, without a map."""
        return self.contract is not None and not self.contract.preprocessing.in_model and self._map is None

    @property
    def scene(self) -> str:
        """Name of the place, as the network's contract has it, or the map alone."""
        return self._place.scene

    @property
    def world(self) -> World:
        """Where the scene's frame lies in the world that answers are in: that of the data it was made of."""
        return self._place.world

    def world_of(self, answer: Localization) -> World:
        """Where the frame of an answer's scene lies, of a network that knows several; :attr:`world` of others."""
        scenes = self.contract.scenes if self.contract else ()
        return next((each.world for each in scenes if each.name == answer.scene), self.world)

    @property
    def undistortion(self) -> Undistortion:
        """How the training images were made of what their camera stored: as the network has it, or else the map."""
        undistortions = [each.undistortion for each in (self.contract, self.sparse_map) if each is not None]
        return next((each for each in undistortions if each.lens is not None), undistortions[0])

    @property
    def _place(self) -> Contract | SparseMap:
        if self._network is not None:
            return self._network.contract
        assert self._map is not None  # one of the two is there
        return self._map.map

    def intrinsics_of(self, size: tuple[int, int]) -> NDArray[np.float64] | None:
        """The training camera's pinhole matrix (3, 3) in pixels of its images of a size.

        Args:
            size: (width, height).

        Returns:
            None where neither a map with images of that shape nor the network says it.
        """
        if self._map is not None:
            width, height = self._map.map.size
            if abs(size[0] * height - size[1] * width) <= max(width, height):
                return rescaled_intrinsics(self._map.map.intrinsics, (width, height), size)
        if self.contract is None or self.contract.intrinsics is None:
            return None
        crop_from_image = self.contract.preprocessing.crop_from_image((size[1], size[0]))
        return np.asarray(np.linalg.solve(crop_from_image, self.contract.intrinsics), np.float64)

    def localize(
        self, image: str | Path | Image, intrinsics: ArrayLike | None = None, is_distorted: bool = False
    ) -> Localization:
        """Localize one image, in the world of the data that the scene was made of.

        Args:
            image: a file; or RGB (H, W, 3), or grey (H, W), ``uint8``, of any size, without distortion.
            intrinsics: (3, 3) pinhole matrix in its pixels, for the map, and for a network that takes intrinsics.
                Unless given, the training camera's: the map's own, where the image has its shape, and the network's.
            is_distorted: the image is as the training camera stores it, whole or resized, and is undistorted by its
                lens, which says the intrinsics.

        Raises:
            InputError: for a file that is missing, truncated or not an image, or an array of another kind; for an image
                smaller than the network's crop, unless the network is given its intrinsics; for intrinsics that cannot
                be the image's, where the network takes them or there is a map alone; in a map alone, for an image of
                another shape without intrinsics; for a distorted image with intrinsics, without a known lens, or of
                another shape than the lens's.
        """
        return next(self.localize_batch([image], [intrinsics], is_distorted))

    def localize_batch(
        self,
        images: Sequence[str | Path | Image],
        intrinsics: Sequence[ArrayLike | None] | None = None,
        is_distorted: bool = False,
    ) -> Iterator[Localization]:
        """Localize images that came together: a network that takes no raw input runs once for all of them.

        Args:
            images: N images, each as :meth:`localize` takes it.
            intrinsics: of each, or None.
            is_distorted: of all.

        Yields:
            The pose of each, in their order. The latency is an equal share of the network's and its own in the map.

        Raises:
            InputError: as :meth:`localize`, if any image cannot be localized: none is, then.
        """
        matrices: list[ArrayLike | None] = [None] * len(images) if intrinsics is None else list(intrinsics)
        rgb = [read_image(each) if isinstance(each, str | Path) else as_rgb(each) for each in images]
        start = time.perf_counter()
        if is_distorted:
            if any(matrix is not None for matrix in matrices):
                raise InputError("intrinsics: distorted images have those of their lens. Leave out one.")
            pinholes = [self.undistortion.apply(each, str(self._path)) for each in rgb]
            rgb, matrices = [image for image, _ in pinholes], [matrix for _, matrix in pinholes]
        network = [None] * len(rgb) if self._network is None else self._network.localize(rgb, matrices)
        shared_s = (time.perf_counter() - start) / len(rgb)
        for image, matrix, pose in zip(rgb, matrices, network, strict=True):
            start = time.perf_counter()
            answer = self._with_map(image, matrix, pose)
            yield replace(answer, latency_s=shared_s + time.perf_counter() - start)

    def localize_each(
        self,
        source: str | Path | Iterable[SourceFrame],
        intrinsics: ArrayLike | None = None,
        is_distorted: bool = False,
    ) -> Iterator[tuple[float, Localization]]:
        """Localize a source's frames one after another, each with its time in seconds since the first.

        Args:
            source: as :func:`~mambaloc.runtime.sources.frames_of` takes it, or the frames that it gives.
            intrinsics: of every frame, as :meth:`localize` takes them.
            is_distorted: the frames are as the training camera stores them.

        Raises:
            InputError: where there is no such source, or as :meth:`localize`.
        """
        for frame in frames_of(source)[0] if isinstance(source, str | Path) else source:
            yield frame.time_s, self.localize(frame.image, intrinsics, is_distorted)

    @deprecated("Localizer.localise is now localize. The old name is removed in the next release.")
    def localise(
        self, image: str | Path | Image, intrinsics: ArrayLike | None = None, is_distorted: bool = False
    ) -> Localization:
        """Localize one image. Deprecated: removed in the next release."""
        return self.localize(image, intrinsics, is_distorted)

    @deprecated("Localizer.localise_each is now localize_each. The old name is removed in the next release.")
    def localise_each(
        self,
        source: str | Path | Iterable[SourceFrame],
        intrinsics: ArrayLike | None = None,
        is_distorted: bool = False,
    ) -> Iterator[tuple[float, Localization]]:
        """Localize a source's frames. Deprecated: removed in the next release."""
        return self.localize_each(source, intrinsics, is_distorted)

    def _with_map(self, rgb: Image, intrinsics: ArrayLike | None, network: Localization | None) -> Localization:
        """The network's answer or the map's, in the world of the data that the scene was made of."""
        in_map = self._localize_in_map(rgb, intrinsics, network)
        if in_map is not None:
            _warn_of_focal_length(in_map)
        answer = network if in_map is None else combined(network, in_map)
        assert answer is not None  # one of the two is there
        return replace(answer, position_m=self.world_of(answer).position_m(answer.position_m))

    def _localize_in_map(
        self, rgb: Image, intrinsics: ArrayLike | None, network: Localization | None
    ) -> MapLocalization | None:
        if self._map is None:
            return None
        if network is None:
            return self._map.localize(rgb, intrinsics)
        prior = CameraPose.from_quaternion(network.quaternion, network.position_m)
        try:
            return self._map.localize(rgb, intrinsics, prior)
        except InputError as error:
            warnings.warn(f"{error} The network answers without the map.", InputWarning, stacklevel=5)
            return None


def _warn_of_focal_length(found: MapLocalization) -> None:
    """Where a pose would be accepted but for that; in steps of 5 %, so that a video's frames say it once."""
    scale = found.focal_scale
    if scale is None or found.evidence is None or not found.evidence.is_enough:
        return
    off = f"about {5 * max(1, round(20 * abs(scale - 1)))} % too {'short' if scale > 1 else 'long'}"
    warnings.warn(
        f"intrinsics: the map's matches show that the focal length is {off}, so its poses are not accepted. "
        "Give the intrinsics of these images.",
        InputWarning,
        stacklevel=5,  # what called Localizer.localize
    )


def _model_file(path: Path) -> Path:
    if not path.is_dir():
        return path
    found = [path / name for name in (*MODEL_FILES.values(), MAP_FILE) if (path / name).is_file()]
    if not found:
        raise InputError(f"{path}: contains no {' or '.join(MODEL_FILES.values())}; give a bundle of mambaloc export")
    return found[0]


def _map_beside(model: Path, given: SparseMap | str | Path | bool) -> SparseMap | None:
    if isinstance(given, SparseMap):
        return given
    if not isinstance(given, bool):
        return SparseMap.load(Path(given))
    path = model / MAP_FILE
    if not given or not path.is_file():
        return None
    try:
        return SparseMap.load(path)
    except InputError as error:
        warnings.warn(f"{error} The network answers without the map.", InputWarning, stacklevel=3)
        return None
