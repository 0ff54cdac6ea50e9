"""Load a server of poses with hey, and compare it with a plain loop over Localizer.localize in the same run.

python tools/benchmarks/serving.py BUNDLE IMAGE [--requests 100000] [--kills 20]

Then so many requests from 16 clients, during which worker processes are killed: what was lost, and the memory.
hey is a load generator: github.com/rakyll/hey, or Debian's package of that name.
"""

from __future__ import annotations

import csv
import io
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mambaloc import provenance
from mambaloc.benchmark.footprint import proc_value
from mambaloc.console import OptionParser, exit_on_input_error, whole_number
from mambaloc.errors import InputError
from mambaloc.images import decode_image
from mambaloc.runtime import Localizer

CLIENTS = (1, 16)
_SECONDS = 10
_SERVE = "from mambaloc.commands.serve import main; main()"


@dataclass(frozen=True)
class Load:
    """What clients saw.

    Args:
        per_second: requests answered with a pose.
        p50_ms: of the time that a request took.
        p99_ms: its 99 % quantile.
        status: how often each status was answered; requests without an answer are not among them.
    """

    per_second: float
    p50_ms: float
    p99_ms: float
    status: Counter[int]


@exit_on_input_error
def main() -> None:
    """Measure and print."""
    parser = OptionParser(description=__doc__)
    parser.add_argument("bundle", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--workers", type=whole_number(1, 256), default=2)
    parser.add_argument("--requests", type=whole_number(1), default=100_000)
    parser.add_argument("--kills", type=whole_number(0), default=20)
    args = parser.parse_args()
    if shutil.which("hey") is None:
        raise InputError("hey: is not on the path. Install it: apt install hey, or github.com/rakyll/hey.")
    print(provenance.machine())
    for threads in (1, None):
        each = "1 thread" if threads else "ONNX Runtime's own threads"
        print(f"a loop over Localizer.localize, {each}: {loop_per_second(args.bundle, args.picture, threads):.1f}/s")
    with served(args.bundle, args.workers) as (server, url):
        for clients in CLIENTS:
            load = under_load(url, args.picture, clients, seconds=_SECONDS)
            print(f"{clients} clients: {in_words(load)}", flush=True)
        every_s = 0.8 * args.requests / load.per_second / (args.kills + 1)  # less, as the load may go faster
        with killing(server, args.kills, every_s) as (killed, memory_mib):
            load = under_load(url, args.picture, CLIENTS[-1], requests=args.requests)
        lost = args.requests - load.status[200]
        print(f"{args.requests} requests, {len(killed)} workers killed: {in_words(load)}; {lost} lost")
        print(f"memory of server and workers, in turn: {', '.join(f'{each:.0f}' for each in memory_mib)} MiB")


def loop_per_second(bundle: Path, path: Path, threads: int | None) -> float:
    """Images that a loop decodes and localizes in a second."""
    localizer, data = Localizer(bundle, threads), path.read_bytes()
    counts: list[float] = []
    began = time.perf_counter()
    while time.perf_counter() - began < _SECONDS / 2:
        image = decode_image(data)
        if isinstance(image, str):
            raise InputError(f"{path}: {image}. Give another.")
        localizer.localize(image)
        counts.append(time.perf_counter())
    half = counts[len(counts) // 5 :]  # once everything is warm
    return (len(half) - 1) / (half[-1] - half[0])


@contextmanager
def served(bundle: Path, workers: int) -> Iterator[tuple[int, str]]:
    """A server of a bundle, once it answers, and the address to send images to."""
    command = [sys.executable, "-c", _SERVE, str(bundle), "--port", "0", "--workers", str(workers)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        url = process.stdout.readline().split(" ")[0]
        if not url.startswith("http"):
            raise InputError(f"{bundle}: is not served. See above.")
        while not _is_up(url):
            time.sleep(0.1)
        try:
            yield process.pid, url
        finally:
            process.send_signal(signal.SIGINT)


def _is_up(url: str) -> bool:
    try:
        with urllib.request.urlopen(url.split("/localize")[0] + "/health", timeout=5) as answer:
            return answer.status == 200
    except OSError:
        return False


def under_load(url: str, image: Path, clients: int, seconds: float = 0, requests: int = 0) -> Load:
    """Send an image again and again, for so long or so often."""
    amount = ["-n", str(requests // clients * clients)] if requests else ["-z", f"{seconds}s"]
    command = ["hey", *amount, "-c", str(clients), "-m", "POST", "-D", str(image), "-t", "60", "-o", "csv", url]
    began = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    took_s = time.perf_counter() - began
    rows = list(csv.DictReader(io.StringIO(done.stdout)))
    if not rows:
        raise InputError(f"{url}: hey got no answer ({done.stderr[:200]}).")
    status = Counter(int(row["status-code"]) for row in rows)
    p50, p99 = np.quantile([1000 * float(row["response-time"]) for row in rows], (0.5, 0.99)).tolist()
    return Load(status[200] / took_s, p50, p99, status)


@contextmanager
def killing(server: int, kills: int, every_s: float) -> Iterator[tuple[list[int], list[float]]]:
    """Kill a worker at regular times, in turn, until so many are; note the memory each time, and on to the end."""
    killed: list[int] = []
    memory_mib: list[float] = []
    is_over = threading.Event()

    def kill() -> None:
        while not is_over.wait(every_s):
            workers = workers_of(server)
            memory_mib.append(sum(resident_mib(each) for each in (server, *workers)))
            if len(killed) < kills:
                os.kill(workers[len(killed) % len(workers)], signal.SIGKILL)
                killed.append(workers[len(killed) % len(workers)])

    thread = threading.Thread(target=kill)
    thread.start()
    try:
        yield killed, memory_mib
    finally:
        is_over.set()
        thread.join()


def workers_of(server: int) -> list[int]:
    """Process numbers of a server's workers, on Linux."""
    children = [
        int(word) for task in Path(f"/proc/{server}/task").iterdir() for word in (task / "children").read_text().split()
    ]
    return sorted(each for each in children if b"spawn_main" in Path(f"/proc/{each}/cmdline").read_bytes())


def resident_mib(process: int) -> float:
    """Resident memory of a process, in MiB; 0 of one that has ended."""
    try:
        return proc_value(Path(f"/proc/{process}/status"), "VmRSS:") / 1024
    except OSError:
        return 0.0


def in_words(load: Load) -> str:
    """A load in a line."""
    status = ", ".join(f"{count} of status {code}" for code, count in sorted(load.status.items()))
    return f"{load.per_second:.1f}/s, p50 {load.p50_ms:.1f} ms, p99 {load.p99_ms:.1f} ms ({status})"


if __name__ == "__main__":
    main()
