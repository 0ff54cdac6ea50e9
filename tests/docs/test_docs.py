"""README and docs: commands and options exist, links lead somewhere. test_code_blocks.py runs the blocks."""

import importlib
import re

import jsonargparse
import pytest
from doc_blocks import PAGES, README, blocks, shell_commands

from mambaloc import commands
from mambaloc.console import OptionParser


def test_the_readme_is_two_screens():
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 120


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_files_and_headings(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if "://" in target:
            continue
        path, _, heading = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), target
        if heading:
            titles = re.findall(r"^#+ (.*)$", file.read_text(encoding="utf-8"), re.MULTILINE)
            assert heading in {re.sub(r"[^\w\- ]", "", title).strip().lower().replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_and_their_options_exist(page):
    """Of blocks that are not run, too."""
    for block in blocks(page, "bash"):
        for words in shell_commands(block):
            if words[0] != "mambaloc" or words[1] == "train":  # test_code_blocks.py parses trainings
                continue
            assert words[1] in commands._MODULES, words
            options = [word.partition("=")[0] for word in words if word.startswith("--")]
            known = _options_of(commands._MODULES[words[1]][0])
            assert set(options) <= known, (words, known)


class _ParserError(Exception):
    pass


def _options_of(module: str) -> set[str]:
    """Every option of a command, its subcommands' among them."""

    def stop(parser, *_, **__):
        raise _ParserError(parser)

    with pytest.MonkeyPatch.context() as patch:
        for parser in (OptionParser, jsonargparse.ArgumentParser):
            patch.setattr(parser, "parse_args", stop)
        with pytest.raises(_ParserError) as caught:
            importlib.import_module(f"mambaloc.commands.{module}").main()
    parsers, options = [caught.value.args[0]], set()
    while parsers:
        for action in parsers.pop()._actions:
            options |= set(action.option_strings)
            if isinstance(action.choices, dict):  # subcommands
                parsers += action.choices.values()
    return options
