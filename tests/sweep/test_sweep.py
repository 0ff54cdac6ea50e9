"""Sweeps: what their trials are, and that every trial runs once, whatever happens meanwhile."""

import json
import signal
import socket
import sqlite3
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from mambaloc.cli import recipe_arguments
from mambaloc.errors import InputError
from mambaloc.sweep import Store, print_plan, read_sweep, run_sweep, running
from mambaloc.sweep.running import run_folder

FAKE = textwrap.dedent(
    """
    import json, os, sys, time
    from pathlib import Path
    args = sys.argv[1:]
    run = Path(args[-1])
    if "--raise" in args:
        raise ValueError("nothing works")
    if "--hang" in args:
        time.sleep(600)
    if "--memory" in args:
        os.kill(os.getpid(), 9)
    if "--nothing" in args:
        sys.exit()
    time.sleep(0.2 if "--slow" in args else 0)
    out = run / "evaluation/last"
    out.mkdir(parents=True)
    (out / "predictions.csv").write_text("image,position_error_m,rotation_error_deg\\nseq-01/a.png,0.5,2\\n")
    (out / "metrics.json").write_text(json.dumps({"metrics": {"position_error_m": 0.5}, "args": args}))
    with open(os.environ["TRIED"], "a") as file:
        file.write(" ".join(args[:-2]) + "\\n")
    """
)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "fake.py").write_text(FAKE)
    (tmp_path / "r.yaml").write_text("model: {}\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TRIED", str(tmp_path / "tried.txt"))
    monkeypatch.setattr(running, "TRAIN", (sys.executable, str(tmp_path / "fake.py")))
    monkeypatch.setattr(running, "find_spec", lambda name: None)  # one after another
    return tmp_path


def sweep_of(folder, **told):
    path = folder / "sweep.yaml"
    path.write_text(yaml.safe_dump(told, sort_keys=False))
    return read_sweep(path)


def six(folder, **others):
    axes = {
        "system": {"a": ["r.yaml", "--a"], "b": ["r.yaml", "--b"]},
        "seed": {str(n): ["--seed_everything", n] for n in range(3)},
    }
    return sweep_of(folder, axes=axes, common_args=["--slow"], **others)


def tried(folder):
    path = folder / "tried.txt"
    return path.read_text().splitlines() if path.exists() else []


# --- trials -----------------------------------------------------------------------------------------------------------


def test_every_combination_is_a_trial_with_files_before_options(folder):
    (folder / "o.yaml").write_text("data: {}\n")
    axes = {
        "system": {"a": ["r.yaml", "--lr", 1e-4]},
        "gis": {"none": ["o.yaml"], "gis": ["o.yaml", "--model.gis", "gis"]},
        "seed": {0: ["--seed_everything", 0], 1: ["--seed_everything", 1]},
    }
    trials = sweep_of(folder, axes=axes, common_args=["--flag", True], exclude=[{"gis": "none", "seed": 1}]).trials
    assert [dict(trial.labels) for trial in trials] == [
        {"system": "a", "gis": "none", "seed": "0"},
        {"system": "a", "gis": "gis", "seed": "0"},
        {"system": "a", "gis": "gis", "seed": "1"},
    ]
    assert trials[1].args == (
        *("r.yaml", "o.yaml", "--lr", "0.0001", "--flag", "true", "--model.gis", "gis", "--seed_everything", "0"),
    )
    assert len({trial.key for trial in trials}) == 3


def test_a_key_changes_with_what_a_recipe_says(folder):
    before = [trial.key for trial in six(folder).trials]
    assert [trial.key for trial in six(folder).trials] == before
    (folder / "r.yaml").write_text("model: {lr: 1}\n")
    assert not set(before) & {trial.key for trial in six(folder).trials}


