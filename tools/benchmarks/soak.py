"""Sample memory, open files and threads while a recipe trains, to see whether a long training stays as it began.

python tools/benchmarks/soak.py RECIPE.yaml [OVERLAY.yaml ...] [--steps N] [--out FOLDER]
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from matplotlib.figure import Figure
from rich.console import Console

from mambaloc import provenance
from mambaloc.benchmark.footprint import STATUS, proc_value
from mambaloc.benchmark.report import new_table
from mambaloc.console import OptionParser, configure_logging, exit_on_input_error, whole_number
from mambaloc.errors import InputError
from mambaloc.files import writing
from mambaloc.viz.curves import COLORS, finish
from mambaloc.viz.png import write_png

_SAMPLES = 200
_FEWEST = 10  # steps
_WARM_UP = 0.2  # of the steps: allocators and caches fill, first validation and first checkpoint
_TRAIN = f"import sys; sys.path.append({str(Path(__file__).parent)!r}); from mambaloc.cli import main; main()"

SHOWN = {
    "private_mib": "memory of its own (MiB)",
    "device_mib": "memory on the GPU (MiB)",
    "files": "open files",
    "threads": "threads",
}


@dataclass(frozen=True)
class Sample:
    """What a training process held after a step.

    Args:
        step: of the optimiser.
        seconds: since the first step.
        private_mib: resident memory without mapped files, as the cache of frames.
        device_mib: memory that tensors take on a GPU; 0 without one.
        files: open file handles.
        threads: of the process.
    """

    step: int
    seconds: float
    private_mib: float
    device_mib: float
    files: int
    threads: int


@exit_on_input_error
def main() -> None:
    """Train, print and draw."""
    configure_logging()
    parser = OptionParser(description=__doc__)
    parser.add_argument("recipes", type=Path, nargs="+", help="a recipe, and overlays")
    parser.add_argument("--steps", type=whole_number(1), default=10_000)
    parser.add_argument("--out", type=Path, default=Path("runs/soak"), help="folder that is not there yet")
    args = parser.parse_args()
    samples = measure_soak(args.recipes, args.steps, args.out)
    print_soak(samples, provenance.machine())
    draw_soak(samples, args.out / "soak.png", f"{args.recipes[0].stem}, {args.steps} steps")
    print(f"{args.out}: soak.png, samples.jsonl, train.log, run/")


class ResourceWatch(L.Callback):
    """Write a :class:`Sample` now and then, a JSON object a line.

    Args:
        out: the file.
        every_n_steps: how often.
    """

    def __init__(self, out: str, every_n_steps: int) -> None:
        self.out, self.every_n_steps = Path(out), every_n_steps
        self._started_at = 0.0

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        """Sample, where this step's turn has come."""
        self._started_at = self._started_at or time.monotonic()
        if trainer.global_step % self.every_n_steps:
            return
        device = torch.cuda.memory_allocated() if torch.cuda.is_available() else 0
        sample = Sample(
            trainer.global_step,
            round(time.monotonic() - self._started_at, 3),
            proc_value(STATUS, "RssAnon:") / 1024,
            device / 2**20,
            len(list(STATUS.with_name("fd").iterdir())),
            proc_value(STATUS, "Threads:"),
        )
        with self.out.open("a", encoding="utf-8") as file:
            file.write(json.dumps(asdict(sample)) + "\n")


