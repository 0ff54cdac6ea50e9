"""Where the public datasets come from, on which terms, and what a whole scene looks like on disk."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path, PurePosixPath

from mambaloc.errors import InputError


@dataclass(frozen=True)
class Archive:
    """One scene's zip: its addresses in order of preference, and what is known of the file beforehand."""

    urls: tuple[str, ...]
    size_bytes: int | None = None
    sha256: str | None = None


@dataclass(frozen=True)
class Source:
    """A dataset: its terms, its archives, and the split files that a whole scene holds.

    Args:
        splits: names of the files that list the scene's sequences or frames.
        sequences: reads the folders that one split file speaks of.
        archives: scene name to archive.
    """

    name: str
    title: str
    page: str
    licence: str
    terms: str
    splits: tuple[str, ...]
    sequences: Callable[[Path], list[str]]
    archives: Mapping[str, Archive]

    @property
    def default_root(self) -> Path:
        """The folder that holds the scenes unless the user names another."""
        return Path("data") / self.name

    def lacks(self, folder: Path) -> str | None:
        """The first split file or sequence that ``folder`` needs to be a whole scene and does not have."""
        for split in self.splits:
            if not (folder / split).is_file():
                return split
        needed = [sequence for split in self.splits for sequence in self.sequences(folder / split)]
        return next((sequence for sequence in needed if not (folder / sequence).is_dir()), None)


def _text(split: Path) -> str:
    return split.read_text(encoding="utf-8", errors="replace")


def _sevenscenes_sequences(split: Path) -> list[str]:
    return [f"seq-{int(number):02d}" for number in re.findall(r"\d+", _text(split))]


def _cambridge_sequences(split: Path) -> list[str]:
    frames = [line.split()[0] for line in _text(split).splitlines()[3:] if line.strip()]
    return sorted({str(PurePosixPath(frame).parent) for frame in frames})


def _sevenscenes(scene: str, size_bytes: int, sha256: str) -> Archive:
    folder = "download.microsoft.com/download/2/8/5/28564B23-0828-408F-8631-23B1EFF1DAC8"
    return Archive((f"https://{folder}/{scene}.zip", f"http://{folder}/{scene}.zip"), size_bytes, sha256)


def _cambridge(scene: str, handle: int, bitstream: str) -> Archive:
    # The repository's REST address comes first: the older handle address redirects to it.
    return Archive(
        (
            f"https://api.repository.cam.ac.uk/server/api/core/bitstreams/{bitstream}/content",
            f"https://www.repository.cam.ac.uk/bitstream/handle/1810/{handle}/{scene}.zip",
        )
    )


# The addresses are those that public localisation code downloads from; they were not tried from here.
# Sizes and checksums of 7-Scenes are one public project's pins of the files it downloaded, not Microsoft's own figures;
# hence `accept_changed`. Its exact licence text is on the project page only. Cambridge publishes neither size nor
# checksum that we know of; its licence is quoted from the record of King's College, and GreatCourt's and Street's REST
# addresses rest on a single public script.
SEVENSCENES = Source(
    name="7scenes",
    title="7-Scenes",
    page="https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/",
    licence="Microsoft 7-Scenes licence",
    terms="non-commercial research",
    splits=("TrainSplit.txt", "TestSplit.txt"),
    sequences=_sevenscenes_sequences,
    archives={
        scene: _sevenscenes(scene, size_bytes, sha256)
        for scene, size_bytes, sha256 in (
            ("chess", 3079608937, "d00b5b8f904123ec136768ee0ebd8f72aebb5473630fb5d8ec352e70ae4859d0"),
            ("fire", 2301204154, "735d577f471a116b3f190f9bd79026b7fccfc6dee220473499bdb2b93efd1955"),
            ("heads", 956332240, "402f8760ba150100bda5360241b605383dc5f949c055863301bde1b45f6a7a5d"),
            ("office", 4707873861, "c2bd101aae86c926d43ed92e080140b2e32d54ce14a5ce289b9aeca3472e7744"),
            ("pumpkin", 2890874911, "53fd1cb4c2f50378abc112f48e8897138e2135f2848c8c2e094e8028af07a65f"),
            ("redkitchen", 6141181406, "55f6aeabfd8308fbe02a6f37d1dbdbc4c087c3c6c84cb5fae062a90c43ffcba6"),
            ("stairs", 1496412431, "3521a1a26acb98321918ec352f8b189d301c2e3cce2de1bf2eac424d003b3929"),
        )
    },
)

