"""Scenes on disk to batches of posed images."""

from typing import TYPE_CHECKING

from mambaloc.lazy import lazy

if TYPE_CHECKING:
    from mambaloc.data.datamodule import PoseDataModule
    from mambaloc.data.datasets.registry import DATASETS
    from mambaloc.data.frames import BadFrames, Frames
    from mambaloc.data.multi_scene import MultiSceneDataModule, build_data

# Imported on first use: downloading or rendering a scene needs no torch.
_EXPORTS = {
    "BadFrames": "mambaloc.data.frames",
    "DATASETS": "mambaloc.data.datasets.registry",
    "Frames": "mambaloc.data.frames",
    "MultiSceneDataModule": "mambaloc.data.multi_scene",
    "PoseDataModule": "mambaloc.data.datamodule",
    "build_data": "mambaloc.data.multi_scene",
}

__all__ = ["DATASETS", "BadFrames", "Frames", "MultiSceneDataModule", "PoseDataModule", "build_data"]


def __dir__() -> list[str]:
    return __all__


__getattr__ = lazy(__name__, _EXPORTS)
