"""Speed: the reference computes what we do, every figure is measured, and the arithmetic is right."""

import json
import os
import time
from dataclasses import replace

import pytest
import torch
from rich.console import Console

from mambaloc.benchmark import Setting, footprint, measure_all, print_report, whole_training, write_report
from mambaloc.benchmark.footprint import (
    Footprint,
    exponent,
    in_a_process,
    measure_footprints,
    measure_scaling,
    peak_bytes,
)
from mambaloc.benchmark.reference import DecodedFrames, Published, ReferenceLoop
from mambaloc.benchmark.speed import LOOP_ALONE, OURS, PARTS, REFERENCE, measure_speed, ratio
from mambaloc.benchmark.speed_report import print_scaling
from mambaloc.benchmark.whole_training import measure_whole_training
from mambaloc.data import PoseDataModule
from mambaloc.errors import InputError
from mambaloc.models import create_model

TINY_BACKBONE = "test_efficientnet"  # timm's own for tests
SMALL = {"dim": 32, "heads": 4, "encoder_layers": 2, "feedforward": 32, "head_hidden": 32}


@pytest.fixture
def data(scenes):
    module = PoseDataModule("7scenes", str(scenes), "heads", 32, 36, validation="sequences", batch_size=4)
    module.setup("fit")
    return module


@pytest.fixture(scope="module")
def setting(scenes):
    scene = {"dataset": "7scenes", "root": str(scenes), "image_size": 32, "short_side": 36, "batch_size": 4}
    return Setting("mambaloc", {"backbone": TINY_BACKBONE, **SMALL}, {**scene, "validation": "sequences"})


