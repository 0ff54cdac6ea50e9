"""Every registered system through its whole life, in every GIS mode: built, trained, saved and loaded."""

from fnmatch import fnmatch

import lightning as L
import pytest
import torch
from systems import EVERY, flat, frames, small
from torch import nn
from torch.utils.data import DataLoader

import mambaloc
from mambaloc.errors import InputError
from mambaloc.nn import MambaMixer

# Parameters that no loss can reach, and why.
UNTRAINED = {
    "none": (),
    "classical": ("*.mixer.A_log",),  # from a zero state nothing decays
    "gis": (),
}


@EVERY
def test_shapes_and_finiteness(name, gis):
    system = small(name, gis)
    for train in (True, False):
        prediction = system.train(train)(frames().image)
        assert (prediction.position_m.shape, prediction.quaternion.shape) == ((3, 3), (3, 4))
        assert flat(prediction).isfinite().all()


@EVERY
def test_every_parameter_is_trained(name, gis):
    unclipped = {"loss_args": {"clip_px": 1e4}} if name == "posenet_geometric" else {}  # from afar all is clipped
    system, batch = small(name, gis, **unclipped).train(), frames()
    system.loss(system(batch.image), batch).backward()
    grads = {n: p.grad for n, p in system.named_parameters() if p.requires_grad}
    assert all(grad.isfinite().all() for grad in grads.values() if grad is not None)
    untrained = {n for n, grad in grads.items() if grad is None or not grad.any()}
    assert untrained == {n for n in grads if any(fnmatch(n, pattern) for pattern in UNTRAINED[gis])}


@EVERY
@torch.no_grad()
def test_evaluation_has_no_dropout_and_no_memory(name, gis):
    system, image = small(name, gis), frames().image
    dropout = any(isinstance(m, nn.Dropout) and m.p > 0 for m in system.modules())
    assert not dropout or not torch.equal(flat(system.train()(image)), flat(system(image)))
    system.eval()
    before = {k: v.clone() for k, v in system.state_dict().items()}
    first = flat(system(image))
    assert torch.equal(first, flat(system(image)))
    assert all(torch.equal(v, before[k]) for k, v in system.state_dict().items())
    torch.testing.assert_close(first[1:2], flat(system(image[1:2])), rtol=1e-4, atol=1e-5)  # no frame sees another


@EVERY
@torch.no_grad()
def test_forward_is_its_parts_one_after_another(name, gis):
    network, image = small(name, gis).eval().network, frames().image
    expected = flat(network(image))
    branches = network.forward_features(image)
    assert [feature.shape for feature in branches] == [branches[0].shape] * 2
    has_several = network.takes_intrinsics or name == "multi_scene_transposenet"  # cells, or queries
    assert (len(branches[0]), branches[0].ndim) == (3, 3 if has_several else 2)
    assert torch.equal(flat(network.forward_head(branches)), expected)
    again = network.features(network.forward_backbone(image))
    assert all(torch.equal(*pair) for pair in zip(again, branches, strict=True))


@EVERY
@torch.no_grad()
def test_a_seed_determines_the_system(name, gis):
    first, again, other = (small(name, gis, seed=seed).eval() for seed in (3, 3, 4))
    assert all(torch.equal(v, again.state_dict()[k]) for k, v in first.state_dict().items())
    image = frames().image
    assert torch.equal(flat(first(image)), flat(again(image)))
    assert not torch.equal(flat(first(image)), flat(other(image)))


@EVERY
def test_checkpoint_round_trip(name, gis, tmp_path):
    system, batch = small(name, gis, lr=1e-2), frames()
    start = {k: v.clone() for k, v in system.named_parameters()}
    trainer = L.Trainer(
        default_root_dir=tmp_path, accelerator="cpu", max_epochs=1, logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False,
    )  # fmt: skip
    trainer.fit(system, DataLoader([batch], batch_size=None))
    assert any(not torch.equal(p, start[n]) for n, p in system.named_parameters())
    trainer.save_checkpoint(tmp_path / "last.ckpt")

    system.eval()
    for loaded in (mambaloc.load(tmp_path / "last.ckpt"), type(system).load_from_checkpoint(tmp_path / "last.ckpt")):
        assert type(loaded) is type(system)
        assert dict(loaded.hparams) == dict(system.hparams)
        assert loaded.state_dict().keys() == system.state_dict().keys()
        with torch.no_grad():
            assert torch.equal(flat(loaded.eval()(batch.image)), flat(system(batch.image)))
    assert loaded.provenance["model"] == name


@EVERY
def test_optimiser_holds_every_parameter_once_and_decays_neither_dynamics_nor_loss_weights(name, gis):
    system = small(name, gis, weight_decay=0.25)
    groups = system.configure_optimizers()["optimizer"].param_groups
    held = [id(p) for group in groups for p in group["params"]]
    assert sorted(held) == sorted(id(p) for p in system.parameters() if p.requires_grad)
    undecayed = {id(p) for group in groups if group["weight_decay"] == 0 for p in group["params"]}
    mixers = [m for m in system.modules() if isinstance(m, MambaMixer)]
    assert bool(mixers) == (gis != "none")
    expected = {id(p) for m in mixers for p in (m.A_log, m.D)} | {id(p) for p in system.loss.parameters()}
    assert undecayed == expected
    assert {group["weight_decay"] for group in groups} == ({0.25, 0.0} if expected else {0.25})


@pytest.mark.parametrize("clip", [None, 1.0])
def test_gradients_can_be_clipped_under_mixed_precision(clip, tmp_path):
    system = small("student", "none")
    trainer = L.Trainer(
        default_root_dir=tmp_path, accelerator="cpu", max_epochs=1, logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False, precision="bf16-mixed", gradient_clip_val=clip,
    )  # fmt: skip
    trainer.fit(system, DataLoader([frames()], batch_size=None))
    assert trainer.optimizers[0].defaults["fused"] is (clip is None)


def test_what_needs_the_scene_says_so(tmp_path):
    trainer = L.Trainer(default_root_dir=tmp_path, accelerator="cpu", max_epochs=1, logger=False)
    with pytest.raises(InputError, match=r"model\.normalise_position: needs the scene; give the trainer a Pose"):
        trainer.fit(small("student", "none", normalise_position=True), DataLoader([frames()], batch_size=None))
