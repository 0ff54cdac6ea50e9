"""Speed: every figure is measured, alike on both sides, and the arithmetic is right."""

import json
import os
import time
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from rich.console import Console

from mambaloc.benchmark import (
    BenchmarkConfig,
    SpeedReport,
    footprint,
    measure_all,
    print_report,
    speed,
    whole_training,
    write_report,
)
from mambaloc.benchmark.clock import PARTS, StepClock
from mambaloc.benchmark.footprint import Footprint, exponent, in_a_process, measure_scaling, peak_bytes
from mambaloc.benchmark.speed import OURS, REFERENCE, Program, Turn, measure_speed, times_as_long
from mambaloc.benchmark.speed_report import print_scaling
from mambaloc.benchmark.whole_training import measure_whole_training
from mambaloc.errors import InputError

TINY_BACKBONE = "test_efficientnet"  # timm's own for tests
SMALL = {"dim": 32, "heads": 4, "encoder_layers": 2, "feedforward": 32, "head_hidden": 32}


@pytest.fixture(scope="module")
def setting(scenes):
    scene = {"dataset": "7scenes", "root": str(scenes), "image_size": 32, "short_side": 36, "batch_size": 4}
    return BenchmarkConfig("mambaloc", {"backbone": TINY_BACKBONE, **SMALL}, {**scene, "validation": "sequences"})


def test_a_clock_counts_computing_not_waiting():
    clock = StepClock(torch.device("cpu"))
    time.sleep(0.3)
    clock.mark("load")
    clock.end_step()
    assert clock.parts_s["load"][0] < 0.1


@pytest.mark.parametrize("option", [{"clip_length": 3}, {"points_per_frame": 8}])
def test_what_the_published_loop_cannot_load(option, setting):
    with pytest.raises(InputError, match="loads no clips and no scene points"):
        measure_speed(replace(setting, data={**setting.data, **option}))


def program(name, seconds, mib, keeps=True, dropout=0.1):
    """A program of 8 images; a turn of two steps for each number of seconds."""
    parts_s = [{"load": [0.25 * s] * 2, "forward": [0.75 * s] * 2} for s in seconds]
    turns = [Turn({**dict.fromkeys(PARTS, [0.0] * 2), **of_each}, mib * 2**20, 0) for of_each in parts_s]
    return Program(name, 8, dropout, keeps, tuple(turns))


def test_ratios_by_hand(capsys):
    ours, theirs = program(OURS, [2.0, 4.0, 3.0], 1000), program(REFERENCE, [4.0, 6.0, 9.0], 1500)
    assert times_as_long(theirs, ours) == [2, 1.5, 3]
    as_it_comes, other = (replace(theirs, keeps_memory=False), program(OURS, [9.0], 7, dropout=0.0))
    assert not theirs.is_beside(other)
    print_report(SpeedReport(BenchmarkConfig("atloc"), [ours, theirs, as_it_comes], []), "this machine")
    said = capsys.readouterr().out
    assert "A step of 8 images, attention dropout 0.1" in said
    rows = [" ".join(line.split()) for line in said.splitlines()]
    assert "ours 3.00 [2.00, 4.00] 1000" in rows
    assert "published 6.00 [4.00, 9.00] 2.00 [1.50, 3.00] 1500 1.50" in rows
    assert "published, as it comes 6.00 [4.00, 9.00] 2.00 [1.50, 3.00] 1500 1.50" in rows
    assert "ours 750 2250" in rows  # load and forward


def test_exponents_by_hand(capsys):
    assert exponent([250, 500, 1000], [1.0, 2.0, 4.0]) == pytest.approx(1)
    assert exponent([10, 20, 40], [3.0, 3.0, 3.0]) == pytest.approx(0, abs=1e-9)
    grown = [Footprint(n, n / 500, 2**20 * 700, 0) for n in (250, 500, 1000)]
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
    setting = BenchmarkConfig("mambaloc", {"dim": 4, "heads": 2}, {"short_side": 9}).with_overlay(overlay)
    assert setting.model == {"dim": 8, "heads": 2}
    assert setting.data == {"short_side": 9, "batch_size": 2}
    assert setting.trainer == {"precision": "bf16-mixed"}
    assert setting.device.type == "cpu"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "cannot be read"),
        ("{", "is not YAML"),
        ("- 1", "sets nothing of model"),
        ("early_stopping: 1", "nothing"),
    ],
)
def test_no_overlay(text, message, tmp_path):
    path = tmp_path / "o.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=message):
        BenchmarkConfig("mambaloc").with_overlay(path)


def test_speed_needs_frames(setting):
    with pytest.raises(InputError, match="--batch 13: the scene has 12 frames"):
        measure_speed(setting, batches=[4, 13])


