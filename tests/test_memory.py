import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mambaloc.memory import release_pages

FAULTS = """
import resource, torch
from mambaloc.memory import keep_freed_memory
told = {told}
torch.set_num_threads(1)
def step():
    first, second = (torch.ones(2**22) for _ in range(2))  # 16 MiB each
    del first, second
for _ in range(12):  # until the heap has found its size, which takes some steps more or fewer by where it starts
    step()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    step()
print(told, resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def page_faults(told: str, **environment: str) -> tuple[bool, int]:
    command = [sys.executable, "-c", FAULTS.format(told=told)]
    said = subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout.split()
    return said[0] == "True", int(said[1])


@pytest.mark.skipif(sys.platform != "linux", reason="glibc's allocator is Linux's")
def test_freed_memory_is_used_again_without_a_page_fault():
    can, kept = page_faults("keep_freed_memory()")
    if not can:
        pytest.skip("this C library has no mallopt")
    # A fixed threshold of the least size, as glibc starts with, gives each block back.
    _, given_back = page_faults("False", MALLOC_MMAP_THRESHOLD_=str(2**17))
    assert kept < 100
    assert given_back > 20 * 2 * 16 * 2**20 / 2**21  # one fault a huge page at the least


@pytest.mark.skipif(sys.platform != "linux", reason="glibc's allocator is Linux's")
def test_a_users_own_setting_is_left_in_charge():
    assert page_faults("keep_freed_memory()", MALLOC_ARENA_MAX="1")[0] is False


def mapped_kib() -> int:
    """Memory of this process that is pages of files."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("RssFile"))


@pytest.mark.skipif(sys.platform != "linux", reason="read from /proc")
def test_pages_of_a_mapped_file_are_released_and_nothing_is_lost(tmp_path):
    shape = (64, 2**20)
    before = mapped_kib()
    written = np.lib.format.open_memmap(tmp_path / "pages.npy", mode="w+", dtype=np.uint8, shape=shape)
    written[:] = 7
    assert mapped_kib() - before > 60 * 1024
    release_pages(written[3:5])  # a slice stands for its file
    assert mapped_kib() - before < 4 * 1024
    assert (written[9] == 7).all()
    read = np.load(tmp_path / "pages.npy", mmap_mode="r")
    assert (read == 7).all()
    release_pages(read)
    assert mapped_kib() - before < 4 * 1024
    assert (read[5] == 7).all()


def test_other_arrays_are_left_alone(tmp_path):
    plain = np.arange(5)
    release_pages(plain)
    assert plain.tolist() == [0, 1, 2, 3, 4]
