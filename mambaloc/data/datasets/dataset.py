"""What a dataset is: how a split of its scenes is read, where they come from, and on which terms."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from mambaloc.data.frames import BadFrames, Frames, Split
from mambaloc.errors import InputError, suggestion


@dataclass(frozen=True)
class Archive:
    """One scene's zip: its addresses in order of preference, and what is known of the file beforehand."""

    urls: tuple[str, ...]
    size_bytes: int | None = None
    sha256: str | None = None


@dataclass(frozen=True)
class Source:
    """Where a public dataset comes from: its terms, its archives, and the split files that a whole scene holds.

    Args:
        splits: names of the files that list the scene's sequences or frames.
        sequences: reads the names of the folders that one split file lists.
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

    def missing(self, folder: Path) -> str | None:
        """The first split file or sequence that ``folder`` needs to be a whole scene and does not have.

        Raises:
            InputError: for a malformed split file.
        """
        for split in self.splits:
            if not (folder / split).is_file():
                return split
        needed = [sequence for split in self.splits for sequence in self.sequences(folder / split)]
        return next((sequence for sequence in needed if not (folder / sequence).is_dir()), None)

    def find_scene(self, scene: str) -> Archive:
        """The archive of ``scene``.

        Raises:
            InputError: for an unknown scene, with the nearest name.
        """
        if scene not in self.archives:
            raise InputError(f"{scene!r} is not a scene of {self.title}. {suggestion(scene, [*self.archives, 'all'])}")
        return self.archives[scene]

    def how_to_get(self, scene: str, root: Path) -> str:
        """One line on how to get a scene that is not in ``root``."""
        if scene not in self.archives:
            return f"{scene} is not in {root}, nor a scene of {self.title}. {suggestion(scene, self.archives)}"
        elsewhere = "" if root == self.default_root else f" --root {root}"
        return (
            f"{scene} is not in {root}; {self.title} is at {self.page} ({self.terms}); "
            f"get it with: mambaloc download {self.name} {scene}{elsewhere}"
        )


@dataclass(frozen=True)
class Dataset:
    """A kind of dataset: how a split of one of its scenes is read.

    Args:
        name: what recipes call it.
        read_split: reads a scene's folder.
        official_counts: train and test frames of each official scene; a scene of other counts is not the benchmark's.
        default_root: where its scenes lie unless a recipe says otherwise.
        marks_validation: whether its scenes may have a split ``val``, too.
        source: where it can be downloaded, if it can.
    """

    name: str
    read_split: Callable[[Path, Split, BadFrames], Frames]
    official_counts: dict[str, tuple[int, int]]
    default_root: Path
    marks_validation: bool = False
    source: Source | None = None
