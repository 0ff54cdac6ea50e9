"""Systems learn eight frames by heart: a network, its loss and its optimiser that work together can."""

import pytest
import torch
from systems import frames, small
from torch import nn

import mambaloc
from mambaloc.models import LitPoseRegressor

# As far apart as systems go: transformer encoders on two feature maps, with quaternions and learned weights; LSTMs on
# a pooled feature, with log quaternions and fixed weights; bottleneck attention on one map, with learned L1 weights.
FAR_APART = ["mambaloc", "lstm_posenet", "transbonet"]


def learned_by_heart(
    name: str, side: int, steps: int, lr: float, start: nn.Module | None = None, **kwargs
) -> LitPoseRegressor:
    """Train on eight frames without dropout at a falling rate: the median errors end under 5 cm and 3 degrees.

    The errors are those of the last step: batch norm's running statistics of so few pixels are others than a batch's.
    """
    system = small(name, "gis", lr=lr, dropout=0.0, weight_decay=0.0, image_size=side, **kwargs)
    batch = frames(8, side=side)
    if start is not None:
        system.network.load_state_dict(start.state_dict())
    optimizer = system.configure_optimizers()["optimizer"]
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, total_iters=steps)
    system.train()
    for _ in range(steps):
        prediction = system(batch.image)
        optimizer.zero_grad()
        system.loss(prediction, batch).backward()
        optimizer.step()
        schedule.step()
    system.val_errors.update(prediction, batch)
    errors = system.val_errors.compute()
    assert errors["position_error_m"] < 0.05
    assert errors["rotation_error_deg"] < 3
    return system


@pytest.mark.parametrize("name", FAR_APART)
def test_systems_far_apart_learn_eight_frames_by_heart(name):
    learned_by_heart(name, side=32, steps=80, lr=1e-2)


@pytest.mark.nightly
@pytest.mark.parametrize("name", mambaloc.list_models())
def test_every_system_learns_eight_frames_by_heart(name):
    """300 steps of a larger backbone take 6 to 20 s each."""
    larger = {"side": 64, "steps": 300, "backbone": "mobilenetv3_small_050"}
    # From afar the reprojection error is clipped and flat: it starts from learned weights, as its recipe does.
    start = learned_by_heart("posenet_learned", lr=3e-3, **larger).network if name == "posenet_geometric" else None
    learned_by_heart(name, lr=1e-4 if start else 3e-3, start=start, **larger)
