"""The datasets by name: how each is read, and where it comes from."""

from __future__ import annotations

from pathlib import Path

from mambaloc import plugins
from mambaloc.data.datasets import cambridge, capture, seven_scenes
from mambaloc.data.datasets.capture import CAPTURE
from mambaloc.data.datasets.dataset import Dataset, Source
from mambaloc.errors import InputError, suggestion
from mambaloc.plugins import load_plugin, plugin_names
from mambaloc.user_cache import default_cache_dir

EMBEDDED = "embedded"
"""Name of the generated room, which is laid out as 7-Scenes."""

DATASETS = {
    dataset.name: dataset
    for dataset in (
        seven_scenes.DATASET,
        cambridge.DATASET,
        Dataset(EMBEDDED, seven_scenes.read_split, {}, default_cache_dir() / "scenes"),
        capture.DATASET,
    )
}

SOURCES = {name: dataset.source for name, dataset in DATASETS.items() if dataset.source}
"""Where those come from that can be downloaded."""


def locate(dataset: str, root: str | None, scene: str) -> tuple[str, str | None, str]:
    """Say what a recipe's ``dataset``, ``root`` and ``scene`` mean, where the scene may be an imported one's path.

    A folder of that name in the root comes first; then, if the name is a path and not a plain name, the folder there.

    Returns:
        The three, changed where the scene is an imported one, or the embedded one, which has one name.
    """
    for folder in (Path(root, scene) if root else None, Path(scene) if Path(scene).name != scene else None):
        if folder is not None and folder.is_dir():
            if not capture.is_captured(folder):
                break
            folder = folder if folder.name not in ("", "..") else folder.resolve()
            return CAPTURE, str(folder.parent), folder.name
    if dataset == EMBEDDED:  # it has one scene, whatever the default of other datasets
        from mambaloc.rendering.scenes.embedded import EMBEDDED_SCENE

        return dataset, root, EMBEDDED_SCENE
    return dataset, root, scene


def scene_folder(dataset: str, root: Path | None, scene: str) -> Path:
    """Find a scene's folder; the embedded scene is rendered there on first use.

    Raises:
        InputError: for an unknown dataset or a scene that is not there, with how to get it.
    """
    if dataset not in DATASETS:
        _add_from_packages(dataset)
    root = root or DATASETS[dataset].default_root
    if dataset == EMBEDDED:
        from mambaloc.rendering.scenes.embedded import ensure_embedded_scene

        return ensure_embedded_scene(root)
    if not (root / scene).is_dir():
        raise InputError(how_to_get(dataset, scene, root))
    return root / scene


def how_to_get(dataset: str, scene: str, root: Path) -> str:
    """One line on how to get a scene that is not in ``root``.

    Raises:
        InputError: for a dataset that can be neither imported nor downloaded.
    """
    path = Path(scene) if Path(scene).name != scene else root / scene if dataset == CAPTURE else None
    if path is None and capture.is_captured(Path(scene)):
        return f"{scene} is not in {root}. If you mean the imported scene here, name its path, ./{scene}."
    if path is None:
        return find_source(dataset).how_to_get(scene, root)
    source, out = (path, Path("scenes", path.name)) if path.is_dir() else ("CAPTURE", path)
    return f"{path}: is not an imported scene; make one with: mambaloc import {source} --out {out}"


def is_rendered(folder: Path) -> bool:
    """Whether a scene's ``scene.json`` says that it was rendered: no benchmark's images, whatever its poses."""
    return "rendered_by" in capture.scene_note(folder)


def is_official(dataset: str, scene: str, listed: dict[str, int]) -> bool:
    """Whether the splits read so far (``train``, ``test``) have the frame counts of the official benchmark."""
    official = DATASETS[dataset].official_counts.get(scene)
    if official is None or not listed:
        return False
    return all(official[split == "test"] == count for split, count in listed.items())


def find_source(dataset: str) -> Source:
    """Where a dataset comes from.

    Raises:
        InputError: for one without a known address, with the nearest name.
    """
    if dataset not in SOURCES:
        raise InputError(f"{dataset!r} is not a dataset with a known address. {suggestion(dataset, SOURCES)}")
    return SOURCES[dataset]


def licence_of_weights(dataset: str) -> str:
    """Terms of weights that were trained on a dataset: its own; the project's, for scenes that it renders itself."""
    if dataset == CAPTURE:
        return "that of the capture's images, which only who took them can give"
    source = SOURCES.get(dataset)
    return f"{source.title}'s: {source.licence}; {source.terms}" if source else "Apache-2.0"


def describe_sources() -> str:
    """Datasets, licences, scenes and download sizes as text for the terminal."""
    lines = []
    for source in SOURCES.values():
        lines += [f"{source.name}: {source.title}, {source.licence} ({source.terms})", f"  {source.page}"]
        for scene, archive in source.archives.items():
            size = f"{archive.size_bytes / 1e9:.1f} GB" if archive.size_bytes else "size known to the server"
            lines.append(f"  {scene:<14} {size}")
    return "\n".join(lines)


def _add_from_packages(name: str) -> None:
    found = load_plugin(plugins.DATASETS, name)
    if found is None:
        known = {*DATASETS, *plugin_names(plugins.DATASETS)}
        raise InputError(f"data.dataset {name!r}: no such dataset. {suggestion(name, sorted(known))}")
    if not isinstance(found, Dataset) or found.name != name:
        raise InputError(f"data.dataset {name!r}: its package gives no Dataset of that name. Correct its entry point.")
    DATASETS[name] = found
