"""Where a number comes from: commit, seed, versions, device."""

from __future__ import annotations

import os
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

MEASURED_WITH = ("mambaloc", "torch", "lightning", "timm", "numpy", "opencv-python-headless", "onnxruntime")


def commit() -> str | None:
    """Return this checkout's commit, ``+changes`` appended where tracked files differ; None outside a checkout.

    An installation may lie in the folder of another project, whose commit says nothing of this package.
    """
    git = ["git", "-C", str(Path(__file__).parent)]
    try:
        subprocess.run([*git, "ls-files", "--error-unmatch", Path(__file__).name], capture_output=True, check=True)
        # `describe --dirty` would also do, but a tag must not stand in for the hash.
        head = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout.strip()
        changes = subprocess.run([*git, "diff", "--quiet", "HEAD"], capture_output=True, check=False).returncode
    except (OSError, subprocess.CalledProcessError):
        return None
    return f"{head}+changes" if changes else head


def seed() -> int:
    """Return the run's seed, as ``lightning.seed_everything`` leaves it for every process; 0 if it was not set."""
    return int(os.environ.get("PL_GLOBAL_SEED", "0"))


def versions() -> dict[str, str]:
    """Versions of Python and of the packages a number depends on."""
    found = {"python": platform.python_version()}
    for package in MEASURED_WITH:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "unknown"
    return found


def device_name(cuda_index: int | None = None) -> str:
    """Name the processor, or the CUDA device of an index."""
    try:
        import torch  # only here: maps are built and measured without it
    except ModuleNotFoundError:
        return f"{_processor()}, {os.cpu_count()} threads"
    if cuda_index is not None:
        return torch.cuda.get_device_name(cuda_index)
    return f"{_processor()}, {torch.get_num_threads()} threads"


def machine(cuda_index: int | None = None) -> str:
    """Name the processor, or a CUDA device, and the commit: what a printed measurement ends with."""
    return f"{device_name(cuda_index)}, commit {commit()}"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
