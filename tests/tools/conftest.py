"""The scripts of tools/benchmarks can be imported, as they import each other."""

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[2] / "tools/benchmarks"))


@pytest.fixture
def tool(monkeypatch):
    """Run a script of tools/benchmarks by its name with arguments, as from a shell."""
    import runpy

    def run(name, *args):
        monkeypatch.setattr(sys, "argv", [name, *map(str, args)])
        runpy.run_path(str(Path(__file__).parents[2] / "tools/benchmarks" / f"{name}.py"), run_name="__main__")

    return run
