"""Processes that localize images. One that dies or hangs is replaced, and its image is tried again.

LitServe 0.2.19 and Ray Serve 2.60 were measured beside this (docs/serving.md): with the one, requests of a worker that
is killed are not answered; with the other, an idle server takes 1.7 GiB.
"""

from __future__ import annotations

import asyncio
import math
import os
import signal
import sys
import threading
import warnings
from collections import deque
from collections.abc import Collection, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from mambaloc.errors import InputError
from mambaloc.images import decode_image
from mambaloc.runtime import Localizer
from mambaloc.runtime.localization import Localization

_TRIES = 3
_MAX_BATCH = 4  # images; with more, an image takes no less time
_START_S = 120.0
_ENVIRONMENT = {  # of a worker: it has a core, and the memory of images that cameras take
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "OPENCV_FOR_THREADS_NUM": "1",
    "OPENCV_IO_MAX_IMAGE_PIXELS": str(100_000_000),
}

Answer = dict[str, Any]
"""An image's result, ready for JSON: its pose, or ``error``, the rule that it breaks."""


@dataclass(frozen=True)
class Task:
    """An image to localize.

    Args:
        bundle: name of the bundle.
        image: an encoded image: JPEG, PNG and what else :func:`~mambaloc.images.decode_image` takes.
        intrinsics: (3, 3) pinhole matrix in its pixels; the training camera's unless given.
        is_distorted: it is as the training camera stores it, and is undistorted by its lens.
    """

    bundle: str
    image: bytes
    intrinsics: tuple[tuple[float, ...], ...] | None = None
    is_distorted: bool = False


class WorkerLostError(Exception):
    """A worker died, or took too long, with a task in hand."""


@dataclass(eq=False)
class _Waiting:
    """A task, its answer to come, and how many workers were lost with it."""

    task: Task
    answer: asyncio.Future[Answer]
    lost: int = 0


def next_batch(waiting: deque[_Waiting], batched: Collection[str]) -> list[_Waiting]:
    """Take the image that has waited longest, and those after it that can be localized with it.

    An image with which a worker was lost goes alone, so that it takes no other with it.

    Args:
        waiting: in the order in which they came.
        batched: names of bundles that gain by it; images of others go alone, each to the worker that is idle next.
    """
    batch = [waiting.popleft()]
    first = batch[0]
    max_batch = _MAX_BATCH if first.task.bundle in batched and not first.lost else 1
    while waiting and len(batch) < max_batch:
        task, following = first.task, waiting[0]
        if following.lost or (following.task.bundle, following.task.is_distorted) != (task.bundle, task.is_distorted):
            break
        batch.append(waiting.popleft())
    return batch


class Workers:
    """Worker processes, each with every bundle loaded.

    Args:
        bundles: folders, or other models that :class:`~mambaloc.runtime.Localizer` takes, by name.
        count: how many processes.
        seconds: that an image may take before its worker is replaced; a batch, so many times as long.

    Raises:
        InputError: for a bundle that cannot be served.

    Attributes:
        scenes: what each bundle knows, by the bundle's name.
        without_lens: names of bundles that cannot undistort images.
        replaced: how many workers were replaced.
    """

    def __init__(self, bundles: Mapping[str, Path], count: int, seconds: float = 30.0) -> None:
        localizers = {name: Localizer(path, threads=1) for name, path in bundles.items()}
        self.scenes = {name: each.scene for name, each in localizers.items()}
        self.without_lens = [name for name, each in localizers.items() if each.undistortion.lens is None]
        self._batched = {name for name, each in localizers.items() if each.runs_batches}
        self.count, self.replaced = count, 0
        self._threads = ThreadPoolExecutor(count, thread_name_prefix="worker")
        self._workers = [_Worker(bundles, seconds) for _ in range(count)]
        self._idle: deque[_Worker] = deque()
        self._waiting: deque[_Waiting] = deque()
        self._jobs: set[asyncio.Task[None]] = set()

    async def start(self) -> None:
        """Start all, and wait until they can localize.

        Raises:
            InputError: where one does not start.
        """
        loop = asyncio.get_running_loop()
        try:
            await asyncio.gather(*(loop.run_in_executor(self._threads, each.start) for each in self._workers))
        except WorkerLostError:
            self.stop()
            raise InputError(
                "--workers: a worker process did not start. Free some memory, or use fewer workers."
            ) from None
        self._idle.extend(self._workers)

    def stop(self) -> None:
        """End all processes."""
        for worker in self._workers:
            worker.stop()
        self._threads.shutdown(wait=False, cancel_futures=True)

    async def localize(self, task: Task) -> Answer:
        """Localize an image on the worker that is idle next, with others that wait for the same bundle.

        Raises:
            WorkerLostError: where several workers, one after another, were lost with it.
        """
        waiting = _Waiting(task, asyncio.get_running_loop().create_future())
        self._waiting.append(waiting)
        self._hand_out()
        try:
            return await waiting.answer
        finally:
            with suppress(ValueError):  # it waits still: its client has gone
                self._waiting.remove(waiting)

    def _hand_out(self) -> None:
        """Give each idle worker a batch, while any image waits."""
        while self._idle and self._waiting:
            batch = next_batch(self._waiting, self._batched)
            job = asyncio.create_task(self._localize_batch(self._idle.popleft(), batch))
            self._jobs.add(job)  # the loop keeps no reference of its own
            job.add_done_callback(self._jobs.discard)

    async def _localize_batch(self, worker: _Worker, batch: list[_Waiting]) -> None:
        loop = asyncio.get_running_loop()
        try:
            answers = await loop.run_in_executor(self._threads, worker.ask, [each.task for each in batch])
        except WorkerLostError as error:
            self.replaced += 1
            loop.run_in_executor(self._threads, self._replace, worker, loop)
            for each in reversed(batch):
                each.lost += 1
                if each.lost < _TRIES:
                    self._waiting.appendleft(each)
                elif not each.answer.done():
                    each.answer.set_exception(error)
        else:
            self._idle.append(worker)
            for each, answer in zip(batch, answers, strict=True):
                if not each.answer.done():  # its client may have gone
                    each.answer.set_result(answer)
        self._hand_out()

    def _is_ready(self, worker: _Worker) -> None:
        self._idle.append(worker)
        self._hand_out()

    def _replace(self, worker: _Worker, loop: asyncio.AbstractEventLoop) -> None:
        with suppress(RuntimeError):  # the loop has ended
            while not worker.is_stopped:
                try:
                    worker.start()
                except WorkerLostError:  # killed while it started
                    continue
                loop.call_soon_threadsafe(self._is_ready, worker)
                return


