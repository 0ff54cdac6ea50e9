"""A contact sheet of the views that a run trains on."""

from __future__ import annotations

import logging
from pathlib import Path

import lightning as L

from mambaloc.viz.views import draw_views

_log = logging.getLogger(__name__)


class ViewSheet(L.Callback):
    """Draw synthetic views beside real frames to ``RUN/views.png``, where there are views.

    Views that were found not worth training on are drawn, too: the sheet shows why. Of several scenes each has a sheet.

    Args:
        enabled: whether to.
    """

    def __init__(self, enabled: bool = True) -> None:
        self.enabled = enabled

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Draw, before the first step."""
        if not self.enabled or trainer.fast_dev_run or not trainer.is_global_zero:  # type: ignore[attr-defined]
            return
        scenes = trainer.datamodule.each_scene()  # type: ignore[attr-defined]
        for made, number in ((each.scene_views, each.scene_index) for each in scenes):
            if made is None:
                continue
            path = Path(trainer.default_root_dir) / ("views.png" if number is None else f"views_{number}.png")
            draw_views(made.source, made.views, made.quality, path, f"{made.kind} depth of {len(made.source)} frames")
            _log.info(f"{path}: {made.summary()}")
