"""Into a folder that cannot be written, or a file in its place: one line that names it, and nothing is touched."""

import ctypes
import struct
import sys
from pathlib import Path

import pytest
from attacked import assert_goes_on, assert_one_line, outcome_of
from subjects import SUBJECTS

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform != "linux", reason="root's rights are Linux's here")]

_CAPABILITIES_VERSION = 0x20080522


def read_only(below: Path) -> None:
    """Also for root, who gives up the right to write anywhere."""
    below.chmod(0o555)
    ctypes.CDLL(None).capset(struct.pack("Ii", _CAPABILITIES_VERSION, 0), bytes(24))


def a_file(below: Path) -> None:
    below.rmdir()
    below.write_text("mine")


# Each way to write has one of them in the gate: a file, a folder, the cache, Lightning's run, the store of a sweep.
SAME_WAY = ("export", "bundle", "publishing", "evaluation")
READ_ONLY = [
    pytest.param(read_only, name, marks=[pytest.mark.nightly] if name in SAME_WAY else [], id=f"read_only-{name}")
    for name in SUBJECTS
]


@pytest.mark.parametrize(("attack", "name"), [*READ_ONLY, *((a_file, name) for name in SUBJECTS)])
def test_no_folder_to_write_to(name, attack, inputs, tmp_path, tally):
    subject, out = SUBJECTS[name], tmp_path / "out"
    code, stderr, _ = outcome_of(subject, inputs, out, attack)
    assert code == 2
    assert_one_line(stderr)
    assert str(out) in stderr
    if attack is a_file:
        assert out.read_text() == "mine"
        out.unlink()
    else:
        assert not list(out.iterdir())
        out.chmod(0o755)
    tally(f"{name}: into {'a file' if attack is a_file else 'a read-only folder'}", "one line, exit code 2")
    assert_goes_on(subject, inputs, out)
