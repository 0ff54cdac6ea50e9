"""A scene on disk, as a recipe asks for it: located, read, held out, thinned, decoded, with points, and described."""

from __future__ import annotations

import hashlib
import warnings
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from mambaloc import provenance
from mambaloc.data.cameras import known_or_assumed_cameras
from mambaloc.data.datasets.capture import CAPTURE, describe_capture
from mambaloc.data.datasets.registry import DATASETS, is_official, is_rendered, locate, scene_folder
from mambaloc.data.frame_dataset import CachedFrames, LoadedSplit, describe_points, load_split
from mambaloc.data.frames import BadFrames, Frames, OnBadFrame, Split
from mambaloc.data.points import read_points
from mambaloc.data.splits import Validation, clips_of, hold_out, subsample
from mambaloc.data.views import (
    FramesAndViews,
    SceneViews,
    ViewDepth,
    ViewRequest,
    make_scene_views,
    points_of_frames_by_depth,
    points_of_views,
    poses_of,
)
from mambaloc.errors import InputError, InputWarning
from mambaloc.synthesis import Splatter
from mambaloc.types import height_and_width

Read = tuple[Frames, BadFrames]
"""Posed frames, not yet decoded, and the frames left out."""


@dataclass
class Scene:
    """One scene's training, validation and test frames.

    Fields are the arguments of :class:`~mambaloc.data.PoseDataModule` of the same names. ``dataset``, ``root`` and
    ``scene`` are changed to what they mean: see :func:`~mambaloc.data.datasets.registry.locate`.

    Attributes:
        crop: height and width that networks see, in pixels.
        parts: what is loaded so far.
        made_views: of the training frames, once :meth:`add_views` has made them.

    Raises:
        InputError: for a number that is out of range.
    """

    dataset: str
    root: str | None
    scene: str
    image_size: int | tuple[int, int]
    short_side: int
    validation: Validation
    val_fraction: float
    val_gap: int
    val_sequences: list[str] | None
    keep_every: int
    keep_count: int | None
    clip_length: int
    clip_skip: int
    points_per_frame: int
    views: int
    view_depth: ViewDepth
    view_share: float | None
    on_bad_frame: OnBadFrame
    cache_dir: str | None

    def __post_init__(self) -> None:
        self.dataset, self.root, self.scene = locate(self.dataset, self.root, self.scene)
        self.crop = height_and_width(self.image_size)
        self.parts: dict[Split, LoadedSplit] = {}
        self.made_views: SceneViews | None = None
        self._mixed: FramesAndViews | None = None
        self._is_viewed = False
        ViewRequest(self.views, self.view_depth, self.view_share, 0)  # raises what is out of range
        self._listed: dict[str, int] = {}
        if min(self.crop) > self.short_side:
            raise InputError(
                f"data.image_size {self.image_size}: larger than data.short_side {self.short_side}; enlarge that"
            )
        if self.points_per_frame < 0:
            raise InputError(f"data.points_per_frame {self.points_per_frame}: must be 0 or more; 0 reads none")
        if self.views and self.clip_length > 1:
            raise InputError(
                f"data.clip_length {self.clip_length}: clips need sequences, but data.views are single images. "
                "Turn off one of the two."
            )

    @property
    def folder(self) -> Path:
        """The scene's folder.

        Raises:
            InputError: for an unknown dataset, or a scene that is not there, with how to get it.
        """
        return scene_folder(self.dataset, Path(self.root) if self.root else None, self.scene)

    def read(self, split: Split) -> Read:
        """Read the poses of a whole split, without decoding an image.

        Raises:
            InputError: if there is no such scene, or for a bad frame under ``on_bad_frame: error``.
        """
        bad = BadFrames(self.on_bad_frame)
        folder = self.folder  # first of all: raises for an unknown dataset
        frames = DATASETS[self.dataset].read_split(folder, split, bad)
        self._listed[split] = len(frames) + len(bad.rejected)
        return frames, bad

    def choose(self) -> tuple[Read, Read | None, float]:
        """Read the frames to train on and those to validate on, without decoding an image.

        Returns:
            Training frames, neither held out nor thinned away; validation frames, None under ``none`` and
            ``test_set``; and how many training frames each that is kept stands for.

        Raises:
            InputError: as :meth:`read`, and where a part would be empty.
        """
        train, bad = self.read("train")
        val = self._marked() if self.validation in ("auto", "marked") else None
        if val is None and self.validation not in ("none", "test_set"):
            how: Any = self.validation  # not "marked", which has found its frames or raised
            rows = hold_out(train, how, self.val_fraction, self.val_gap, self.val_sequences)
            train, val = train.select(rows[0]), (train.select(rows[1]), BadFrames(bad.policy))
        kept = subsample(train, self.keep_every, self.keep_count)
        return (train.select(kept), bad), val, len(train) / len(kept)

    def load_training(self) -> None:
        """Load the parts ``train`` and ``val``, unless they are; every process may, for one builds the frame cache.

        Raises:
            InputError: as :meth:`choose`, and for images or points that cannot be used.
        """
        if "train" not in self.parts:
            train, val, thinned_by = self.choose()
            if val is not None:
                self.parts["val"] = self._with_points(self._decode(*val))
            self.parts["train"] = self._in_clips(self._with_points(self._decode(*train)), thinned_by)
        if self.validation == "test_set" and "val" not in self.parts:
            self.load_test()
            self.parts["val"] = self._with_points(self.parts["test"])

    def load_test(self) -> None:
        """Load the part ``test``, unless it is.

        Raises:
            InputError: as :meth:`read`, and for images that cannot be used.
        """
        if "test" not in self.parts:
            self.parts["test"] = self._decode(*self.read("test"))

    def add_views(self, device: torch.device) -> None:
        """Make views of the training frames, unless there are; points of frames come from the same depth.

        Where there is no depth to make them from, or they are not worth training on, a line says so.

        Args:
            device: that makes them.

        Raises:
            InputError: where the depth that was asked for cannot be used.
        """
        if self.views == 0 or self._is_viewed:
            return
        self._is_viewed = True
        self.made_views = made = self._made_views(device)
        views = None if made is None else made.views
        splatter = Splatter(made.source, device) if made and views and self.points_per_frame else None
        for part in ("train", "val"):
            if part in self.parts:
                self.parts[part] = self._with_points(self.parts[part], splatter)
        if made and views:
            points = points_of_views(views, self.points_per_frame, provenance.seed()) if splatter else None
            self._mixed = FramesAndViews(self.parts["train"].data, views, made.share, points)

    def items(self, part: Split) -> CachedFrames:
        """What batches of a part are made of: its frames, and views beside those that are trained on."""
        return self._mixed if part == "train" and self._mixed else self.parts[part].data

    def training_key(self) -> str:
        """Name the images that are trained on: frames as they were decoded, and views."""
        key = self.parts["train"].fingerprint
        if self._mixed is None:
            return key
        poses = hashlib.sha256(self._mixed.views.first.world_from_cam.tobytes()).hexdigest()
        return f"{key} {poses} {self._mixed.share}"

    def _made_views(self, device: torch.device) -> SceneViews | None:
        request = ViewRequest(self.views, self.view_depth, self.view_share, provenance.seed())
        try:
            made = make_scene_views(self.folder, self.parts["train"], request, self.cache_dir, device)
        except InputError as error:
            if self.view_depth != "auto":
                raise
            warnings.warn(f"{error} The training goes on without views.", InputWarning, stacklevel=2)
            return None
        if made.share == 0 and self.view_share is None:
            line = f"{self.folder}: {made.quality.describe()}. The training goes on without views."
            warnings.warn(line, InputWarning, stacklevel=2)
        return made

    def describe(self) -> dict[str, Any]:
        """Say which frames a number comes from: scene, counts, selection rule, what was left out and repaired."""
        rendered = is_rendered(self.folder)
        return {
            "dataset": self.dataset,
            "scene": self.folder.name,
            "official_split": not rendered and is_official(self.dataset, self.scene, self._listed),
            "rendered": rendered,
            "listed_frames": dict(self._listed),
            **{f"{part}_frames": len(loaded.data.frames) for part, loaded in self.parts.items()},
            "fingerprints": {part: loaded.fingerprint for part, loaded in self.parts.items()},
            "skipped": {part: loaded.bad.counts() for part, loaded in self.parts.items()},
            "repaired": {part: len(loaded.bad.repaired) for part, loaded in self.parts.items()},
            "validation": self.validation,
            "keep_every": self.keep_every,
            "keep_count": self.keep_count,
            "clip_length": self.clip_length,
            "clip_skip": self.clip_skip,
            "image_size": list(self.crop),
            "short_side": self.short_side,
            "cameras": {part: loaded.data.cameras.describe() for part, loaded in self.parts.items()},
            **describe_points(self.parts),
            **({"views": self._describe_views()} if self._is_viewed else {}),
            **(describe_capture(self.folder) if self.dataset == CAPTURE else {}),
        }

    def _describe_views(self) -> dict[str, Any]:
        described = self.made_views.describe() if self.made_views else {"count": 0}
        replaced = self._mixed.views.replaced if self._mixed else 0
        return {**described, "replaced": replaced} if replaced else described

    def _marked(self) -> Read | None:
        """Frames that the scene marks for validation, and the frames left out."""
        if DATASETS[self.dataset].marks_validation:
            frames, bad = self.read("val")
            if len(frames):
                return frames, bad
        if self.validation == "marked":
            raise InputError(f"data.validation marked: {self.folder} marks no frames as val; use auto, or none")
        return None

    def _decode(self, frames: Frames, bad: BadFrames) -> LoadedSplit:
        cameras_of = partial(known_or_assumed_cameras, self.dataset, self.folder)
        is_mixed = self.dataset == CAPTURE  # whose cameras were fitted to each image
        return load_split(frames, bad, cameras_of, self.short_side, self.crop, self.cache_dir, is_mixed)

    def _with_points(self, loaded: LoadedSplit, splatter: Splatter | None = None) -> LoadedSplit:
        """Add what each frame may see, of the frames that could be decoded; from views' depth where that is given."""
        if self.points_per_frame == 0 or (self.views and not self._is_viewed):  # views say where points are from
            return loaded
        data, count, seed = loaded.data, self.points_per_frame, provenance.seed()
        if splatter:
            points = points_of_frames_by_depth(splatter, data, poses_of(data.frames), count, seed)
        else:
            try:
                points = read_points(self.folder, data.frames, data.cameras, count, seed)
            except InputError as error:
                if self.views == 0:
                    raise
                warnings.warn(f"{error}. The training goes on without points.", InputWarning, stacklevel=2)
                return loaded
        return replace(loaded, data=CachedFrames(data.frames, data.images, data.cameras, points))

    def _in_clips(self, loaded: LoadedSplit, thinned_by: float) -> LoadedSplit:
        """Make an item of each clip; neighbours of a thinned sequence lie farther apart already."""
        if self.clip_length == 1:
            return loaded
        data = loaded.data
        clips = clips_of(data.frames, self.clip_length, max(1, round(self.clip_skip / thinned_by)))
        return replace(loaded, data=CachedFrames(data.frames, data.images, data.cameras, data.points, clips))