@pytest.mark.parametrize("backbone", ["resnet10t", "mobilenetv3_small_050"])
@pytest.mark.parametrize("gis", ["none", "gis"])
def test_published_form_is_the_same_function(backbone, gis):
    torch.manual_seed(0)
    system = create_model("mambaloc", backbone=backbone, gis=gis, image_size=64, **SMALL).eval()
    published = Published(system).eval()
    image = torch.rand(2, 3, 64, 64)
    ours, theirs = system(image), published(system.network.backbone.normalised(image))
    torch.testing.assert_close(theirs.position_m, ours.position_m, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(theirs.quaternion, ours.quaternion, rtol=1e-5, atol=1e-6)


def test_published_form_leaves_our_network_as_it_was():
    system = create_model("mambaloc", backbone="resnet10t", image_size=64, **SMALL)
    Published(system)
    assert {layer.attention_dropout for layer in system.network.position_encoder.layers} == {0.0}


def test_published_backbone_runs_stages_that_nobody_reads():
    system = create_model("mambaloc", backbone="resnet10t", image_size=64, **SMALL)
    loss = Published(system)(torch.rand(2, 3, 64, 64)).position_m.sum()
    loss.backward()
    whole = Published(system).backbone
    assert len(whole(torch.rand(1, 3, 64, 64))) == 5


def test_reference_decodes_what_the_cache_holds(data):
    """Of one frame in the centre: resized by PIL there, by OpenCV here."""
    frames = DecodedFrames(data, [0.0] * 3, [1.0] * 3, "val")
    image, position_m, quaternion = frames[3]
    batch = data.on_after_batch_transfer(next(iter(data.val_dataloader())), 0)
    assert image.shape == batch.image[3].shape
    assert (image - batch.image[3]).abs().mean() < 0.02
    assert torch.equal(position_m, batch.position_m[3])
    assert torch.equal(quaternion, batch.quaternion[3])


def test_reference_learns(data):
    torch.manual_seed(0)
    system = create_model("mambaloc", backbone=TINY_BACKBONE, image_size=32, lr=1e-3, **SMALL)
    loop = ReferenceLoop(system, data, Published(system), 12, torch.device("cpu"), 0)
    losses = [loss for _ in range(4) for loss in loop.train()]
    assert len(losses) == 48
    assert sum(losses[-12:]) < 0.6 * sum(losses[:12])
    assert loop.evaluate(loop.loader("val", 1, 5)) == 5


def test_ratios_by_hand():
    times, spread = ratio([2.0, 4.0, 6.0, 8.0], [1.0, 2.0, 3.0, 2.0])
    assert times == 5 / 2
    assert spread == pytest.approx(1.5)  # of 2, 2, 2 and 4: quartiles 2 and 3.5


def test_exponents_by_hand(capsys):
    assert exponent([250, 500, 1000], [1.0, 2.0, 4.0]) == pytest.approx(1)
    assert exponent([10, 20, 40], [3.0, 3.0, 3.0]) == pytest.approx(0, abs=1e-9)
    grown = [Footprint(OURS, n, 9.0, n / 500, 2**20 * 700, 0) for n in (250, 500, 1000)]
    print_scaling(grown, Console(highlight=False))
    said = capsys.readouterr().out
    assert "seconds grow as frames to the 1.00, host memory to the 0.00" in said
    assert "2.00" in said  # ms a frame


def test_peak_memory_grows_with_what_is_held():
    before = peak_bytes()
    held = bytearray(300 * 2**20)
    held[:: 2**12] = b"x" * len(held[:: 2**12])
    assert 0 <= peak_bytes() - before <= 400 * 2**20
    assert peak_bytes() >= 300 * 2**20


def test_overlays_say_model_data_and_trainer(tmp_path):
    overlay = tmp_path / "o.yaml"
    overlay.write_text("model: {init_args: {dim: 8}}\ndata: {batch_size: 2}\ntrainer: {precision: bf16-mixed}\n")
    setting = Setting("mambaloc", {"dim": 4, "heads": 2}, {"short_side": 9}).with_overlay(overlay)
    assert setting.model == {"dim": 8, "heads": 2}
    assert setting.data == {"short_side": 9, "batch_size": 2}
    assert setting.trainer == {"precision": "bf16-mixed"}
    assert setting.device.type == "cpu"


@pytest.mark.parametrize(
    ("text", "message"),
    [(None, "cannot be read"), ("{", "is no YAML"), ("- 1", "says nothing of model"), ("early_stopping: 1", "nothing")],
)
def test_no_overlay(text, message, tmp_path):
    path = tmp_path / "o.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=message):
        Setting("mambaloc").with_overlay(path)


def test_speed_needs_repetitions(setting):
    with pytest.raises(InputError, match="--repetitions 3: quartiles need 4"):
        measure_speed(setting, repetitions=3)


def test_speed_needs_frames(setting):
    with pytest.raises(InputError, match="--steps 4: in batches of 8 they need more than the scene's 12 frames"):
        measure_speed(setting, batches=[8], steps=4)


@pytest.fixture(scope="module")
def measured(setting):
    """Everything, measured in this process, since new ones would import torch each time; and the seconds it took."""
    trained = replace(setting, model={**setting.model, "lr": 1e-3}, trainer={"max_epochs": 2})
    with pytest.MonkeyPatch.context() as patch:
        for module in (footprint, whole_training):
            patch.setattr(module, "in_a_process", lambda measure, *args: measure(*args))
        start = time.perf_counter()
        report = measure_all(trained, batches=[6], frames=[6, 12], steps=2, repetitions=4, workers=1, sought_m=100.0)
        return report, time.perf_counter() - start


def check_footprints(footprints):
    assert all(each.first_step_s > 0 and each.host_bytes > 2**27 for each in footprints)


def check_whole_training(whole, frames, steps):
    assert (whole.frames, whole.steps) == (frames, steps)
    assert 0 < whole.first_step_s < whole.reached_s < whole.ended_s
    assert 0 < whole.position_error_m < 10


def test_every_figure_is_measured(measured):
    report, taken = measured
    assert set(report.speed.training) == {OURS, REFERENCE, LOOP_ALONE}
    assert set(report.speed.batches) == {4, 6}
    assert set(report.speed.parts[OURS]) == set(PARTS)
    for rates in (*report.speed.training.values(), *report.speed.evaluation.values(), *report.speed.batches.values()):
        assert len(rates) == 4
        assert min(rates) > 0
    seconds = [s for rates in report.speed.training.values() for s in (8 / rate for rate in rates)]
    assert sum(seconds) < taken  # of steps of 4 images: nothing is counted twice
    assert all(min(taken) >= 0 for way in report.speed.parts.values() for taken in way.values())
    assert [each.way for each in report.footprints] == [OURS, REFERENCE]
    assert [each.frames for each in report.scaling] == [6, 12]
    check_footprints([*report.footprints, *report.scaling])
    check_whole_training(report.whole, frames=12, steps=6)


def test_the_report_is_printed_and_written(measured, tmp_path, capsys):
    report, _ = measured
    print_report(report, "this machine")
    said = capsys.readouterr().out
    for words in ("training", "evaluation", "backward", "reference", "first step", "seconds grow", "this machine"):
        assert words in said
    assert "100.0 m on validation frames (sequences) after " in " ".join(said.split())
    write_report(report, tmp_path / "speed.json", "this machine")
    told = json.loads((tmp_path / "speed.json").read_text())
    assert told["speed"]["training"][OURS] == report.speed.training[OURS]
    assert told["setting"]["system"] == "mambaloc"
    with pytest.raises(InputError, match="cannot be written"):
        write_report(report, tmp_path / "nowhere/speed.json", "this machine")


def test_a_process_is_new():
    assert in_a_process(os.getpid) != os.getpid()


@pytest.mark.nightly
@pytest.mark.slow
def test_processes_of_their_own(setting):
    """Five that import torch; what they measure, the tests above guard in one."""
    check_footprints([*measure_footprints(setting, 2, 1), *measure_scaling(setting, [6, 12])])
    trained = replace(
        setting,
        model={**setting.model, "lr": 1e-3},
        data={**setting.data, "keep_count": 5},
        trainer={"max_epochs": 2},
    )
    check_whole_training(measure_whole_training(trained, 100.0), frames=5, steps=4)


@pytest.mark.parametrize(
    ("data", "trainer", "message"),
    [({"validation": "none"}, {"max_steps": 1}, "needs frames to validate on"), ({}, {}, "needs an end")],
)
def test_a_training_that_reaches_nothing(data, trainer, message):
    with pytest.raises(InputError, match=f"--reach: {message}"):
        measure_whole_training(Setting("mambaloc", {}, data, trainer), 0.1)


def test_a_system_without_a_published_form_is_measured_beside_the_loop(setting):
    student = Setting("student", {"backbone": TINY_BACKBONE, "width": 16}, setting.data)
    speed = measure_speed(student, batches=[], steps=2, repetitions=4, workers=0)
    assert set(speed.training) == {OURS, REFERENCE}
