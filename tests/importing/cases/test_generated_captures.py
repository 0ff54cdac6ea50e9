"""Captures of mixed kinds, names, clocks, encodings, origins, orientation tags and sizes: none is read wrongly.

``python tools/benchmarks/captures.py`` tries 500.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[3] / "tools" / "benchmarks"))

from captures_read import count_one
from captures_written import KINDS


@pytest.mark.parametrize("seed", range(10_000, 10_000 + 2 * len(KINDS)))
def test_what_was_written_is_read(tmp_path, seed):
    kind, counts, said = count_one(seed, tmp_path)
    assert (said, counts["silent"]) == ("", 0), kind
    assert counts["read"] == counts["equal"] == counts["should"] > 0, kind