def test_a_trial_comes_after_the_one_whose_run_it_needs(folder):
    axes = {
        "system": {"second": ["r.yaml", "--from", "{system=first}/last.ckpt"], "first": ["r.yaml"]},
        "seed": {0: ["--s", 0], 1: ["--s", 1]},
    }
    trials = sweep_of(folder, axes=axes).trials
    by_name = {trial.name: trial for trial in trials}
    assert [trial.name for trial in trials][:2] == ["first 0", "first 1"]
    assert by_name["second 1"].after == (by_name["first 1"].key,)
    run_sweep(sweep_of(folder, axes=axes), folder / "out")
    run = run_folder(folder / "out", by_name["first 0"].key)
    assert f"r.yaml --from {run}/last.ckpt --s 0" in tried(folder)


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({}, "has no 'axes'"),
        ({"axes": {}}, "has no 'axes'"),
        ({"axes": {"a": {}}}, "axis a has no labels"),
        ({"axes": {"a": {"x": "r.yaml"}}}, "give a list of recipes"),
        ({"axes": {"a": {"x": ["none.yaml"]}}}, "none.yaml: no such recipe"),
        ({"axes": {"a": {"x": ["r.yaml"]}}, "seeds": 3}, "unknown key seeds; choose among axes"),
        ({"axes": {"a": {"x": ["r.yaml"]}}, "always": []}, "'always' is now called 'common_args'. Rename"),
        ({"axes": {"a": {"x": ["r.yaml"]}}, "without": []}, "'without' is now called 'exclude'. Rename"),
        ({"axes": {"a": {"x": ["r.yaml"]}}, "cpus": 0}, "cpus is 0"),
        ({"axes": {"a": {"x": ["r.yaml"]}}, "time_limit_s": "long"}, "time_limit_s is 'long'"),
        ({"axes": {"a": {"x": ["r.yaml"]}}, "exclude": [{"a": "y"}]}, "names no place"),
        ({"axes": {"a": {"x": ["r.yaml"]}}, "exclude": [{"a": "x"}]}, "excludes every trial; exclude fewer"),
        ({"axes": {"a": {"x": ["r.yaml", "{b=1}"]}}}, "names the axis b"),
        ({"axes": {"a": {"x": ["r.yaml", "{a=y}"]}}}, "which is excluded"),
        ({"axes": {"a": {"x": ["r.yaml", "{a=y}"], "y": ["r.yaml", "{a=x}"]}}}, "break the circle"),
    ],
)
def test_what_is_no_sweep(folder, told, message):
    with pytest.raises(InputError, match=message) as error:
        sweep_of(folder, **told)
    assert "sweep.yaml" in str(error.value)


# --- running ----------------------------------------------------------------------------------------------------------


def test_every_trial_runs_once(folder):
    assert run_sweep(six(folder), folder / "out") == {"done": 6, "failed": 0, "found": 0}
    assert len(set(tried(folder))) == 6
    assert run_sweep(six(folder), folder / "out") == {"done": 6, "failed": 0, "found": 6}
    assert len(tried(folder)) == 6
    with Store(folder / "out") as store:
        kept = store.read()
    assert [trial.labels["system"] for trial in kept.values()] == ["a", "a", "a", "b", "b", "b"]
    assert all(trial.results["last"]["metrics"] == {"position_error_m": 0.5} for trial in kept.values())
    assert all(trial.seconds > 0.2 for trial in kept.values())


def test_frames_of_network_and_map_are_kept_beside_the_networks(tmp_path):
    header = "image,position_error_m,rotation_error_deg"
    (tmp_path / "metrics.json").write_text(json.dumps({"network_and_map": {"metrics": {"accepted": 0.5}}}))
    (tmp_path / "predictions.csv").write_text(f"{header}\nseq-01/a.png,0.5,2\nseq-01/b.png,0.4,3\n")
    (tmp_path / "predictions_both.csv").write_text(
        f"{header},source\nseq-01/a.png,0.01,1,map\nseq-01/b.png,0.4,3,network\n"
    )
    result = running._result(tmp_path)
    assert result["frames"]["position_error_m"] == [0.5, 0.4]
    assert result["network_and_map"]["frames"] == {
        **{"image": ["seq-01/a.png", "seq-01/b.png"], "position_error_m": [0.01, 0.4]},
        "rotation_error_deg": [1.0, 3.0],
    }
    assert result["network_and_map"]["metrics"] == {"accepted": 0.5}


def test_another_sweeps_trials_in_the_store_are_not_counted(folder):
    run_sweep(six(folder), folder / "out")
    other = sweep_of(folder, axes={"system": {"c": ["r.yaml"]}})
    assert run_sweep(other, folder / "out") == {"done": 1, "failed": 0, "found": 0}


