import math
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.distributed as dist
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from mambaloc.metrics import RECALL_THRESHOLDS, PoseErrors
from mambaloc.types import PoseBatch, PosePrediction


def frames(count: int, seed: int = 0) -> tuple[PosePrediction, PoseBatch]:
    """True poses, and predictions some way off; quaternions of any length and sign."""
    generator = torch.Generator().manual_seed(seed)
    true_q = torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=-1)
    true_m = torch.randn(count, 3, generator=generator)
    predicted_q = (true_q + 0.1 * torch.randn(count, 4, generator=generator)) * torch.linspace(-2, 3, count)[:, None]
    predicted_m = true_m + 0.3 * torch.randn(count, 3, generator=generator)
    target = PoseBatch(torch.zeros(count, 3, 1, 1), true_m, true_q, torch.arange(count))
    return PosePrediction(predicted_m, predicted_q), target


def rows(prediction: PosePrediction, target: PoseBatch, index) -> tuple[PosePrediction, PoseBatch]:
    return (
        PosePrediction(prediction.position_m[index], prediction.quaternion[index]),
        PoseBatch(target.image[index], target.position_m[index], target.quaternion[index], target.index[index]),
    )


def oracle(prediction: PosePrediction, target: PoseBatch) -> tuple[np.ndarray, np.ndarray]:
    """Per-frame errors out of NumPy and SciPy."""
    position_m = np.linalg.norm(prediction.position_m.double() - target.position_m.double(), axis=-1)
    predicted, true = (
        Rotation.from_quat(p.quaternion.double().numpy(), scalar_first=True) for p in (prediction, target)
    )
    return position_m, np.degrees((predicted.inv() * true).magnitude())


def controlled(position_error_m: list[float], rotation_error_deg: list[float]) -> tuple[PosePrediction, PoseBatch]:
    """Frames with the given errors: an offset along y, a turn about z."""
    count, half = len(position_error_m), torch.tensor(rotation_error_deg).deg2rad() / 2
    offset_m = torch.zeros(count, 3)
    offset_m[:, 1] = torch.tensor(position_error_m)
    turned = torch.stack([half.cos(), torch.zeros(count), torch.zeros(count), half.sin()], dim=-1)
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4)
    target = PoseBatch(torch.zeros(count, 3, 1, 1), torch.zeros(count, 3), identity, torch.arange(count))
    return PosePrediction(offset_m, turned), target


@pytest.mark.parametrize("count", [1, 2, 17, 24])
@pytest.mark.parametrize("batch", [5, 100])
def test_medians_and_means_are_those_of_the_whole_split(count, batch):
    prediction, target = frames(count)
    metric = PoseErrors()
    for start in range(0, count, batch):
        metric.update(*rows(prediction, target, slice(start, start + batch)))
    position_m, rotation_deg = oracle(prediction, target)
    result = metric.compute()
    assert result["position_error_m"] == pytest.approx(np.median(position_m), rel=1e-5)
    assert result["rotation_error_deg"] == pytest.approx(np.median(rotation_deg), rel=1e-4)
    assert result["position_error_mean_m"] == pytest.approx(position_m.mean(), rel=1e-5)
    assert result["rotation_error_mean_deg"] == pytest.approx(rotation_deg.mean(), rel=1e-4)
    assert all(type(value) is float for value in result.values())


def test_a_median_of_medians_would_be_something_else():
    prediction, target = controlled([0.0, 0.0, 1.0, 1.0, 1.0, 9.0], [0.0] * 6)
    metric = PoseErrors()
    for part in (slice(0, 2), slice(2, 5), slice(5, 6)):  # medians 0, 1, 9
        metric.update(*rows(prediction, target, part))
    assert metric.compute()["position_error_m"] == 1.0
    metric.reset()
    for part in (slice(0, 3), slice(3, 5), slice(5, 6)):  # medians 0, 1, 9 again
        metric.update(*rows(*controlled([0.0, 0.0, 0.0, 1.0, 1.0, 9.0], [0.0] * 6), part))
    assert metric.compute()["position_error_m"] == 0.5


def test_a_single_frame_is_its_own_median():
    metric = PoseErrors()
    metric.update(*controlled([0.125], [30.0]))
    result = metric.compute()
    assert result["position_error_m"] == result["position_error_mean_m"] == 0.125
    assert result["rotation_error_deg"] == result["rotation_error_mean_deg"] == pytest.approx(30.0, rel=1e-6)


def test_recalls_by_hand():
    # m, deg:       both tight; rotation off; middle band; position off; 50 cm band; far; each bound is inclusive
    metric = PoseErrors()
    metric.update(*controlled([0.01, 0.01, 0.125, 1.0, 0.375, 9.0, 0.25, 0.5], [1.0, 90.0, 1.0, 1.0, 4.0, 90.0, 0, 0]))
    result = metric.compute()
    assert result["recall_5cm_5deg"] == 1 / 8
    assert result["recall_25cm_2deg"] == 3 / 8
    assert result["recall_50cm_5deg"] == 5 / 8
    assert set(RECALL_THRESHOLDS) <= set(result)


