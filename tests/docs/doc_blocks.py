"""The fenced code blocks of the pages, and the commands in them.

A block runs unless a comment of the page stands above it: ``<!-- not run: WHY -->``, or ``<!-- run by: TEST -->`` for
one that a test of its own runs. A block without a language is an output or a drawing.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mambaloc import commands

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
PAGES = [README, ROOT / "CONTRIBUTING.md", ROOT / "findings/README.md", *sorted((ROOT / "docs").glob("*.md"))]

_MARK = re.compile(r"<!-- (not run|run by): (.+?) -->")
_MODULES = {module: name for name, (module, _) in commands._MODULES.items()}


@dataclass(frozen=True)
class Block:
    """A fenced block.

    Args:
        page: its file.
        line: of its first fence, counted from 1.
        language: empty for an output.
        text: what is between the fences.
        not_run: why it is not run, if so.
        run_by: name of the test that runs it, if it has one.
    """

    page: Path
    line: int
    language: str
    text: str
    not_run: str | None
    run_by: str | None

    @property
    def runs_here(self) -> bool:
        """Whether the page's own test runs it."""
        return bool(self.language) and self.not_run is None and self.run_by is None

    def __str__(self) -> str:
        return f"{self.page.name}:{self.line}"


def blocks(page: Path, language: str | None = None) -> list[Block]:
    """The blocks of a page, of one language or of all."""
    found, opened, mark = [], None, None
    lines = page.read_text(encoding="utf-8").splitlines()
    for number, line in enumerate(lines, start=1):
        if not line.startswith("```"):
            continue
        if opened is None:
            opened, mark = number, _MARK.fullmatch(lines[number - 2])
            continue
        marks = {mark[1]: mark[2]} if mark else {}
        text = "".join(f"{each}\n" for each in lines[opened : number - 1])
        found.append(
            Block(page, opened, lines[opened - 1].removeprefix("```"), text, marks.get("not run"), marks.get("run by"))
        )
        opened = None
    assert opened is None, f"{page}:{opened}: the block does not end"
    return [block for block in found if language in (None, block.language)]


def count_of_marks(page: Path) -> int:
    """How many comments of a page look like marks, wherever they stand."""
    return len(re.findall(r"<!--\s*(?:not run|run by)", page.read_text(encoding="utf-8")))


def shell_commands(block: Block) -> Iterator[list[str]]:
    """The words of each command of a bash block; a tool of ours as ``mambaloc NAME``."""
    for line in block.text.replace("\\\n", " ").splitlines():
        for part in re.sub(r"(^|\s)#.*", "", line).replace("...", "").split("&&"):
            words = shlex.split(part)
            if words[:1] == ["python"] and re.fullmatch(r"tools/\w+\.py", words[1]):
                words = ["mambaloc", _MODULES[Path(words[1]).stem], *words[2:]]
            if words:
                yield words