CAMBRIDGE = Source(
    name="cambridge",
    title="Cambridge Landmarks",
    page="http://mi.eng.cam.ac.uk/projects/relocalisation/",
    licence="CC BY-NC-SA 2.0 UK",
    terms="non-commercial, credit the authors, share alike",
    splits=("dataset_train.txt", "dataset_test.txt"),
    sequences=_cambridge_sequences,
    archives={
        scene: _cambridge(scene, handle, bitstream)
        for scene, handle, bitstream in (
            ("KingsCollege", 251342, "1cd2b04b-ada9-4841-8023-8207f1f3519b"),
            ("OldHospital", 251340, "ae577bfb-bdce-488c-8ce6-3765eabe420e"),
            ("ShopFacade", 251336, "4e5c67dd-9497-4a1d-add4-fd0e00bcb8cb"),
            ("StMarysChurch", 251294, "2559ba20-c4d1-4295-b77f-183f580dbc56"),
            ("GreatCourt", 251291, "bceda7ac-e51c-40ca-b9d7-d758d40cdcf4"),
            ("Street", 251292, "d39a7732-591f-470a-9f5e-2a9892118abd"),
        )
    },
)

SOURCES = {source.name: source for source in (SEVENSCENES, CAMBRIDGE)}


def licence_of_weights(dataset: str) -> str:
    """Terms of weights that were trained on a dataset: its own; the project's, for scenes that it renders itself."""
    if dataset == "capture":
        return "that of the capture's images, which only who took them can give"
    source = SOURCES.get(dataset)
    return f"{source.title}'s: {source.licence}; {source.terms}" if source else "Apache-2.0"


def find_source(dataset: str) -> Source:
    """The source called ``dataset``; InputError with the nearest name where there is none."""
    if dataset not in SOURCES:
        raise InputError(f"{dataset!r} is no dataset with a known address: {_nearest(dataset, list(SOURCES))}")
    return SOURCES[dataset]


def find_scene(source: Source, scene: str) -> Archive:
    """The archive of ``scene``; InputError with the nearest name where there is none."""
    if scene not in source.archives:
        raise InputError(f"{scene!r} is no scene of {source.title}: {_nearest(scene, [*source.archives, 'all'])}")
    return source.archives[scene]


def _nearest(name: str, names: list[str]) -> str:
    by_lower = {known.lower(): known for known in names}
    close = get_close_matches(name.lower(), by_lower, n=1)
    return f"did you mean {by_lower[close[0]]}?" if close else f"give one of {', '.join(names)}"


def how_to_get(dataset: str, scene: str, root: Path) -> str:
    """One line on how to get a scene that is not in ``root``, for the error message of a dataset reader."""
    source = find_source(dataset)
    if scene not in source.archives:
        return f"{scene} is not in {root}, nor a scene of {source.title}: {_nearest(scene, list(source.archives))}"
    elsewhere = "" if root == source.default_root else f" --root {root}"
    return (
        f"{scene} is not in {root}; {source.title} is at {source.page} ({source.terms}); "
        f"get it with: python tools/download.py {dataset} {scene}{elsewhere}"
    )


def describe_sources() -> str:
    """Datasets, licences, scenes and download sizes as text for the terminal."""
    lines = []
    for source in SOURCES.values():
        lines += [f"{source.name}: {source.title}, {source.licence} ({source.terms})", f"  {source.page}"]
        for scene, archive in source.archives.items():
            size = f"{archive.size_bytes / 1e9:.1f} GB" if archive.size_bytes else "size told by the server"
            lines.append(f"  {scene:<14} {size}")
    return "\n".join(lines)