def test_repeated_frames_count_once_and_rows_follow_the_split():
    prediction, target = frames(7)
    once, repeated = PoseErrors(), PoseErrors()
    once.update(prediction, target)
    repeated.update(*rows(prediction, target, [5, 3, 6, 3]))
    repeated.update(*rows(prediction, target, [0, 1, 2, 4, 0, 5]))
    assert repeated.compute() == once.compute()
    table = repeated.table()
    assert table.index.tolist() == list(range(7))
    assert_close(table.predicted_position_m, prediction.position_m, rtol=0, atol=0)
    assert_close(table.true_position_m, target.position_m, rtol=0, atol=0)


def test_frames_may_have_any_numbers():
    prediction, target = frames(4)
    target.index = torch.tensor([900, 5, 77, 6])
    metric = PoseErrors()
    metric.update(prediction, target)
    table = metric.table()
    assert table.index.tolist() == [5, 6, 77, 900]
    assert torch.equal(table.true_position_m, target.position_m[[1, 3, 2, 0]])


def test_table_holds_each_frames_errors_and_canonical_rotations():
    prediction, target = frames(9)
    metric = PoseErrors()
    metric.update(prediction, target)
    table, (position_m, rotation_deg) = metric.table(), oracle(prediction, target)
    np.testing.assert_allclose(table.position_error_m, position_m, rtol=1e-5)
    np.testing.assert_allclose(table.rotation_error_deg, rotation_deg, rtol=1e-4)
    for quaternion, given in ((table.predicted_quaternion, prediction), (table.true_quaternion, target)):
        assert (quaternion[:, 0] >= 0).all()
        assert_close(quaternion.norm(dim=-1), torch.ones(9))
        cosine = (quaternion * torch.nn.functional.normalize(given.quaternion, dim=-1)).sum(-1)
        assert_close(cosine.abs(), torch.ones(9))


def test_reset_forgets_and_updates_after_compute_count():
    metric = PoseErrors()
    metric.update(*controlled([5.0], [0.0]))
    assert metric.compute()["position_error_m"] == 5.0
    first, second = rows(*controlled([0.0, 7.0], [0.0] * 2), [1])
    metric.update(first, second)
    assert metric.compute()["position_error_m"] == 6.0
    metric.reset()
    metric.update(*controlled([1.0], [0.0]))
    assert metric.compute()["position_error_m"] == 1.0


def test_predictions_are_kept_without_their_graph_in_single_precision():
    prediction, target = frames(3)
    metric = PoseErrors()
    metric.update(
        PosePrediction(prediction.position_m.bfloat16().requires_grad_(), prediction.quaternion.bfloat16()), target
    )
    (kept,) = metric.predicted_position_m
    assert (kept.dtype, kept.requires_grad) == (torch.float32, False)


def test_a_diverged_prediction_is_not_hidden():
    prediction, target = frames(5)
    prediction.quaternion[2] = math.nan
    metric = PoseErrors()
    metric.update(prediction, target)
    assert math.isnan(metric.compute()["rotation_error_deg"])


# --- distributed -----------------------------------------------------------------------------------------------------

# What a distributed sampler deals out: 7 and 4 frames in batches of 3, the last of them twice.
SHARDS = ([[0, 2, 4], [6, 8, 9], [1]], [[3, 5, 7], [1]])


def in_one_process(rank: int, folder: Path) -> None:
    torch.set_num_threads(1)
    dist.init_process_group(
        "gloo",
        init_method=f"file://{folder}/rendezvous",
        rank=rank,
        world_size=len(SHARDS),
        timeout=timedelta(minutes=5),  # processes that gather different things wait for one another
    )
    metric, (prediction, target) = PoseErrors(), frames(10)
    for index in SHARDS[rank]:
        metric.update(*rows(prediction, target, index))
    torch.save((metric.compute(), vars(metric.table()), len(metric.index)), folder / f"rank{rank}.pt")
    dist.destroy_process_group()


@pytest.mark.slow
def test_uneven_processes_agree_with_a_single_one(tmp_path):
    # Forked, as a DataLoader's workers are: they need not import torch again.
    torch.multiprocessing.start_processes(in_one_process, (tmp_path,), nprocs=len(SHARDS), start_method="fork")
    single = PoseErrors()
    single.update(*frames(10))
    for rank, batches in enumerate(SHARDS):
        result, table, kept = torch.load(tmp_path / f"rank{rank}.pt", weights_only=True)
        assert result == single.compute()
        for name, value in vars(single.table()).items():
            assert torch.equal(table[name], value), name
        assert kept == len(batches)  # the process has its own frames again
