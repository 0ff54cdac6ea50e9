"""Per-frame predictions as files."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

from mambaloc.data import Frames
from mambaloc.files import atomic_file
from mambaloc.metrics import PoseErrorTable
from mambaloc.runtime.trajectory import decimal, write_tum
from mambaloc.runtime.world import World


def write_predictions(
    path: Path, table: PoseErrorTable, frames: Frames, world: World, sources: Sequence[str] | None = None
) -> None:
    """Write predictions as CSV and, beside it, as a TUM trajectory.

    A row of the CSV file is a frame: image, both poses as ``world_from_cam`` wxyz in metres, and the errors.
    Positions are in the world of the data that the scene was made of.

    Args:
        path: the CSV file.
        table: the predictions.
        frames: of the split.
        world: of the scene.
        sources: what found each pose, for a last column.
    """
    pose = ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
    predicted_m, true_m = (world.position_m(each.cpu()) for each in (table.predicted_position_m, table.true_position_m))
    header = ["index", "image", *(f"predicted_{c}" for c in pose), *(f"true_{c}" for c in pose)]
    header += ["position_error_m", "rotation_error_deg", *(["source"] if sources else [])]
    with atomic_file(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        for row, index in enumerate(table.index.tolist()):
            numbers = (
                *predicted_m[row].tolist(),
                *table.predicted_quaternion[row].tolist(),
                *true_m[row].tolist(),
                *table.true_quaternion[row].tolist(),
                table.position_error_m[row].item(),
                table.rotation_error_deg[row].item(),
            )
            image, source = frames.image_paths[index], sources[row : row + 1] if sources else []
            writer.writerow([index, f"{image.parent.name}/{image.name}", *map(decimal, numbers), *source])
    write_tum(path.with_suffix(".tum"), table.index.tolist(), predicted_m, table.predicted_quaternion)
