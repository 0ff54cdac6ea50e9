"""Settings of a CPU: every one runs, changes what it says, and nothing else."""

import os

import numpy as np
import pytest
import torch

from mambaloc.benchmark import Setting, cpu_settings, measure_cpu_settings, print_cpu_settings
from mambaloc.benchmark.cpu_settings import AS_IT_IS, SESSIONS, SettingTimes, _environment, _session
from mambaloc.benchmark.footprint import in_a_process
from mambaloc.errors import InputError
from mambaloc.export import contract_of, export_onnx


@pytest.fixture
def setting(scenes):
    scene = {"dataset": "7scenes", "root": str(scenes), "image_size": 32, "short_side": 36, "batch_size": 4}
    return Setting("student", {"backbone": "mobilenetv3_small_050"}, {**scene, "validation": "none"})


def test_sessions_say_the_same(setting, tmp_path):
    system, data = setting.build()
    path = tmp_path / "model.onnx"
    export_onnx(system.eval(), path, contract_of(system, data.hparams))
    image = torch.rand(1, 3, 32, 32)
    with torch.inference_mode():
        expected = system(image).position_m.numpy()
    for name, change in SESSIONS.items():
        position_m, _ = _session(path, 2, change).run(None, {"image": image.numpy()})
        np.testing.assert_allclose(position_m, expected, atol=1e-4, err_msg=name)


def test_an_environment_is_that_of_the_processes_started_meanwhile():
    before = dict(os.environ)
    with _environment({"MAMBALOC_TEST": "1"}):
        assert in_a_process(os.getenv, "MAMBALOC_TEST") == "1"
    assert dict(os.environ) == before


@pytest.mark.slow
def test_settings_are_timed_in_turns(setting, monkeypatch, capsys):
    monkeypatch.setattr(cpu_settings, "_forms", lambda setting: {AS_IT_IS: (setting, {})})
    found = measure_cpu_settings(setting, threads=1, steps=2, repetitions=4)
    assert set(found.inference) == set(SESSIONS)
    assert len(found.training[AS_IT_IS]) == 4
    assert min(s for times in (found.inference, found.training) for taken in times.values() for s in taken) > 0
    print_cpu_settings(found, 1, "machine")
    assert "branches side by side" in capsys.readouterr().out


def test_ratios_by_hand(capsys):
    print_cpu_settings(SettingTimes({AS_IT_IS: [0.002] * 4, "x": [0.003] * 4}, {AS_IT_IS: [0.1] * 4}), 2, "machine")
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["x", "1.50", "0.00", "3.00"] in rows


def test_too_few_repetitions(setting):
    with pytest.raises(InputError, match="--repetitions 3: quartiles need 4"):
        measure_cpu_settings(setting, threads=1, repetitions=3)
