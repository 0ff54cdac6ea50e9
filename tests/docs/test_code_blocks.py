"""Every code block of the pages runs, in the order of its page, or the page or ``NOT_RUN`` says why not."""

import inspect
import json
import re
import tomllib
from collections.abc import Sequence
from pathlib import Path

import pytest
import test_tutorials
from doc_blocks import PAGES, Block, blocks, count_of_marks, shell_commands

from mambaloc.cli import main as train
from mambaloc.sweep import read_sweep

NOT_RUN = {
    r"pip install": "installs",
    r"git clone|cd |python -m venv|source ": "is the shell's",
    r"mambaloc (export|map) ": "takes a quarter of a minute; tests/export, tests/mapping",
    r"mambaloc (demo|serve)": "serves until Ctrl-C; tests/demo and tests/serving",
    r"mambaloc download \w": "downloads; tests/data/download",
    r"mambaloc sweep run (?!.*--dry-run)": "trains; tests/sweep",
    r"mambaloc sweep report": "needs the results of a sweep; tests/sweep",
    r"mambaloc import (drive|film)": "needs a bag, or minutes of structure from motion; tests/bags, tests/importing",
    r"mambaloc \w+ .*(drive2|--rerun)": "needs a bag, or Rerun; tests/bags and tests/evaluation",
    r"mambaloc visualize (heatmaps|features|cumulative) [A-Z]+\.ckpt": "needs several trainings; tests/viz",
    r"python tools/benchmarks/": "measures for minutes; tests/tools",
    r"curl |rerun |srun ": "needs a server, a window or a cluster",
}
"""Beginnings of commands, and why they are not run."""

PARSED = r"mambaloc train "
"""Trainings take minutes: their recipes and options go through their own parser."""

ALL = [block for page in PAGES for block in blocks(page)]


@pytest.mark.parametrize(
    "page", [page for page in PAGES if any(b.runs_here for b in blocks(page))], ids=lambda p: p.name
)
def test_code_blocks_run(page, workspace, mambaloc, capsys):
    names: dict[str, object] = {"__name__": "__main__"}
    for block in filter(lambda block: block.runs_here, blocks(page)):
        _save(block)
        if block.language == "python":
            exec(compile(block.text, str(block), "exec"), names)
        elif block.language == "bash":
            for words in shell_commands(block):
                _run(words, block, mambaloc)
        else:
            _PARSERS[block.language](block)


def _save(block: Block) -> None:
    """Write the block into the file that the page names above it: ```name.yaml`:``."""
    lines = block.page.read_text(encoding="utf-8").splitlines()
    if named := re.search(r"`([\w.]+)`:$", "\n".join(lines[: block.line - 1]).rstrip()):
        Path(named[1]).write_text(block.text, encoding="utf-8")


def _run(words: list[str], block: Block, mambaloc) -> None:
    command = " ".join(words)
    if re.match(PARSED, command):
        _parse_training(words[2:])
    elif not _reasons(command):
        assert words[0] == "mambaloc", f"{block}: {command}: run it, or give a reason"
        mambaloc(*words[1:])


def _reasons(command: str) -> list[str]:
    return [beginning for beginning in NOT_RUN if re.match(beginning, command)]


def _check_yaml(block: Block) -> None:
    """Read a sweep as ``mambaloc sweep`` does, and the recipes and options of its trainings as ``train`` does."""
    path = Path(f"block_{block.line}.yaml")
    path.write_text(block.text, encoding="utf-8")
    for trial in read_sweep(path).trials:
        if trial.labels.get("seed", "0") == "0":
            _parse_training(trial.args)


def _parse_training(args: Sequence[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        train([*args, "--print_config"])
    assert not ended.value.code, args


_PARSERS = {
    "yaml": _check_yaml,
    "toml": lambda block: tomllib.loads(block.text),
    "json": lambda block: json.loads(block.text),
}


def test_marks_stand_above_blocks_and_name_tests_that_exist():
    for page in PAGES:
        marked = [block for block in blocks(page) if block.not_run or block.run_by]
        assert len(marked) == count_of_marks(page), f"{page.name}: a mark stands above no block"
        for block in marked:
            assert block.language, f"{block}: is an output, which needs no mark"
            if block.run_by:
                test = getattr(test_tutorials, block.run_by)
                assert block.page.name in inspect.getsource(test), f"{block}: {block.run_by} reads another page"


def test_reasons_are_needed():
    """Each beginning of ``NOT_RUN`` is that of a command in a block that runs here."""
    given = [
        " ".join(words)
        for block in ALL
        if block.runs_here and block.language == "bash"
        for words in shell_commands(block)
    ]
    assert {reason for command in given for reason in _reasons(command)} == set(NOT_RUN)
