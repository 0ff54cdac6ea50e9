"""Run the trials of a sweep, each in its own process: one after another, or side by side on Ray."""

from __future__ import annotations

import contextlib
import csv
import json
import logging
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from filelock import FileLock, Timeout

from mambaloc.errors import InputError
from mambaloc.sweep.progress import SweepProgress
from mambaloc.sweep.store import Store
from mambaloc.sweep.trials import Sweep, Trial

TRAIN = (sys.executable, "-m", "mambaloc.cli")
_CONNECT_S = 10
_SUPERVISOR = Path(__file__).with_name("supervised.py")


@dataclass(frozen=True)
class Outcome:
    """How a trial's process ended.

    Args:
        results: what each evaluation says, by epoch: ``metrics.json``, and ``frames``.
        seconds: that the process took.
        error: why it failed; None where it did not.
    """

    results: dict[str, dict[str, Any]]
    seconds: float
    error: str | None = None


def run_sweep(sweep: Sweep, out: Path, address: str | None = None, retry_failed: bool = False) -> dict[str, int]:
    """Run every trial that the store does not hold; the store learns of each as it ends.

    Args:
        sweep: what to run.
        out: folder of the store, and of ``runs/``; on a cluster, one that every machine sees.
        address: of a Ray cluster; without it a local Ray, or one trial after another where Ray is not installed.
        retry_failed: also those that failed before.

    Returns:
        How many trials are ``done``, ``failed``, and were ``found`` in the store.

    Raises:
        InputError: where another process runs trials into the same folder, it cannot be written, or Ray is not there.
    """
    with Store(out) as store, _alone(out), _pool(sweep, address) as submit:
        ended = store.read()
        found = [ended[trial.key] for trial in sweep.trials if trial.key in ended]  # it may hold another sweep's too
        kept = [trial for trial in found if trial.error is None or not retry_failed]
        failed = {trial.key for trial in kept if trial.error is not None}
        done = {trial.key for trial in kept} - failed
        waiting = [trial for trial in sweep.trials if trial.key not in done | failed]
        with SweepProgress(sweep, kept) as progress:
            running: dict[Future[Outcome], Trial] = {}
            while waiting or running:
                for trial in [trial for trial in waiting if set(trial.after) <= done | failed]:
                    waiting.remove(trial)
                    if lost := failed & set(trial.after):
                        outcome = Outcome({}, 0.0, f"needs the run of a trial that failed ({min(lost)[:12]})")
                        _keep(store, progress, trial, outcome, done, failed)
                        continue
                    folder = run_folder(out, trial.key).absolute()
                    running[submit(train_command(trial, out), folder, sweep.time_limit_s, sweep.cpus)] = trial
                    progress.started(trial)
                for future in wait(running, return_when=FIRST_COMPLETED).done if running else ():
                    _keep(store, progress, running.pop(future), _outcome(future), done, failed)
    return {"done": len(done), "failed": len(failed), "found": len(kept)}


def run_folder(out: Path, key: str) -> Path:
    """Where a trial's training writes."""
    return out / "runs" / key[:12]


def train_command(trial: Trial, out: Path) -> tuple[str, ...]:
    """The command that trains in the trial's folder."""
    folder_of = partial(run_folder, out.absolute())
    return *TRAIN, *trial.command(folder_of), "--trainer.default_root_dir", str(folder_of(trial.key))


def run_trial(command: tuple[str, ...], run: Path, time_limit_s: float, cpus: float) -> Outcome:
    """Train and evaluate in a process of its own; needs nothing of the caller's but its arguments.

    Args:
        command: that writes ``evaluation/*/metrics.json`` in the run's folder.
        run: the folder; what an earlier try left there is removed.
        time_limit_s: after which the process, and all that it started, is killed.
        cpus: threads that it may use.
    """
    shutil.rmtree(run, ignore_errors=True)
    run.mkdir(parents=True)
    threads = str(max(1, int(cpus)))
    environment = {**os.environ, "OMP_NUM_THREADS": threads, "MKL_NUM_THREADS": threads}
    started = time.perf_counter()
    with (run / "output.txt").open("wb") as output:
        process = subprocess.Popen(
            [sys.executable, str(_SUPERVISOR), *command],
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
        )
        try:
            process.wait(time_limit_s)
            error = _why(process.returncode, run / "output.txt")
        except subprocess.TimeoutExpired:
            error = f"took longer than {time_limit_s:g} s, and was stopped"
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
    seconds = time.perf_counter() - started
    results = {
        path.name: _result(path) for path in sorted(run.glob("evaluation/*")) if (path / "metrics.json").is_file()
    }
    if error is None and not results:
        error = "ended without an evaluation"
    return Outcome(results if error is None else {}, seconds, error)


