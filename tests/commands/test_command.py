"""The command ``mambaloc`` leads to its subcommands, and recipes are found by name."""

import subprocess
import sys
import tomllib
from importlib import import_module
from pathlib import Path

import pytest

from mambaloc import commands, recipes
from mambaloc.errors import InputError

ROOT = Path(__file__).parents[2]


def run(monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["mambaloc", *words])
    commands.main()


def test_every_subcommand_has_a_module_and_a_script():
    modules = {path.stem for path in (ROOT / "mambaloc/commands").glob("*.py")} - {"__init__"}
    assert modules == {module for module, _ in commands._MODULES.values()}
    assert modules == {path.stem for path in (ROOT / "tools").glob("*.py")}
    for module in modules:
        assert callable(import_module(f"mambaloc.commands.{module}").main)


def test_a_subcommand_runs_under_its_own_name(monkeypatch, capsys):
    with pytest.raises(SystemExit, match="0"):
        run(monkeypatch, "verify", "--help")
    assert capsys.readouterr().out.startswith("usage: mambaloc verify [-h]")
    with pytest.raises(SystemExit, match="2"):
        run(monkeypatch, "verify", "nowhere")
    assert "nowhere" in capsys.readouterr().err


def test_the_list_of_commands_needs_no_torch():
    listed = (
        "import sys; from mambaloc import commands; sys.argv = ['']; commands.main(); print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", listed], capture_output=True, text=True, check=True, cwd=ROOT)
    assert "  train        train a recipe\n  evaluate     measure" in done.stdout
    assert done.stdout.endswith("False\n")


def test_the_module_runs_as_the_command_does():
    """Guess: argparse would name the program ``__main__.py``; every subcommand names itself by ``sys.argv``."""
    for words in (["--help"], ["verify", "--help"]):
        script = f"import sys; sys.argv = ['mambaloc', *{words}]; from mambaloc.commands import main; main()"
        ended = [
            subprocess.run([sys.executable, *how], capture_output=True, text=True, check=True, cwd=ROOT).stdout
            for how in (["-m", "mambaloc", *words], ["-c", script])
        ]
        assert ended[0] == ended[1]
        assert ended[0].startswith("usage: mambaloc ")


def test_the_version_is_that_of_the_distribution_and_needs_no_torch():
    blocked = "import sys; sys.modules['torch'] = None; sys.argv = ['mambaloc', '--version']\n"
    program = blocked + "from mambaloc.commands import main; main()"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT)
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert (done.stdout, done.stderr) == (f"mambaloc {stated}\n", "")


@pytest.mark.parametrize(
    ("word", "hint"), [("trian", "no such command. Did you mean train?"), ("x", "Choose one of train, eval")]
)
def test_an_unknown_command(word, hint, monkeypatch, capsys):
    with pytest.raises(SystemExit, match="2"):
        run(monkeypatch, word)
    assert hint in capsys.readouterr().err


def test_recipes_by_name(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert recipes.recipe_path("quickstart") == ROOT / "recipes/quickstart.yaml"
    assert recipes.recipe_path("recipes/overlays/gis.yaml") == ROOT / "recipes/overlays/gis.yaml"
    (tmp_path / "quickstart").write_text("model: {}")
    assert recipes.recipe_path("quickstart") == Path("quickstart")  # a file of the user's comes first
    with pytest.raises(InputError, match=r"^quikstart: no such recipe\. Did you mean quickstart\?$"):
        recipes.recipe_path("quikstart")
    assert {"quickstart", "my_scene", "overlays/gis"} <= set(recipes.list_recipes())
