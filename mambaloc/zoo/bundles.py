"""Released models as bundles: exported once, then found again."""

from __future__ import annotations

import hashlib
from importlib.metadata import version
from pathlib import Path

from mambaloc.data import PoseDataModule
from mambaloc.export import write_bundle
from mambaloc.models import Checkpoint, LitPoseRegressor
from mambaloc.runtime import contract
from mambaloc.user_cache import made_once
from mambaloc.zoo.loading import is_checkpoint, load, released_folder
from mambaloc.zoo.manifest import MANIFEST_FILE, Manifest

EMBEDDED = "student.embedded_room"
"""The released model that comes with the package."""


def load_with_data(source: str, root: str | None = None) -> tuple[LitPoseRegressor, PoseDataModule]:
    """Load a trained system, and the scene that it knows.

    A checkpoint tells all about its data; a released model only which scene: its whole training split is then meant.

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


def released_bundle(name: str = EMBEDDED) -> Path:
    """The bundle of a released model, exported into the user's cache on first use (half a minute).

    Raises:
        InputError: where there is no such model, or its scene's frames are not there.
    """
    folder = released_folder(name)
    manifest, content = Manifest.read(folder), (folder / MANIFEST_FILE).read_bytes()
    digest = hashlib.sha256(f"{contract.VERSION}{version('mambaloc')}".encode() + content).hexdigest()[:16]

    def make(partial: Path) -> None:
        write_bundle(*load_with_data(name), partial / "bundle", ("onnx",), target="pc")

    return made_once(f"bundles/{manifest.model}-{digest}", make) / "bundle"