def measure_soak(recipes: Sequence[Path], steps: int, out: Path) -> list[Sample]:
    """Train a recipe for so many steps, as ``tools/train.py`` does, in a process of its own.

    Args:
        recipes: a recipe and overlays; the last of its epochs, and early stopping, are put off.
        steps: of the optimiser.
        out: the run's folder, which must not be there yet.

    Raises:
        InputError: for too few steps, no recipe or no ``/proc``, a folder that is there, or a training that fails.
    """
    if not STATUS.is_file():
        raise InputError("soak: open files and threads are counted in /proc, which only Linux has; run it there")
    if steps < _FEWEST:
        raise InputError(f"--steps {steps}: give {_FEWEST} or more; growth is seen after the first fifth")
    if missing := next((recipe for recipe in recipes if not recipe.is_file()), None):
        raise InputError(f"{missing}: no such recipe; give one of recipes/")
    if out.exists():
        raise InputError(f"{out}: already exists; choose another folder with --out, or remove it")
    with writing(out):
        out.mkdir(parents=True)
    samples, log = out / "samples.jsonl", out / "train.log"
    watch = "--trainer.callbacks"
    command = [
        *(sys.executable, "-c", _TRAIN, *map(str, recipes), "--trainer.default_root_dir", str(out / "run")),
        *("--trainer.max_epochs", "-1", "--trainer.max_steps", str(steps), "--early_stopping.patience", "0"),
        *(f"{watch}+=soak.ResourceWatch", f"{watch}.out={samples}"),
        f"{watch}.every_n_steps={max(1, steps // _SAMPLES)}",
    ]
    with Console(stderr=True).status(f"training {steps} steps"), log.open("w", encoding="utf-8") as output:
        ended = subprocess.run(command, stdout=output, stderr=subprocess.STDOUT, check=False)
    if ended.returncode:
        last = (log.read_text(encoding="utf-8").strip().splitlines() or ["it printed nothing"])[-1]
        raise InputError(f"{recipes[0]}: its training ended with {ended.returncode} ({last}); see {log}")
    return read_samples(samples)


def read_samples(path: Path) -> list[Sample]:
    """Read what a :class:`ResourceWatch` wrote."""
    return [Sample(**json.loads(line)) for line in path.read_text(encoding="utf-8").splitlines()]


def growth(samples: list[Sample], of: str) -> tuple[float, float]:
    """What a quantity began at after the warm-up, and what a straight line through it adds in 1000 steps."""
    kept = [sample for sample in samples if sample.step > _WARM_UP * samples[-1].step]
    values = np.array([getattr(sample, of) for sample in kept], dtype=float)
    slope, _ = np.polyfit([sample.step for sample in kept], values, 1)
    return float(np.median(values[: max(1, len(values) // 10)])), 1000 * float(slope)


def print_soak(samples: list[Sample], machine: str) -> None:
    """Print a row a quantity: after the warm-up, growth, largest."""
    table = new_table("A long training", "", "begins at", "per 1000 steps", "ends at", "largest")
    for of, name in SHOWN.items():
        if not any(getattr(sample, of) for sample in samples):
            continue
        start, slope = growth(samples, of)
        largest = max(getattr(sample, of) for sample in samples)
        table.add_row(name, f"{start:.1f}", f"{slope:+.3f}", f"{getattr(samples[-1], of):.1f}", f"{largest:.1f}")
    console = Console(highlight=False)
    console.print(table)
    console.print(f"{samples[-1].step} steps in {samples[-1].seconds:.0f} s; {machine}", soft_wrap=True)


def draw_soak(samples: list[Sample], path: Path, title: str) -> None:
    """Draw each quantity over the steps."""
    shown = [of for of in SHOWN if any(getattr(sample, of) for sample in samples)]
    figure = Figure(figsize=(8, 2.2 * len(shown)), layout="constrained")
    for axes, of in zip(figure.subplots(len(shown), 1, sharex=True), shown, strict=True):
        axes.plot([sample.step for sample in samples], [getattr(sample, of) for sample in samples], color=COLORS[1])
        axes.set_ylabel(SHOWN[of].replace(" (", "\n("), fontsize=9)
        axes.set_ylim(0, 1.15 * max(getattr(sample, of) for sample in samples))
        finish(axes)
    axes.set_xlabel("step")
    figure.suptitle(title, fontsize=11)
    with writing(path):
        write_png(figure, path)


if __name__ == "__main__":
    main()
