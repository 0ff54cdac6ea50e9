"""README and docs: their Python runs, their commands exist, their links lead somewhere."""

import importlib
import re
import shlex
import subprocess
import sys
from pathlib import Path

import jsonargparse
import pytest
import torch
import yaml

from mambaloc import commands
from mambaloc.console import OptionParser

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
PAGES = [README, ROOT / "CONTRIBUTING.md", ROOT / "findings/README.md", *sorted((ROOT / "docs").glob("*.md"))]


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


def test_the_readme_is_two_screens():
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 120


def test_gis_goes_into_anyones_model():
    (example,) = [block for block in blocks(README, "python") if "GlobalInformationSelector" in block]
    names: dict[str, object] = {}
    exec(example, names)
    model = names["model"]
    logits = model(torch.rand(2, 3, 64, 64))
    assert logits.shape == (2, 10)
    logits.sum().backward()
    selector = next(m for m in model.modules() if isinstance(m, names["GlobalInformationSelector"]))
    assert all(p.grad is not None for p in selector.parameters())


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
def test_python_compiles(page):
    for block in blocks(page, "python"):
        compile(block, page.name, "exec")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_and_their_options_exist(page):
    for words in _commands_of(page):
        name, options = words[0], [word.partition("=")[0] for word in words if word.startswith("--")]
        assert name in commands._MODULES, words
        if name == "train":  # Lightning's own parser; test_recipes.py checks recipes
            continue
        known = _options_of(commands._MODULES[name][0])
        assert set(options) <= known, (words, known)


def _commands_of(page: Path) -> list[list[str]]:
    """The words of each command of ours, without the program's name."""
    modules = {module: name for name, (module, _) in commands._MODULES.items()}
    found = []
    for line in "\n".join(blocks(page, "bash")).replace("\\\n", " ").splitlines():
        for part in line.split(" #")[0].replace("...", "").split("&&"):
            words = shlex.split(part)
            if words[:1] == ["mambaloc"] and len(words) > 1:
                found.append(words[1:])
            elif words[:1] == ["python"] and re.fullmatch(r"tools/\w+\.py", words[1]):
                found.append([modules[Path(words[1]).stem], *words[2:]])
    return found


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


def test_a_system_of_another_package_trains_and_is_evaluated(tmp_path, den):
    """``docs/new_system.md``, as a reader follows it: a package with an entry point, a recipe, the command line."""
    page = ROOT / "docs/new_system.md"
    package = tmp_path / "package"
    package.mkdir()
    (package / "branchnet.py").write_text(blocks(page, "python")[0])
    about = package / "branchnet-1.0.dist-info"  # what pip writes of the page's pyproject.toml
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: branchnet\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[mambaloc.models]\nbranchnet = branchnet:LitBranchNet\n")
    assert 'branchnet = "branchnet:LitBranchNet"' in blocks(page, "toml")[0]

    recipe = yaml.safe_load(blocks(page, "yaml")[0])
    recipe["model"]["init_args"] |= {"backbone": "test_efficientnet", "width": 16}
    recipe["data"] = {"dataset": "7scenes", "root": str(den), "scene": "den", "image_size": 64, "short_side": 72}
    recipe["trainer"] = {"max_epochs": 1, "default_root_dir": str(tmp_path / "run")}
    (tmp_path / "branchnet.yaml").write_text(yaml.safe_dump(recipe))

    words = [
        ["train", str(tmp_path / "branchnet.yaml"), "--onnx_export.enabled", "false"],
        ["evaluate", str(tmp_path / "run/checkpoints/last.ckpt"), "--out", str(tmp_path / "results")],
    ]
    program = (
        f"import sys; sys.path[:0] = [{str(package)!r}, {str(ROOT)!r}]\n"
        "import mambaloc, mambaloc.commands as commands; print(mambaloc.list_models('branch*'))\n"
        f"for words in {words!r}: sys.argv = ['mambaloc', *words]; commands.main()"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.startswith("['branchnet']")
    assert (tmp_path / "results/metrics.json").is_file()
