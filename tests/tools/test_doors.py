"""tools/benchmark.py and tools/sweep.py lead where they say, and refuse in one line."""

import pytest
import yaml

from mambaloc import benchmark
from mambaloc.benchmark import size_of


def test_sizes(tool, capsys, monkeypatch):
    monkeypatch.setattr(benchmark, "size_table", lambda: [size_of("student", "none")])
    tool("benchmark", "sizes")
    assert "4,667,011" in capsys.readouterr().out


def test_a_sweep_is_planned(tool, tmp_path, capsys):
    (tmp_path / "r.yaml").write_text("model: {}")
    (tmp_path / "sweep.yaml").write_text(yaml.safe_dump({"axes": {"system": {"a": [str(tmp_path / "r.yaml")]}}}))
    tool("sweep", "run", tmp_path / "sweep.yaml", "--dry-run", "--out", tmp_path / "out")
    assert "1 trials, 1 to run" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["benchmark", "latency", "student", "--repetitions", 3], "--repetitions 3: quartiles need 4"),
        (["benchmark", "latency", "studnt"], "studnt"),
        (["benchmark", "deployment", "none.ckpt"], "none.ckpt"),
        (["benchmark", "speed", "--out", "nowhere/speed.json"], "the folder nowhere does not exist"),
        (["benchmark", "speed", "--overlay", "none.yaml"], "none.yaml"),
        (["sweep", "run", "none.yaml"], "none.yaml"),
        (["sweep", "report", "none"], "none: contains no result"),
        (["benchmarks/uncertainty", "none.ckpt"], "none.ckpt"),
        (["benchmarks/maps", "robustness", "none.yaml"], "none.yaml"),
        (["benchmarks/maps", "report", "none", "--out", "figure.png"], "measure it with maps.py robustness"),
        (["benchmarks/soak", "none.yaml"], "none.yaml: no such recipe"),
        (["benchmarks/scenes", "none"], "none: contains none of"),
        (["benchmarks/loading", "--dataset", "7scenes", "--root", "none"], "none"),
    ],
)
def test_wrong_uses(args, message, tool, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        tool(*args)
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert message in line
    assert not list(tmp_path.iterdir())
