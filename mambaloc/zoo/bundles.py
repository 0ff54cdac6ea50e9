"""Released models as bundles: exported once, then found again."""

from __future__ import annotations

import hashlib
from importlib.metadata import version
from pathlib import Path

from mambaloc.data import MultiSceneDataModule, PoseDataModule
from mambaloc.errors import InputError
from mambaloc.evaluation.with_map import RUN_MAP
from mambaloc.export import write_bundle
from mambaloc.mapping import MapSettings, build_map
from mambaloc.mapping.posed import read_frames
from mambaloc.mapping.recipe import MapRecipe
from mambaloc.models import Checkpoint, LitPoseRegressor
from mambaloc.runtime import contract
from mambaloc.runtime.maps import MAP_FILE, sparse_map
from mambaloc.user_cache import cached_folder
from mambaloc.zoo.loading import is_checkpoint, load, released_folder, released_map
from mambaloc.zoo.manifest import MANIFEST_FILE, Manifest

EMBEDDED = "denseloc.embedded_room"
"""The released model that answers where none is named."""

_EMBEDDED_SCENE = "embedded/room"
_EMBEDDED_MAP = MapSettings(key_frames=80, width=160)


def load_with_data(
    source: str, root: str | None = None
) -> tuple[LitPoseRegressor, PoseDataModule | MultiSceneDataModule]:
    """Load a trained system, and the scene that it knows.

    A checkpoint has all about its data; a released model only the scene: its whole training split is then meant.

    Args:
        source: as :func:`mambaloc.load` takes it.
        root: folder that holds its scene; as in training, or the dataset's default, unless given.

    Raises:
        InputError: as :func:`mambaloc.load`.
    """
    if is_checkpoint(source):
        checkpoint = Checkpoint.read(source)
        return checkpoint.system(), checkpoint.data(**({} if root is None else {"root": root}))
    system, manifest = load(source), Manifest.read(released_folder(source))
    dataset, _, scene = manifest.scene.partition("/")
    data = PoseDataModule(dataset, root, scene, image_size=system.image_size, short_side=manifest.short_side)
    return system, data


def load_with_scene(source: str) -> tuple[LitPoseRegressor, PoseDataModule]:
    """The same, where only a system of one scene will do.

    Raises:
        InputError: as :func:`load_with_data`; for a network that knows several scenes.
    """
    system, data = load_with_data(source)
    if isinstance(data, MultiSceneDataModule):
        raise InputError(f"{source}: has {system.scene_count} scenes, but one is expected. Give a model of one scene.")
    return system, data


def map_of(source: str) -> Path | None:
    """The sparse map of a trained system: its run's ``map/map.safetensors``, or the one released with it.

    The embedded room's, whose frames are rendered here, is built in the user's cache on first use (seconds).

    Args:
        source: as :func:`mambaloc.load` takes it.

    Returns:
        The file; None without one.

    Raises:
        InputError: where there is no released model of this name, or its map is not the file that was released.
    """
    if is_checkpoint(source):
        beside = Path(source).parent.parent / RUN_MAP
        return beside if beside.is_file() else None
    folder = released_folder(source)
    if (path := released_map(folder)) is not None or Manifest.read(folder).scene != _EMBEDDED_SCENE:
        return path
    return cached_folder(f"maps/embedded_room-{_versions()}", _build_embedded_map) / MAP_FILE


def _build_embedded_map(folder: Path) -> None:
    dataset, scene = _EMBEDDED_SCENE.split("/")
    build_map(read_frames(MapRecipe(scene, dataset), "train"), _EMBEDDED_MAP, scene).save(folder / MAP_FILE)


def released_bundle(name: str = EMBEDDED) -> Path:
    """The bundle of a released model, exported into the user's cache on first use (half a minute).

    Raises:
        InputError: where there is no such model, or its scene's frames are not there.
    """
    folder = released_folder(name)
    manifest, content = Manifest.read(folder), (folder / MANIFEST_FILE).read_bytes()
    digest = hashlib.sha256(_versions().encode() + content).hexdigest()[:16]

    def make(partial: Path) -> None:
        write_bundle(*load_with_data(name), partial / "bundle", ("onnx",), target="pc", sparse_map=map_of(name))

    return cached_folder(f"bundles/{manifest.model}-{digest}", make) / "bundle"


def _versions() -> str:
    return f"{version('mambaloc')}-{contract.VERSION}-{sparse_map.VERSION}"