@pytest.fixture(scope="module")
def measured(setting):
    """Everything, measured in this process, since new ones would import torch each time; and the seconds it took."""
    trained = replace(setting, model={**setting.model, "lr": 1e-3}, trainer={"max_epochs": 2})
    threads = torch.get_num_threads()
    with pytest.MonkeyPatch.context() as patch:
        for module in (footprint, speed, whole_training):
            patch.setattr(module, "in_a_process", lambda measure, *args: measure(*args))
        start = time.process_time()
        report = measure_all(trained, batches=[4, 6], frames=[6, 12], steps=3, turns=2, sought_m=100.0)
        torch.set_num_threads(threads)
        return report, time.process_time() - start


def check_whole_training(whole, frames, steps):
    assert (whole.frames, whole.steps) == (frames, steps)
    assert 0 < whole.first_step_s < whole.reached_s < whole.ended_s
    assert 0 < whole.position_error_m < 10


def test_every_figure_is_measured(measured):
    report, taken_s = measured
    ways = [(each.name, each.batch, each.attention_dropout, each.keeps_memory) for each in report.programs]
    assert ways == [
        (name, batch, dropout, keeps)
        for batch in (4, 6)
        for dropout in (0.0, 0.1)
        for name, keeps in ((OURS, True), (REFERENCE, True), (REFERENCE, False))
    ]
    turns = [turn for each in report.programs for turn in each.turns]
    assert len(turns) == 2 * len(ways)
    assert {len(seconds) for turn in turns for seconds in turn.parts_s.values()} == {3}
    assert min(turn.step_s for turn in turns) > 0
    assert 3 * sum(turn.step_s for turn in turns) < 1.5 * taken_s  # medians; nothing is counted twice
    for turn in report.programs[0].turns:  # ours has every part
        assert all(max(seconds) > 0 for seconds in turn.parts_s.values())
    assert [each.frames for each in report.scaling] == [6, 12]
    assert all(each.host_bytes > 2**27 for each in (*turns, *report.scaling))
    check_whole_training(report.whole, frames=12, steps=6)


def test_both_sides_train_with_the_same_dropout_and_allocator(setting, monkeypatch):
    said = []
    monkeypatch.setattr(speed, "keep_freed_memory", lambda: said.append("kept"))
    monkeypatch.setattr(speed, "peak_bytes", lambda: 0)

    def loop(system, data, device):
        said.append((system.hparams["attention_dropout"], data.hparams["batch_size"], torch.get_num_threads()))
        return SimpleNamespace(train=lambda steps, clock: None)

    monkeypatch.setattr(speed, "ReferenceLoop", loop)
    threads = torch.get_num_threads()
    for keeps in (True, False):
        speed.measure_turn(setting, Program(REFERENCE, 6, 0.1, keeps), 1)
    torch.set_num_threads(threads)
    assert said == ["kept", (0.1, 6, 1), (0.1, 6, 1)]


def test_the_report_is_printed_and_written(measured, tmp_path, capsys):
    report, _ = measured
    print_report(report, "this machine")
    said = capsys.readouterr().out
    for words in ("A step of 6 images", "as it comes", "backward", "seconds grow", "this machine"):
        assert words in said
    assert "Medians of 2 turns, lowest and highest in brackets, each turn in a process" in said
    assert "…" not in said  # nothing is cut off at 80 columns
    assert "100.0 m on validation frames (sequences) after " in " ".join(said.split())
    write_report(report, tmp_path / "speed.json", "this machine")
    told = json.loads((tmp_path / "speed.json").read_text())
    first = told["programs"][0]
    assert first["turns"][0]["parts_s"]["forward"] == report.programs[0].turns[0].parts_s["forward"]
    assert told["setting"]["system"] == "mambaloc"
    with pytest.raises(InputError, match="cannot be written"):
        write_report(report, tmp_path / "nowhere/speed.json", "this machine")


def test_a_process_is_new():
    assert in_a_process(os.getpid) != os.getpid()


@pytest.mark.nightly
@pytest.mark.slow
def test_processes_of_their_own(setting):
    """Nine that import torch; what they measure, the tests above guard in one."""
    programs = measure_speed(setting, [4], steps=1, turns=1)
    assert len(programs) == 6
    assert all(each.host_bytes > 2**27 for each in (*programs, *measure_scaling(setting, [6, 12])))
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
        measure_whole_training(BenchmarkConfig("mambaloc", {}, data, trainer), 0.1)


def test_a_system_without_a_published_form_is_measured_alone(setting, monkeypatch):
    monkeypatch.setattr(speed, "in_a_process", lambda measure, *args: measure(*args))
    threads = torch.get_num_threads()
    student = BenchmarkConfig("student", {"backbone": TINY_BACKBONE, "width": 16}, setting.data)
    (alone,) = measure_speed(student, steps=1, turns=1)
    torch.set_num_threads(threads)
    assert (alone.name, alone.batch, alone.attention_dropout) == (OURS, 4, None)
