"""Every way of training faster trains the same: the losses of fifty steps, and what a resumed run goes on with."""

import shutil

import lightning as L
import pytest
import torch
import yaml

from mambaloc.cli import main
from mambaloc.data import PoseDataModule
from mambaloc.errors import InputError
from mambaloc.models import create_model
from mambaloc.models.weights import read_checkpoint

SMALL = {
    "backbone": "test_resnet", "dim": 16, "heads": 2, "encoder_layers": 1, "feedforward": 16, "head_hidden": 16,
    "normalise_position": True, "lr": 1e-3,
}  # fmt: skip
EPOCHS = 9  # of 24 frames in steps of 4: 54 steps


class Losses(L.Callback):
    """The loss and the learning rate of each step."""

    def __init__(self):
        self.losses, self.rates = [], []

    def on_train_batch_start(self, trainer, *_):
        self.rates.append(trainer.optimizers[0].param_groups[0]["lr"])

    def on_train_batch_end(self, trainer, module, outputs, *_):
        self.losses.append(outputs["loss"].item())


def fit(scenes, model=None, data=None, **trainer):
    L.seed_everything(3, verbose=False)
    told = {"image_size": 32, "short_side": 36, "batch_size": 4, "validation": "test_set", **(data or {})}
    system = create_model("mambaloc", image_size=32, **{**SMALL, **(model or {})})
    losses = Losses()
    options = {
        "max_epochs": EPOCHS, "accelerator": "cpu", "logger": False, "enable_checkpointing": False,
        "enable_progress_bar": False, "enable_model_summary": False, "callbacks": [losses], **trainer,
    }  # fmt: skip
    L.Trainer(**options).fit(system, PoseDataModule("7scenes", str(scenes), "heads", **told))
    return system, losses


@pytest.fixture(scope="module")
def plain(scenes):
    """Fifty-four steps as they are without any option."""
    return fit(scenes)[1].losses


def test_resident_frames_train_exactly_as_mapped_ones(scenes, plain):
    assert len(plain) == 54
    assert fit(scenes, data={"resident": True})[1].losses == plain


STEADY = {"backbone": "resnet10t", "dropout": 0.0, "lr": 1e-4}
"""Without dropout, whose masks a compiled step draws in its own order, and at the paper's rate: at ten times that, Adam
makes a tenth of a loss out of a last digit within fifty steps."""


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.skipif(shutil.which("g++") is None, reason="compiling for a CPU needs g++")
def test_compiled_steps_have_the_losses_of_plain_ones(scenes):
    """Compiling takes a minute. The gate has the refusals below, and the overlay's parsed values in test_recipes.py."""
    plain, compiled = (fit(scenes, {**STEADY, "compile_mode": mode}) for mode in (None, "default"))
    assert compiled[1].losses == pytest.approx(plain[1].losses, rel=2e-3, abs=2e-3)
    assert set(compiled[0].state_dict()) == set(plain[0].state_dict())


def test_compiling_without_a_compiler(scenes, monkeypatch):
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(InputError, match=r"model\.compile_mode: needs a C\+\+ compiler"):
        fit(scenes, {"compile_mode": "default"})


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize(
    ("model", "data", "trainer", "tolerance"),
    [
        ({}, {"resident": False}, {}, 1e-4),
        ({"compile_mode": "default"}, {}, {}, 5e-3),
        ({"compile_mode": "reduce-overhead"}, {}, {}, 5e-3),
        ({}, {}, {"precision": "bf16-mixed"}, 5e-2),
    ],
)
def test_a_gpu_trains_the_same_every_way(scenes, model, data, trainer, tolerance):
    plain = fit(scenes, STEADY, accelerator="gpu", devices=1)[1].losses
    fast = fit(scenes, {**STEADY, **model}, data, accelerator="gpu", devices=1, **trainer)[1].losses
    assert fast == pytest.approx(plain, rel=tolerance, abs=tolerance)


