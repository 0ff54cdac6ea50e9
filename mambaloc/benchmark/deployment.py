"""What a trained system costs and loses on a device: PyTorch beside ONNX Runtime in three precisions."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median, quantiles
from tempfile import TemporaryDirectory
from typing import Any

import onnx
import onnxruntime
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from torch import Tensor

from mambaloc.benchmark.latency import in_turns
from mambaloc.data import PoseDataModule
from mambaloc.errors import InputError
from mambaloc.evaluation.predict import localize_test_frames
from mambaloc.export import contract_of, export_onnx
from mambaloc.export.precision import half_precision
from mambaloc.export.quantization import eight_bit, median_errors
from mambaloc.metrics import summarize
from mambaloc.models import LitPoseRegressor
from mambaloc.runtime.contract import IMAGE_INPUT, INTRINSICS_INPUT

_A_TURN = 5  # repetitions


@dataclass(frozen=True)
class Deployment:
    """One form of one system.

    Args:
        name: of the system.
        form: ``PyTorch``, ``float32``, ``float16``, ``int8`` or ``int8 mixed``; all but the first on ONNX Runtime.
        size: bytes of its file.
        latency_s: of one image, each repetition.
        position_error_m: median over the test frames.
        rotation_error_deg: median rotation error of each form.
        frames: that these are over.
        fits: whether it loses so little that a bundle may hold it.
    """

    name: str
    form: str
    size: int
    latency_s: list[float]
    position_error_m: float
    rotation_error_deg: float
    frames: int
    fits: bool = True

    @property
    def spread_s(self) -> float:
        """Interquartile range of the latency."""
        low, _, high = quantiles(self.latency_s, n=4)
        return high - low


@dataclass(frozen=True)
class _Form:
    size: int
    call: Callable[[], object]
    errors: tuple[float, float]  # metres, degrees
    fits: bool = True


def measure_deployment(
    systems: Mapping[str, tuple[LitPoseRegressor, PoseDataModule]], threads: int = 2, repetitions: int = 50
) -> list[Deployment]:
    """Measure every form of some trained systems; their latencies are taken in turns, batch 1, preprocessing apart.

    Args:
        systems: by name, each with the data that it was trained with.
        threads: that one image may use.
        repetitions: of each latency.

    Raises:
        InputError: for too few repetitions, or frames that are not there.
    """
    if repetitions < 4:
        raise InputError(f"--repetitions {repetitions}: quartiles need 4 or more")
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        forms = {
            (name, form): measured
            for name, (system, data) in systems.items()
            for form, measured in _forms(system.cpu().eval(), data, threads).items()
        }
        latencies = _latencies([form.call for form in forms.values()], repetitions)
    finally:
        torch.set_num_threads(before)
    counts = {name: len(data.frames("test")) for name, (_, data) in systems.items()}
    return [
        Deployment(name, form, of.size, taken, *of.errors, counts[name], of.fits)
        for ((name, form), of), taken in zip(forms.items(), latencies, strict=True)
    ]


def speed_up(deployments: Sequence[Deployment], each: Deployment) -> tuple[float, float]:
    """How many times faster a form is than the first form: ratio of the medians, quartile range of the turns'."""
    first = deployments[0].latency_s
    low, _, high = quantiles([a / b for a, b in zip(first, each.latency_s, strict=True)], n=4)
    return median(first) / median(each.latency_s), high - low


def _latencies(calls: list[Callable[[], object]], repetitions: int) -> list[list[float]]:
    """Seconds of each call, in turns of a few back to back, so that all meet the same machine.

    The first of a turn do not count: the threads of whoever was before spin on for a while.
    """
    taken: list[list[float]] = [[] for _ in calls]
    console = Console(stderr=True)
    for _ in track(range(-(-repetitions // _A_TURN)), "timing", console=console, transient=True):
        for call, seconds in zip(calls, taken, strict=True):
            seconds += in_turns([call], _A_TURN)[0]
    return taken


def _forms(system: LitPoseRegressor, data: PoseDataModule, threads: int) -> dict[str, _Form]:
    image = torch.rand(1, 3, *system.image_size, generator=torch.Generator().manual_seed(0))
    with TemporaryDirectory() as folder:
        export_onnx(system, Path(folder, "model.onnx"), contract_of(system, data.hparams, world=data.world))
        exported = onnx.load(Path(folder, "model.onnx"))
    weights = io.BytesIO()
    torch.save(system.network.state_dict(), weights)
    half, int8 = half_precision(exported), eight_bit(exported, data)
    feeds = {IMAGE_INPUT: image.numpy()}
    if system.network.takes_intrinsics:
        feeds[INTRINSICS_INPUT] = system.network.default_intrinsics[None].numpy()
    summary = summarize(localize_test_frames(system, data, "cpu"))
    return {
        "PyTorch": _Form(weights.tell(), _eager(system, image), _medians(summary)),
        "float32": _on_onnx_runtime(exported, feeds, threads, _medians(median_errors(exported, data))),
        "float16": _on_onnx_runtime(half, feeds, threads, _medians(median_errors(half, data))),
        "int8" if int8.kind == "all layers" else f"int8 {int8.kind}": _on_onnx_runtime(
            int8.model, feeds, threads, (int8.position_error_m, int8.rotation_error_deg), int8.within_tolerance
        ),
    }


def _medians(errors: Mapping[str, float]) -> tuple[float, float]:
    return errors["position_error_m"], errors["rotation_error_deg"]


def _eager(system: LitPoseRegressor, image: Tensor) -> Callable[[], object]:
    def call() -> object:
        with torch.inference_mode():
            return system(image)

    return call


def _on_onnx_runtime(
    model: onnx.ModelProto,
    feeds: Mapping[str, NDArray[Any]],
    threads: int,
    errors: tuple[float, float],
    fits: bool = True,
) -> _Form:
    content = model.SerializeToString()
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    options.intra_op_num_threads = threads
    options.add_session_config_entry("session.force_spinning_stop", "1")  # else it disturbs whose turn is next
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    return _Form(len(content), lambda: session.run(None, feeds), errors, fits)
