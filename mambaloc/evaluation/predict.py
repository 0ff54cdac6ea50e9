"""Run test frames through a trained system."""

from __future__ import annotations

import lightning as L
import torch

from mambaloc.data import PoseDataModule
from mambaloc.errors import InputError
from mambaloc.metrics import PoseErrorTable, error_table
from mambaloc.models import LitPoseRegressor


@torch.inference_mode()
def localize_test_frames(system: LitPoseRegressor, data: PoseDataModule, accelerator: str = "auto") -> PoseErrorTable:
    """Let a system localize every test frame, once and on one device.

    Args:
        system: trained; it ends in evaluation mode on that device.
        data: the scene.
        accelerator: as Lightning's Trainer takes it.

    Raises:
        InputError: where the frames are missing or bad, or this machine has no such accelerator.
    """
    data.setup("test")
    try:
        fabric = L.Fabric(accelerator=accelerator, devices=1)
    except (ValueError, RuntimeError) as error:  # an unknown name, or a device that this machine lacks
        raise InputError(f"--accelerator {accelerator}: {error} Choose another.") from None
    system.to(fabric.device).eval()
    return error_table(system, (fabric.to_device(batch) for batch in data.batches("test")))