def _result(evaluation: Path) -> dict[str, Any]:
    """What ``metrics.json`` says, and under ``frames`` each frame's image and errors, to compare systems by."""
    result = json.loads((evaluation / "metrics.json").read_text(encoding="utf-8"))
    if both := result.get("network_and_map"):
        both["frames"] = _frames(evaluation / "predictions_both.csv")
    return {**result, "frames": _frames(evaluation / "predictions.csv")}


def _frames(predictions: Path) -> dict[str, Any]:
    with predictions.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    errors = {name: [float(row[name]) for row in rows] for name in ("position_error_m", "rotation_error_deg")}
    return {"image": [row["image"] for row in rows], **errors}


def _why(code: int, output: Path) -> str | None:
    """Why a process failed: the last line of its output, or the signal that killed it."""
    if code == 0:
        return None
    if code in (-signal.SIGKILL, 128 + signal.SIGKILL):
        return "was killed, as when memory runs out"
    lines = [line.strip() for line in output.read_text(errors="replace").splitlines() if line.strip()]
    return lines[-1][:500] if lines else f"ended with code {code}, without a message"


def _outcome(future: Future[Outcome]) -> Outcome:
    try:
        return future.result()
    except Exception as error:  # of the machine that it ran on
        return Outcome({}, 0.0, f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}")


def _keep(
    store: Store, progress: SweepProgress, trial: Trial, outcome: Outcome, done: set[str], failed: set[str]
) -> None:
    store.write(trial, outcome.results, outcome.seconds, outcome.error)
    (done if outcome.error is None else failed).add(trial.key)
    progress.ended(trial, outcome.seconds, outcome.error)


@contextlib.contextmanager
def _alone(out: Path) -> Iterator[None]:
    lock = FileLock(out / ".lock", timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise InputError(
            f"{out}: another process is writing trials there; wait for it, or choose another --out"
        ) from None
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}); choose another --out") from None
    try:
        yield
    finally:
        lock.release()


Submit = Callable[[tuple[str, ...], Path, float, float], "Future[Outcome]"]


@contextlib.contextmanager
def _pool(sweep: Sweep, address: str | None) -> Iterator[Submit]:
    """What runs trials: Ray where it is installed, else a thread that runs one at a time."""
    if find_spec("ray") is None:
        if address is not None:
            raise InputError(f"--address {address}: needs Ray; pip install 'mambaloc[cluster]'")
        with ThreadPoolExecutor(1) as pool:
            yield lambda *arguments: pool.submit(run_trial, *arguments)
        return
    import ray

    if address is not None and ":" in address:
        _check_answers(address)  # Ray itself tries for minutes
    logging.getLogger("ray").setLevel(logging.ERROR)  # of itself it speaks of tokens and addresses
    try:
        ray.init(address=address, log_to_driver=False, include_dashboard=False, configure_logging=False)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise InputError(f"--address {address}: no Ray there ({str(error).splitlines()[0]}); start one") from None
    for name, needed in (("CPU", sweep.cpus), ("GPU", sweep.gpus)):
        if (there := ray.cluster_resources().get(name, 0)) < needed:
            ray.shutdown()
            raise InputError(f"{name.lower()}s: {needed:g} a trial, and Ray has {there:g}; lower it in the sweep")
    remote = ray.remote(num_cpus=sweep.cpus, num_gpus=sweep.gpus, max_retries=0)(run_trial)
    try:
        yield lambda *arguments: remote.remote(*arguments).future()
    finally:
        ray.shutdown()


def _check_answers(address: str) -> None:
    """Refuse a Ray cluster's ``HOST:PORT``, or ``ray://HOST:PORT``, where nothing listens."""
    parts = urlsplit(address if "//" in address else f"//{address}")
    try:
        socket.create_connection((parts.hostname or "", parts.port or 6379), _CONNECT_S).close()
    except (OSError, ValueError) as error:
        raise InputError(f"--address {address}: no Ray cluster answers there ({error}). Start one.") from None