class NoWaiting(L.Callback):
    """Any wait for the device within an epoch, after the first two steps, is an error."""

    def on_train_batch_start(self, trainer, module, batch, batch_idx):
        torch.cuda.set_sync_debug_mode("error" if trainer.global_step > 1 else "default")

    def on_train_epoch_end(self, *_):
        torch.cuda.set_sync_debug_mode("default")

    on_exception = on_train_epoch_end


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_an_epoch_never_waits_for_the_gpu(scenes):
    fit(scenes, {"backbone": "resnet10t"}, accelerator="gpu", devices=1, limit_val_batches=0, callbacks=[NoWaiting()])


@pytest.mark.parametrize("schedule", ["one_cycle", "cosine"])
def test_a_schedule_spans_the_whole_training(scenes, schedule):
    rates = torch.tensor(fit(scenes, {"schedule": schedule})[1].rates).double()
    progress = torch.arange(54).double()
    if schedule == "cosine":
        expected = 0.5e-3 * (1 + torch.cos(torch.pi * progress / 54))
    else:  # up from a 25th over three tenths of the steps, and down to a 250,000th, each along a cosine
        top, end = 0.3 * 54 - 1, 53.0
        up = torch.lerp(
            torch.tensor(4e-5).double(), torch.tensor(1e-3).double(), (1 - torch.cos(torch.pi * progress / top)) / 2
        )
        fallen = (1 + torch.cos(torch.pi * (progress - top) / (end - top))) / 2
        expected = torch.where(progress <= top, up, 4e-9 + (1e-3 - 4e-9) * fallen)
    torch.testing.assert_close(rates, expected, rtol=1e-6, atol=1e-12)


def test_a_schedule_needs_to_know_how_long(scenes):
    with pytest.raises(InputError, match=r"model\.schedule cosine: needs the training's length"):
        fit(scenes, {"schedule": "cosine"}, max_epochs=-1)
    with pytest.raises(InputError, match=r"model\.compile_mode 'fastest': choose one of default, reduce-overhead"):
        create_model("mambaloc", compile_mode="fastest")
    with pytest.raises(InputError, match=r"model\.schedule 'linear': choose one of step, cosine, one_cycle"):
        create_model("mambaloc", schedule="linear")


def test_frozen_groups_stay_as_they_start(scenes):
    L.seed_everything(3, verbose=False)
    start = create_model("mambaloc", image_size=32, **SMALL).network.backbone.model.state_dict()
    system, _ = fit(scenes, {"frozen_groups": 2}, max_epochs=2)
    trained = system.network.backbone.model.state_dict()
    changed = {name.split(".")[0] for name in start if not torch.equal(start[name], trained[name])}
    assert changed == {"layer2", "layer3"}  # groups 0 and 1 are the stem and layer1; their statistics, too, stayed


def test_kept_features_train_as_computed_ones(scenes, tmp_path):
    model = {"frozen_groups": 2, "frozen_statistics": True, "lr": 1e-4}
    data = {"augmentation_draws": 2, "augmentation": "rotation", "cache_dir": str(tmp_path)}
    computed = fit(scenes, model, data, max_epochs=4)[1].losses
    kept = fit(scenes, {**model, "feature_cache_gib": 0.1}, data, max_epochs=4)[1].losses
    assert kept == pytest.approx(computed, rel=1e-3)  # kept in half precision
    again = fit(scenes, {**model, "feature_cache_gib": 0.1}, data, max_epochs=4)[1].losses
    assert again == kept
    assert len(list(tmp_path.glob("features/*/features.npy"))) == 1


