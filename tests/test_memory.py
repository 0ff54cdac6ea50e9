import subprocess
import sys

import pytest

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
