"""Per-frame predictions as files: CSV for people, TUM for trajectory tools such as evo."""

from __future__ import annotations

import csv
from pathlib import Path

from torch import Tensor

from mambaloc.data import Frames
from mambaloc.metrics import PoseErrorTable


def write_tum(path: Path, index: Tensor, position_m: Tensor, quaternion: Tensor) -> None:
    """Write lines ``timestamp tx ty tz qx qy qz qw``; the timestamp is the frame's row in its split.

    TUM puts the scalar last, unlike everything else here.
    """
    rows = zip(index.tolist(), position_m.tolist(), quaternion.tolist(), strict=True)
    lines = [" ".join(f"{n:.9g}" for n in (i, *xyz, qx, qy, qz, qw)) for i, xyz, (qw, qx, qy, qz) in rows]
    path.write_text("\n".join(["# timestamp tx ty tz qx qy qz qw", *lines]) + "\n", encoding="utf-8")


def write_csv(path: Path, table: PoseErrorTable, frames: Frames) -> None:
    """Write a row a frame: image, both poses as ``world_from_cam`` wxyz in metres, and the errors."""
    pose = ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
    header = ["index", "image", *(f"predicted_{c}" for c in pose), *(f"true_{c}" for c in pose)]
    with path.open("w", newline="", encoding="utf-8") as file:
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
