"""The scripts of tools/benchmarks can be imported, as they import each other."""

import runpy
import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).parents[2] / "tools"
sys.path.append(str(TOOLS / "benchmarks"))


@pytest.fixture
def tool(monkeypatch):
    """Run ``tools/NAME.py`` with arguments, as from a shell."""

    def run(name, *args):
        monkeypatch.setattr(sys, "argv", [name, *map(str, args)])
        runpy.run_path(str(TOOLS / f"{name}.py"), run_name="__main__")

    return run
