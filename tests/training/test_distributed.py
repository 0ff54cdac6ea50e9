"""Two processes, started by Lightning or as SLURM starts them, are one training."""

import csv
import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from mambaloc.cli import main
from mambaloc.runtime import Localizer

TRAIN = (sys.executable, Path(__file__).parents[2] / "tools/train.py")
MEDIANS = ("val/position_error_m", "val/rotation_error_deg")


@pytest.fixture
def recipe(tiny_recipe, tmp_path):
    """One epoch of the tiny recipe over two processes, on a cache that is not there yet."""
    said = yaml.safe_load(tiny_recipe.read_text())
    said["trainer"] |= {"strategy": "ddp", "max_epochs": 1}
    # an image at a time: a convolution's last digits depend on how many it sees at once
    said["data"] |= {"eval_batch_size": 1, "cache_dir": str(tmp_path / "cache"), "keep_count": 5}
    said["best_checkpoint"] = {"save_top_k": 0}
    path = tmp_path / "distributed.yaml"
    path.write_text(yaml.safe_dump(said))
    return path


def assert_one_training(run, recipe, tmp_path):
    """What the two logged is what one process finds, to the last digit, and nothing was done twice."""
    (log,) = (run / "metrics").glob("version_*/metrics.csv")
    with log.open() as file:
        logged = {name: float(row[name]) for row in csv.DictReader(file) for name in MEDIANS if row[name]}
    words = ["validate", str(recipe), "--ckpt_path", str(run / "checkpoints/last.ckpt")]
    metrics = main([*words, "--trainer.strategy", "auto", "--trainer.logger", "false"]).trainer.callback_metrics
    assert logged == {name: metrics[name].item() for name in MEDIANS}
    caches = [path for path in (tmp_path / "cache/frames").iterdir() if path.suffix != ".lock"]
    assert len(caches) == 3  # of the training, validation and test frames: none twice, none half-built
    told = json.loads((run / "evaluation/last/metrics.json").read_text())
    assert told["data"]["test_frames"] == 8
    assert sorted(path.name for path in run.parent.iterdir()) == [run.name]


@pytest.mark.slow
def test_two_processes_of_lightnings(recipe, tmp_path):
    """They keep the best epoch, too, and the first of them exports it with its uncertainty while the other waits.

    Half a minute: two processes import torch, train and export, as two machines would; nothing else guards that.
    """
    run, command = tmp_path / "runs/run", tmp_path / "mambaloc"
    command.write_text("from mambaloc.commands import main\nif __name__ == '__main__':\n    main()\n")  # as pip does
    words = [sys.executable, command, "train", recipe, "--trainer.devices", "2", "--trainer.default_root_dir", run]
    words += ["--best_checkpoint.save_top_k", "1", "--onnx_export.enabled", "true"]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=240)
    assert done.returncode == 0, done.stderr
    assert_one_training(run, recipe, tmp_path)
    assert json.loads((run / "evaluation/best/metrics.json").read_text())["selection"].startswith("best: lowest")
    assert Localizer(run / "model.onnx").contract.uncertainty is not None


@pytest.mark.slow
def test_two_nodes_of_slurms(recipe, tmp_path):
    """Two processes on this machine, each told by SLURM's variables that it is a node of its own."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    job = {
        "SLURM_JOB_ID": "7", "SLURM_STEP_ID": "3", "SLURM_JOB_NAME": "train", "SLURM_NTASKS": "2",
        "SLURM_NTASKS_PER_NODE": "1", "SLURM_NODELIST": "127.0.0.1", "SLURM_LOCALID": "0",
        "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "GLOO_SOCKET_IFNAME": "lo",
    }  # fmt: skip
    words = [*TRAIN, recipe, "--trainer.num_nodes", "2", "--trainer.devices", "1"]
    tasks = [
        subprocess.Popen(
            words,
            cwd=tmp_path,
            env={**os.environ, **job, "SLURM_NODEID": str(node), "SLURM_PROCID": str(node)},
            stderr=subprocess.PIPE,
            text=True,
        )
        for node in range(2)
    ]
    said = [task.communicate(timeout=240)[1] for task in tasks]
    assert [task.returncode for task in tasks] == [0, 0], said
    assert_one_training(tmp_path / "runs/distributed/job-7.3", recipe, tmp_path)
