"""What users get: the wheel and the sdist, and an installation of the wheel without extras, so without PyTorch."""

import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.nightly  # builds, and downloads what the wheel requires

ROOT = Path(__file__).parents[1]
ELSEWHERE = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}


def run(*command, cwd):
    """Run a command that finds nothing of the checkout, and return what it prints."""
    ended = subprocess.run(list(map(str, command)), cwd=cwd, env=ELSEWHERE, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout


def files_below(*folders):
    """What git has below folders of the checkout, by their paths there."""
    return set(subprocess.check_output(["git", "ls-files", *folders], cwd=ROOT, text=True).splitlines())


@pytest.fixture(scope="session")
def built(shared_folder):
    """The folder of both; the wheel is made of the sdist alone."""
    return shared_folder(
        "dist", lambda folder: run(sys.executable, "-m", "build", "--outdir", folder, ROOT, cwd=folder)
    )


@pytest.fixture(scope="session")
def wheel(built):
    (path,) = built.glob("*.whl")
    return path


@pytest.fixture(scope="session")
def installed(shared_folder, wheel):
    """The ``bin`` of an environment of its own, with the wheel and what it requires."""

    def install(folder):
        run(sys.executable, "-m", "venv", folder / "venv", cwd=folder)
        run(folder / "venv/bin/pip", "install", "--quiet", wheel, cwd=folder)

    return shared_folder("installed", install) / "venv/bin"


def test_the_wheel_has_the_package_recipes_and_released_models_and_no_more(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
    shipped = {f"mambaloc/shipped/{name}" for name in files_below("recipes", "zoo")}
    assert names == (files_below("mambaloc") - {"mambaloc/demo/page.jpg"}) | shipped
    assert {"mambaloc/py.typed", "mambaloc/demo/web/index.html", "mambaloc/sweep/paper.yaml"} <= names


def test_the_sdist_has_what_the_wheel_is_made_of_and_no_tests(built):
    (path,) = built.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    of_the_build = {"PKG-INFO", "pyproject.toml", ".gitignore"}
    to_read = {"README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff"}
    packed = files_below("mambaloc", "recipes", "zoo") - {"mambaloc/demo/page.jpg"}
    assert names == packed | of_the_build | to_read


def test_an_index_takes_both(built):
    out = run(sys.executable, "-m", "twine", "check", "--strict", *built.iterdir(), cwd=built)
    assert out.count("PASSED") == 2


def test_an_installation_has_no_torch_and_lists_what_it_brings(installed, tmp_path):
    out = run(
        installed / "python",
        "-c",
        "from importlib.util import find_spec; from mambaloc.recipes import list_recipes, recipe_path\n"
        "print(find_spec('torch')); print(*list_recipes()); print(recipe_path('overlays/gis').read_text())",
        cwd=tmp_path,
    )
    torch, recipes, overlay = out.split("\n", 2)
    assert torch == "None"
    expected = {name.removeprefix("recipes/") for name in files_below("recipes/*.yaml") if "/sweeps/" not in name}
    assert {f"{name}.yaml" for name in recipes.split()} == expected
    assert overlay.strip() == (ROOT / "recipes/overlays/gis.yaml").read_text().strip()


def test_an_installation_localises(installed, bundle_of_pictures, map_of_den, den, tmp_path):
    pictures = den / "den/seq-02"
    assert "  localize " in run(installed / "mambaloc", "--help", cwd=tmp_path)
    for name, source in (("network", bundle_of_pictures), ("map", map_of_den)):
        run(installed / "mambaloc", "localize", source, pictures, "--out", f"{name}.tum", cwd=tmp_path)
        lines = [line for line in (tmp_path / f"{name}.tum").read_text().splitlines() if not line.startswith("#")]
        assert len(lines) == 6


def test_an_installation_says_what_training_needs(installed, tmp_path):
    command = [installed / "mambaloc", "train", "quickstart"]
    ended = subprocess.run(command, cwd=tmp_path, env=ELSEWHERE, capture_output=True, text=True, check=False)
    expected = "error: mambaloc train needs PyTorch, which is not installed. Run: pip install 'mambaloc[train]'\n"
    assert (ended.returncode, ended.stderr) == (2, expected)


def test_released_models_are_found_in_any_folder(wheel, tmp_path):
    """As ``pip install --target`` leaves it, beside this environment's PyTorch."""
    run(sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", tmp_path / "a", wheel, cwd=tmp_path)
    program = (
        f"import sys; sys.path.insert(0, {str(tmp_path / 'a')!r})\n"
        "import mambaloc; print(mambaloc.__file__); print(*mambaloc.list_released())\n"
        "print(type(mambaloc.create_model('student.embedded_room', pretrained=True)).__name__)"
    )
    where, *said = run(sys.executable, "-c", program, cwd=tmp_path).splitlines()
    assert where == str(tmp_path / "a/mambaloc/__init__.py")
    assert said == [" ".join(sorted(path.name for path in (ROOT / "zoo").iterdir() if path.is_dir())), "LitStudent"]