def test_features_of_ever_new_augmentations_are_not_kept(scenes):
    with pytest.raises(InputError, match=r"model\.feature_cache_gib: .*Set data\.augmentation_draws"):
        fit(scenes, {"frozen_groups": 2, "feature_cache_gib": 0.1}, max_epochs=1)
    with pytest.raises(InputError, match=r"model\.frozen_groups 0: .* has no frozen features to keep"):
        fit(scenes, {"feature_cache_gib": 0.1}, {"augmentation_draws": 2}, max_epochs=1)
    with pytest.raises(InputError, match=r"data\.augmentation_draws 0: must be 1 or more, or null"):
        fit(scenes, data={"augmentation_draws": 0}, max_epochs=1)


def test_frozen_statistics_stay_while_weights_change(scenes):
    L.seed_everything(3, verbose=False)
    start = create_model("mambaloc", image_size=32, **SMALL).network.backbone.model.state_dict()
    system, _ = fit(scenes, {"frozen_statistics": True}, max_epochs=2)
    trained = system.network.backbone.model.state_dict()
    kept = {name for name in start if torch.equal(start[name], trained[name])}
    assert kept == {name for name in start if "running_" in name or "num_batches" in name}


@pytest.mark.parametrize(("model", "groups"), [("mambaloc", 9), ("student", -1)])
def test_groups_that_a_backbone_lacks(model, groups):
    with pytest.raises(InputError, match=rf"frozen_groups {groups}: resnet10t has \d; choose one of 0 to \d"):
        create_model(model, image_size=32, backbone="resnet10t", frozen_groups=groups)


def test_a_googlenet_has_no_groups():
    with pytest.raises(InputError, match="has no layer groups"):
        create_model("posenet", variant="googlenet", frozen_groups=1)


def test_averaged_weights_are_what_a_run_leaves_and_resumes(tiny_recipe, tmp_path):
    recipe = yaml.safe_load(tiny_recipe.read_text())
    recipe["model"]["init_args"] |= {"schedule": "one_cycle", "frozen_groups": 1}
    average = {"class_path": "lightning.pytorch.callbacks.EMAWeightAveraging", "init_args": {"decay": 0.9}}
    recipe["trainer"]["callbacks+"] = [average]
    recipe["best_checkpoint"] = {"save_top_k": 0}
    tiny_recipe.write_text(yaml.safe_dump(recipe))
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    main([str(tiny_recipe), "--trainer.default_root_dir", str(whole)])
    # the schedule spans four epochs in both, one of which is stopped half-way
    main([str(tiny_recipe), "--trainer.default_root_dir", str(cut), "--trainer.callbacks+", f"{__name__}.StopAfterTwo"])
    main([str(tiny_recipe), "--ckpt_path", str(cut / "checkpoints/last.ckpt")])
    states = [read_checkpoint(run / "checkpoints/last.ckpt") for run in (whole, cut)]
    for part in ("state_dict", "current_model_state"):
        torch.testing.assert_close(states[0][part], states[1][part], rtol=0, atol=0)
    head = "network.head.position.0.weight"
    assert not torch.equal(states[0]["state_dict"][head], states[0]["current_model_state"][head])


def test_a_schedule_made_for_another_length_is_not_gone_on_with(tiny_recipe, tmp_path):
    words = ["--best_checkpoint.save_top_k", "0", "--model.schedule", "one_cycle", "--trainer.max_epochs"]
    main([str(tiny_recipe), "--trainer.default_root_dir", str(tmp_path / "run"), *words, "1"])
    last = tmp_path / "run/checkpoints/last.ckpt"
    with pytest.raises(SystemExit, match="2"):
        main([str(tiny_recipe), "--ckpt_path", str(last), *words, "2"])


def test_summed_gradients_are_no_graphs(scenes):
    with pytest.raises(InputError, match="a replayed graph overwrites accumulated gradients"):
        fit(scenes, {"compile_mode": "reduce-overhead"}, accumulate_grad_batches=2)


class StopAfterTwo(L.Callback):
    """Stop as Ctrl-C would, with two of the epochs done."""

    def on_train_epoch_end(self, trainer, module):
        trainer.should_stop = trainer.current_epoch == 1
