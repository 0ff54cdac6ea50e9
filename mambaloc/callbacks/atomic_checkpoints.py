"""Atomic checkpoints, and a clear error where they cannot be written."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins import TorchCheckpointIO

from mambaloc.files import atomic_file


class AtomicCheckpointIO(TorchCheckpointIO):
    """Write a checkpoint beside its place, then move it there.

    Lightning writes it to the temporary folder first. That is often on another disk, from where a move is a copy: one
    that ends half-way leaves neither the new checkpoint nor the last. And it says nothing where it may not write.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Write it, or raise :class:`OSError`; the one before is there until then."""
        content = io.BytesIO()  # torch, writing to a file that cannot grow, ends in an error of its own
        torch.save(checkpoint, content)
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(Path(path)) as partial:
            partial.write_bytes(content.getbuffer())