class _Worker:
    """A process, and the pipe to it; used by one thread at a time."""

    def __init__(self, bundles: Mapping[str, Path], seconds: float) -> None:
        self.bundles, self.seconds, self.is_stopped = dict(bundles), seconds, False
        self.process: Any = None
        self.pipe: Connection | None = None

    def start(self) -> None:
        """Start the process, and wait until its bundles are loaded."""
        context = get_context("spawn")  # a fork would copy the server's threads and sockets
        self.pipe, theirs = context.Pipe()
        process = context.Process(target=_work, args=(theirs, self.bundles), daemon=True)
        with _environment(_ENVIRONMENT):
            process.start()
        self.process = process  # one that has not started cannot be killed
        theirs.close()  # so that the end of the process ends the pipe
        if self.is_stopped:
            raise self._lost()
        self._receive(_START_S)

    def ask(self, tasks: list[Task]) -> list[Answer]:
        """Have tasks done."""
        assert self.pipe is not None
        try:
            self.pipe.send(tasks)
        except OSError:
            raise self._lost() from None
        return self._receive(self.seconds * len(tasks))

    def stop(self) -> None:
        """End the process."""
        self.is_stopped = True
        if self.process is not None:
            self._lost()

    def _receive(self, seconds: float) -> list[Answer]:
        assert self.pipe is not None
        try:
            if self.pipe.poll(seconds):
                return self.pipe.recv()
        except (OSError, EOFError):
            pass
        raise self._lost()

    def _lost(self) -> WorkerLostError:
        self.process.kill()
        self.process.join()
        return WorkerLostError(f"worker {self.process.pid}: died, or took over {self.seconds:g} s")


_starting = threading.Lock()


@contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Give a process that is started its environment; ``multiprocessing`` has no option for it."""
    with _starting:
        before = {name: os.environ.get(name) for name in variables}
        os.environ.update(variables)
        try:
            yield
        finally:
            for name, value in before.items():
                os.environ.pop(name) if value is None else os.environ.update({name: value})


def _work(pipe: Connection, bundles: Mapping[str, Path]) -> None:
    """What a worker does: answer tasks, one after another, until the server ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the server's
    warnings.simplefilter("always")
    localizers = {name: Localizer(path, threads=1) for name, path in bundles.items()}
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        pipe.send([])
        while True:
            tasks = pipe.recv()
            pipe.send(_answers(localizers[tasks[0].bundle], tasks))
    sys.exit()


def _answers(localizer: Localizer, tasks: list[Task]) -> list[Answer]:
    """Localize images together; each alone, if one of them cannot be, so that it alone is refused."""
    images = [decode_image(task.image) for task in tasks]
    answers: list[Answer] = []
    try:
        if rule := next((image for image in images if isinstance(image, str)), None):
            raise InputError(rule)
        found = localizer.localize_batch(images, [task.intrinsics for task in tasks], tasks[0].is_distorted)
        for task in tasks:
            with warnings.catch_warnings(record=True) as caught:
                pose = next(found)
            answer = {"bundle": task.bundle, "scene": pose.scene or localizer.scene, **pose_of(pose)}
            answers.append(answer | ({"warnings": [str(each.message) for each in caught]} if caught else {}))
    except InputError as error:
        return [{"error": str(error)}] if len(tasks) == 1 else [_answers(localizer, [task])[0] for task in tasks]
    return answers


def pose_of(found: Localization) -> Answer:
    """A localization for JSON; null where nothing is known."""
    covariance = None if found.covariance is None else found.covariance.tolist()
    return {
        "position_m": _finite(found.position_m.tolist()),
        "quaternion_wxyz": _finite(found.quaternion.tolist()),
        "position_radius_m": found.position_radius_m,
        "rotation_radius_deg": found.rotation_radius_deg,
        "unfamiliarity": found.unfamiliarity,
        "source": found.source,
        "is_accepted": found.is_accepted,
        "is_unfamiliar": found.is_unfamiliar,
        "scene_probability": found.scene_probability,
        "inliers": found.inliers,
        "covariance": covariance,
        "latency_ms": round(1000 * found.latency_s, 3),
    }


def _finite(values: list[float]) -> list[float] | None:
    return values if all(map(math.isfinite, values)) else None
