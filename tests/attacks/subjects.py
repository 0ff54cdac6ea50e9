"""What is interrupted: each makes something in a folder, checks what lies there, and makes it again."""

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from mambaloc.cli import main
from mambaloc.data import PoseDataModule
from mambaloc.data.cache import cached_frames
from mambaloc.data.datasets import capture as capture_scene
from mambaloc.data.frames import BadFrames
from mambaloc.evaluation import evaluate_checkpoint
from mambaloc.export import contract_of, export_onnx, write_bundle
from mambaloc.export import onnx as onnx_module
from mambaloc.images import read_image
from mambaloc.importing.importer import import_scene
from mambaloc.models import Checkpoint
from mambaloc.models.student import LitStudent
from mambaloc.models.weights import read_checkpoint
from mambaloc.runtime import Localizer
from mambaloc.runtime.bundle import verify_bundle
from mambaloc.runtime.trajectory import write_tum
from mambaloc.sweep import Store, read_sweep, run_sweep, running
from mambaloc.sweep.report import write_report
from mambaloc.zoo import load
from mambaloc.zoo.publishing import publish


@dataclass(frozen=True)
class Subject:
    """An operation that writes.

    ``make(inputs, out)`` writes under ``out``; run again, it goes on from whatever is there. ``check(out)`` opens what
    is there with the readers that a user's next command has, and says whether it is finished.
    """

    make: Callable[[Path, Path], object]
    check: Callable[[Path], bool]


def student():
    torch.manual_seed(0)
    system = LitStudent(backbone="test_efficientnet", width=16, image_size=(32, 40)).eval()
    system.provenance = {"commit": "abc", "versions": {"torch": "2"}}
    return system


def scene(inputs):
    return PoseDataModule("7scenes", str(inputs / "scenes"), "heads", image_size=(32, 40), short_side=36)


def decode(inputs, out):
    cached_frames(sorted((inputs / "scenes/heads").glob("*/*.color.png")), 24, BadFrames(), out / "cache")


def check_cache(out):
    caches = [folder for folder in out.glob("cache/frames/*") if folder.is_dir() and not folder.suffix]
    for folder in caches:
        images, meta = np.load(folder / "images.npy"), json.loads((folder / "meta.json").read_text())
        assert len(images) == len(meta["rows"])
        assert all(image.any() for image in images)
    return bool(caches)


def train(inputs, out):
    last = out / "run/checkpoints/last.ckpt"
    resumed = ["--ckpt_path", str(last)] if last.exists() else ["--trainer.default_root_dir", str(out / "run")]
    main([str(inputs / "recipe.yaml"), *resumed])


def check_run(out):
    for path in out.glob("run/checkpoints/*.ckpt"):
        read_checkpoint(path)
    last = out / "run/checkpoints/last.ckpt"
    return last.exists() and read_checkpoint(last)["epoch"] == 1


def export(inputs, out):
    system = student()
    export_onnx(system, out / "model.onnx", contract_of(system, scene(inputs).hparams))


def use_converted(path):
    """Convert nothing to ONNX in this process: what is exported is the network that this file was converted from.

    The conversion writes nothing before its file, and takes seconds.
    """
    content = path.read_bytes()
    onnx_module._write = lambda deployed, contract, partial: partial.write_bytes(content)


def export_converted(inputs, out):
    use_converted(inputs / "model.onnx")
    export(inputs, out)


def check_export(out):
    path = out / "model.onnx"
    if path.exists():
        Localizer(path, 1).localize(np.zeros((40, 50, 3), np.uint8))
    return path.exists()


def bundle(inputs, out):
    if not (out / "bundle").exists():
        write_bundle(student(), scene(inputs), out / "bundle", ("onnx", "fp16"), raw_input=False)


def bundle_converted(inputs, out):
    use_converted(inputs / "bundle/model.onnx")
    bundle(inputs, out)


def check_bundle(out):
    if (out / "bundle").exists():
        assert len(verify_bundle(out / "bundle", 1)) == 2
    return (out / "bundle").exists()


def release(inputs, out):
    if not list((out / "zoo").glob("*.tiny")):
        publish(inputs / "run/checkpoints/best.ckpt", "tiny", out / "zoo", "cpu")


def check_release(out):
    found = list((out / "zoo").glob("[!.]*"))
    for folder in found:
        load(f"local-dir:{folder}")
    return bool(found)


def evaluate(inputs, out):
    evaluate_checkpoint(Checkpoint.read(inputs / "run/checkpoints/best.ckpt"), out=out / "results")


def check_evaluation(out):
    metrics = out / "results/metrics.json"
    if metrics.exists():
        json.loads(metrics.read_text())
    if (picture := out / "results/trajectory.png").exists():
        assert cv2.imread(str(picture)) is not None
    return metrics.exists()


def trajectory(inputs, out):
    write_tum(out / "poses.tum", range(1000), np.zeros((1000, 3)), np.ones((1000, 4)))


def check_trajectory(out):
    path = out / "poses.tum"
    return path.exists() and len(path.read_text().splitlines()) == 1001


def imported(inputs, out):
    if not (out / "scene").exists():
        import_scene(inputs / "capture", out / "scene", split="block")


def check_scene(out):
    if (out / "scene").exists():
        for split, count in (("train", 12), ("test", 5)):
            frames = capture_scene.read_split(out / "scene", split, BadFrames("error"))
            assert len([read_image(path) for path in frames.image_paths]) == count
    return (out / "scene").exists()


def benchmark(inputs, out):
    """A sweep whose trainings end at once, with the evaluation of one that was real; then its report."""
    copy = f"import shutil, sys; shutil.copytree({str(inputs / 'run/evaluation')!r}, sys.argv[-1] + '/evaluation')"
    running.TRAIN, running.find_spec = (sys.executable, "-c", copy), lambda name: None  # one after another
    kept = {key: cell for key, cell in Store.ended(out / "results").items() if cell.error is None}
    run_sweep(read_sweep(inputs / "sweep.yaml"), out / "results", retry_failed=True)
    assert kept.items() <= Store.ended(out / "results").items()  # the cells that had ended are not run again
    if not (out / "report").exists():
        write_report(out / "results", out / "report")


def check_benchmark(out):
    cells = Store.ended(out / "results").values()
    assert all("metrics" in cell.results["last"] for cell in cells if cell.error is None)
    if (out / "report").exists():
        assert len((out / "report/tables/results.csv").read_text().splitlines()) == 2
        assert (out / "report/report.html").read_text().rstrip().endswith("</html>")
    return (out / "report").exists() and len(cells) == 2


SUBJECTS = {
    "decoding frames": Subject(decode, check_cache),
    "import": Subject(imported, check_scene),
    "training": Subject(train, check_run),
    "export": Subject(export_converted, check_export),
    "bundle": Subject(bundle_converted, check_bundle),
    "publishing": Subject(release, check_release),
    "evaluation": Subject(evaluate, check_evaluation),
    "benchmark": Subject(benchmark, check_benchmark),
    "trajectory": Subject(trajectory, check_trajectory),
}
CONVERSION = Subject(export, check_export)
"""The export with its conversion."""
