"""What evaluate.py --rerun records: the rows of predictions.csv, read back by Rerun's own reader."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mambaloc.errors import InputError
from mambaloc.evaluation import evaluate_checkpoint, measure_map
from mambaloc.models import Checkpoint

pytest.importorskip("rerun", reason="needs the extra rerun")


def recorded(path, entity: str, component: str) -> list:
    """Values in order of the frames."""
    from rerun.chunk import RrdReader

    rows = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path == entity and component in batch.schema.names and "frame" in batch.schema.names:
            rows |= dict(zip(batch.column("frame").to_pylist(), batch.column(component).to_pylist(), strict=True))
    return [rows[row][0] for row in sorted(rows)]


def numbers(path, *names: str) -> np.ndarray:
    with path.open() as file:
        return np.array([[float(row[name]) for name in names] for row in csv.DictReader(file)])


@pytest.mark.parametrize("has_map", [True, False])
def test_a_recording_has_the_rows_of_the_predictions(trained_with_map, tmp_path, has_map):
    """Guess: the truth in every row, and errors as in the file; radii where the model or the map states them."""
    checkpoint = Checkpoint.read(trained_with_map / "checkpoints/last.ckpt")
    beside = measure_map(trained_with_map / "map/map.safetensors", checkpoint.data()) if has_map else None
    path = tmp_path / "test.rrd"
    evaluate_checkpoint(checkpoint, tmp_path, accelerator="cpu", beside=beside, rerun=path)
    table = tmp_path / ("predictions_both.csv" if has_map else "predictions.csv")
    for entity, column in (("/world/camera", "predicted"), ("/world/truth", "true")):
        positions_m = recorded(path, entity, "Transform3D:translation")
        np.testing.assert_allclose(positions_m, numbers(table, *(f"{column}_{axis}_m" for axis in "xyz")), atol=1e-5)
        found = Rotation.from_quat(recorded(path, entity, "Transform3D:quaternion"))
        expected = Rotation.from_quat(numbers(table, *(f"{column}_q{axis}" for axis in "xyzw")))
        assert (found.inv() * expected).magnitude().max() < 1e-5
    for name in ("position_error_m", "rotation_error_deg"):
        values = recorded(path, f"/plots/{name}", "Scalars:scalars")
        np.testing.assert_allclose(values, numbers(table, name)[:, 0], rtol=1e-4, atol=1e-4)
    assert len(recorded(path, "/world/camera/image", "Pinhole:image_from_camera")) == len(positions_m)


def test_a_wrong_name_is_told_before_anything_is_measured(trained_with_map, tmp_path):
    checkpoint = Checkpoint.read(trained_with_map / "checkpoints/last.ckpt")
    with pytest.raises(InputError, match=r"--rerun .*a\.txt: is not the name of a recording"):
        evaluate_checkpoint(checkpoint, tmp_path, accelerator="cpu", rerun=tmp_path / "a.txt")
    assert not list(tmp_path.iterdir())
