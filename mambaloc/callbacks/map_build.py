"""A sparse map beside the network."""

from __future__ import annotations

import hashlib
import json
import logging
import time
import warnings
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import lightning as L
import torch

from mambaloc.data.datasets.capture import CAPTURE
from mambaloc.errors import InputError, InputWarning
from mambaloc.evaluation.with_map import RUN_MAP
from mambaloc.mapping import MapSettings, build_map
from mambaloc.mapping.building import POINTS, describe_points
from mambaloc.mapping.posed import with_cameras
from mambaloc.mapping.recipe import MINIMUM
from mambaloc.runtime.maps import SparseMap

_log = logging.getLogger(__name__)


class MapBuild(L.Callback):
    """Build a sparse map of the frames that the network trains on, in ``RUN/map/map.safetensors``.

    That is before the first epoch, so that seconds after the start there is something to localize with. Frames that are
    held out for validation are not in it. A resumed run keeps its map, unless frames or settings have changed. Where
    cameras are unknown, or the frames give no map, a line says so and the training goes on.

    Args:
        enabled: whether to; of imported captures alone, unless given.
        settings: of the map: fields of :class:`~mambaloc.mapping.MapSettings`.

    Raises:
        InputError: for a setting out of range.
    """

    def __init__(self, enabled: bool | None = None, **settings: Any) -> None:
        self.enabled = enabled
        self.settings = MapSettings(**settings)
        for name, minimum in MINIMUM.items():
            if (value := getattr(self.settings, name)) < minimum:
                raise InputError(f"map.{name} {value}: is less than {minimum}. Give more.")
        if self.settings.points not in POINTS:
            raise InputError(f"map.points {str(self.settings.points)[:40]}: is unknown. Choose {' or '.join(POINTS)}.")

    def on_fit_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Build, or find it built."""
        data = trainer.datamodule  # type: ignore[attr-defined]
        is_capture = len(data.each_scene()) == 1 and data.hparams["dataset"] == CAPTURE
        is_due = is_capture if self.enabled is None else self.enabled
        if not is_due or trainer.fast_dev_run or not trainer.is_global_zero:  # type: ignore[attr-defined]
            return
        path, frames = Path(trainer.default_root_dir) / RUN_MAP, data.frames("train")
        settings = json.dumps(asdict(self.settings), sort_keys=True)
        digests = {"frames": frames.digest(), "settings": hashlib.sha256(settings.encode()).hexdigest()}
        if _is_made_from(path, digests):
            _log.info(f"{path}: is built from these frames already")
            return
        started = time.perf_counter()
        try:
            posed = with_cameras(data.hparams["dataset"], data.folder, frames)
            sparse_map = build_map(posed, self.settings, data.folder.name, threads=torch.get_num_threads())
        except InputError as error:
            warnings.warn(f"{error} The training goes on without a map.", InputWarning, stacklevel=2)
            path.unlink(missing_ok=True)  # of other frames
            return
        replace(sparse_map, digests={**sparse_map.digests, **digests}).save(path)
        _log.info(
            f"{path}: {describe_points(sparse_map)}, in {len(sparse_map.key_poses)} key frames, "
            f"{path.stat().st_size / 2**20:.2f} MiB, built in {time.perf_counter() - started:.1f} s; "
            "mambaloc localize uses it."
        )


def _is_made_from(path: Path, digests: dict[str, str]) -> bool:
    try:
        return digests.items() <= SparseMap.load(path).digests.items()
    except InputError:  # missing or damaged
        return False
