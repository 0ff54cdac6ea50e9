"""Per-frame predictions as a CSV file."""

from __future__ import annotations

import csv
from pathlib import Path

from mambaloc.data import Frames
from mambaloc.files import whole_file
from mambaloc.metrics import PoseErrorTable


def write_csv(path: Path, table: PoseErrorTable, frames: Frames) -> None:
    """Write a row a frame: image, both poses as ``world_from_cam`` wxyz in metres, and the errors."""
    pose = ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
    header = ["index", "image", *(f"predicted_{c}" for c in pose), *(f"true_{c}" for c in pose)]
    with whole_file(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([*header, "position_error_m", "rotation_error_deg"])
        for row, index in enumerate(table.index.tolist()):
            numbers = (
                *table.predicted_position_m[row].tolist(),
                *table.predicted_quaternion[row].tolist(),
                *table.true_position_m[row].tolist(),
                *table.true_quaternion[row].tolist(),
                table.position_error_m[row].item(),
                table.rotation_error_deg[row].item(),
            )
            image = frames.image_paths[index]
            writer.writerow([index, f"{image.parent.name}/{image.name}", *(f"{n:.9g}" for n in numbers)])