def test_what_fails_is_recorded_and_the_rest_goes_on(folder):
    axes = {
        "system": {
            "raises": ["r.yaml", "--raise"],
            "hangs": ["r.yaml", "--hang"],
            "memory": ["r.yaml", "--memory"],
            "nothing": ["r.yaml", "--nothing"],
            "needs": ["r.yaml", "{system=raises}"],
            "works": ["r.yaml"],
        }
    }
    sweep = sweep_of(folder, axes=axes, time_limit_s=3)
    assert run_sweep(sweep, folder / "out") == {"done": 1, "failed": 5, "found": 0}
    with Store(folder / "out") as store:
        errors = {trial.labels["system"]: trial.error for trial in store.read().values()}
    assert errors.pop("works") is None
    assert errors.pop("raises") == "ValueError: nothing works"
    assert errors.pop("hangs") == "took longer than 3 s, and was stopped"
    assert errors.pop("memory") == "was killed, as when memory runs out"
    assert errors.pop("nothing") == "ended without an evaluation"
    assert errors.pop("needs").startswith("needs the run of a trial that failed")
    assert run_sweep(sweep, folder / "out")["found"] == 6
    (folder / "fake.py").write_text(FAKE.replace('"--raise" in args', "False").replace('"--hang" in args', "False"))
    assert run_sweep(sweep, folder / "out", retry_failed=True) == {"done": 4, "failed": 2, "found": 1}


def stored(out):
    with Store(out) as store:
        return {key: (c.labels, c.args, c.error, c.results["last"]["metrics"]) for key, c in store.read().items()}


def test_killed_half_way_and_resumed_the_store_is_the_same(folder):
    sweep = six(folder)
    program = (
        "import sys; from pathlib import Path; from mambaloc.sweep import read_sweep, run_sweep, running\n"
        f"running.TRAIN = {running.TRAIN!r}; running.find_spec = lambda name: None\n"
        "run_sweep(read_sweep(Path('sweep.yaml')), Path('out'))"
    )
    process = subprocess.Popen([sys.executable, "-c", program])
    deadline = time.monotonic() + 60
    while len(tried(folder)) < 3 and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    begun = len(tried(folder))
    time.sleep(0.6)
    assert len(tried(folder)) == begun  # what it had started ended with it
    with Store(folder / "out") as store:
        assert 2 <= len(store.read()) < 6
    run_sweep(sweep, folder / "out")
    run_sweep(sweep, folder / "undisturbed")
    kept = [stored(folder / name) for name in ("out", "undisturbed")]
    assert kept[0] == kept[1]
    assert len(kept[0]) == 6


def test_a_store_of_an_earlier_version_is_read(folder):
    """Trials were cells, their args words; what ended is not run again."""
    run_sweep(six(folder), folder / "out")
    before = stored(folder / "out")
    database = sqlite3.connect(folder / "out/results.sqlite")
    database.executescript("ALTER TABLE trials RENAME TO cells; ALTER TABLE cells RENAME COLUMN args TO words")
    database.close()
    assert stored(folder / "out") == before
    assert run_sweep(six(folder), folder / "out")["found"] == 6


def test_two_processes_do_not_run_into_one_folder(folder):
    sweep = six(folder)
    (folder / "out").mkdir()
    with running._alone(folder / "out"), pytest.raises(InputError, match="another process is writing trials there"):
        run_sweep(sweep, folder / "out")


def test_a_store_that_is_none(folder):
    (folder / "out").mkdir()
    (folder / "out/results.sqlite").write_text("no database, but some text that is long enough to be read as a header")
    with pytest.raises(InputError, match="is not a store of results"):
        run_sweep(six(folder), folder / "out")
    (folder / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        run_sweep(six(folder), folder / "file")


def test_an_address_needs_ray(folder):
    with pytest.raises(InputError, match=r"pip install 'mambaloc\[cluster\]'"):
        run_sweep(six(folder), folder / "out", address="1.2.3.4:6379")


def test_an_address_where_nothing_listens_is_refused_at_once():
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
        running._check_answers(address)
        running._check_answers(f"ray://{address}")
    for gone in (address, f"ray://{address}", "127.0.0.1:x"):
        with pytest.raises(InputError, match=rf"--address {gone}: no Ray cluster answers there"):
            running._check_answers(gone)


@pytest.mark.slow
def test_two_workers_of_a_local_ray(folder, monkeypatch):
    pytest.importorskip("ray")
    monkeypatch.undo()
    monkeypatch.chdir(folder)
    monkeypatch.setenv("TRIED", str(folder / "tried.txt"))
    monkeypatch.setattr(running, "TRAIN", (sys.executable, str(folder / "fake.py")))
    axes = {"system": {name: ["r.yaml", f"--{name}"] for name in ("raise", "hang", "memory", "a", "b", "c")}}
    sweep = sweep_of(folder, axes=axes, time_limit_s=4)
    assert run_sweep(sweep, folder / "out") == {"done": 3, "failed": 3, "found": 0}
    with Store(folder / "out") as store:
        errors = {trial.labels["system"]: trial.error for trial in store.read().values() if trial.error}
    assert errors == {
        "raise": "ValueError: nothing works",
        "hang": "took longer than 4 s, and was stopped",
        "memory": "was killed, as when memory runs out",
    }
    assert sorted(tried(folder)) == ["r.yaml --a", "r.yaml --b", "r.yaml --c"]


@pytest.mark.skipif(sys.platform != "linux", reason="other systems leave orphans to themselves")
def test_a_killed_supervisor_takes_its_training_along(tmp_path):
    told = tmp_path / "pid"
    sleep = f"import os, time, pathlib; pathlib.Path({str(told)!r}).write_text(str(os.getpid())); time.sleep(60)"
    args = [sys.executable, str(running._SUPERVISOR), sys.executable, "-c", sleep]
    supervisor = subprocess.Popen(args, stdin=subprocess.PIPE, start_new_session=True)
    wait_for(lambda: told.is_file() and told.read_text())
    supervisor.kill()
    supervisor.communicate()
    process = Path("/proc", told.read_text(), "stat")
    wait_for(lambda: not process.is_file() or process.read_text().rpartition(")")[2].split()[0] == "Z")


def wait_for(happens, seconds=10):
    until = time.monotonic() + seconds
    while not happens():
        assert time.monotonic() < until
        time.sleep(0.05)


def test_a_real_training_is_a_trial(scenes, tiny_recipe, tmp_path, monkeypatch):
    monkeypatch.setattr(running, "find_spec", lambda name: None)
    axes = {"system": {"mambaloc": [str(tiny_recipe), "--trainer.max_epochs", 1]}}
    sweep = sweep_of(tmp_path, axes=axes)
    assert run_sweep(sweep, tmp_path / "out")["done"] == 1
    with Store(tmp_path / "out") as store:
        (trial,) = store.read().values()
    assert trial.results["last"]["count"] == 8
    assert trial.results["last"]["training"]["wall_clock"]["train_s"] > 0
    frames = trial.results["last"]["frames"]
    assert frames["image"][0].startswith("seq-03/")
    median_m = np.median(frames["position_error_m"])
    assert median_m == pytest.approx(trial.results["last"]["metrics"]["position_error_m"], rel=1e-5)
    assert run_folder(tmp_path / "out", trial.key).is_dir()


def test_recipes_of_the_package_are_found_outside_of_a_checkout(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = Path("sweep.yaml")
    path.write_text(yaml.safe_dump({"axes": {"system": {"student": ["recipes/student_embedded.yaml"]}}}))
    (before,) = read_sweep(path).trials
    Path("recipes").mkdir()
    Path("recipes/student_embedded.yaml").write_text("model: {}")  # the reader's own comes first, and is another trial
    (after,) = read_sweep(path).trials
    assert before.args == after.args
    assert before.key != after.key


def test_every_shipped_sweep_names_recipes_that_are_there(monkeypatch, capsys):
    repository = Path(__file__).parents[2]
    monkeypatch.chdir(repository)
    shipped = sorted((repository / "recipes/sweeps").glob("*.yaml"))
    assert shipped
    for path in shipped:
        sweep = read_sweep(path)
        for args in {trial.args for trial in sweep.trials if trial.labels.get("seed", "0") == "0"}:
            options = [arg.replace("{system=posenet_learned}", "runs") for arg in args]
            recipe_arguments(options)  # recipes and overlays first, and all there
        print_plan(sweep, {})
    assert "108 trials, 108 to run" in capsys.readouterr().out


def test_a_plan_tells_what_ended_and_what_it_may_take(folder, capsys):
    sweep = six(folder)
    run_sweep(
        sweep_of(
            folder,
            axes={"system": {"a": ["r.yaml", "--a"]}, "seed": {"0": ["--seed_everything", 0]}},
            common_args=["--slow"],
        ),
        folder / "out",
    )
    assert Store.ended(folder / "nothing") == {}
    assert not (folder / "nothing").exists()
    print_plan(sweep, Store.ended(folder / "out"))
    said = capsys.readouterr().out
    assert said.count("done") == 1
    assert said.count("to run") == 6
    assert "6 trials, 5 to run" in said
