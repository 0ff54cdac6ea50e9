"""The public names: a change here is a change that users see, and needs a line in the changelog."""

import subprocess
import sys

import pytest

import mambaloc
from mambaloc.errors import InputError

PUBLIC = {
    "LitMambaLoc", "PoseDataModule", "__version__", "create_model", "create_transform", "list_models", "list_released",
    "load",
}  # fmt: skip


def test_the_packages_names_are_these_and_each_is_there():
    assert set(mambaloc.__all__) == PUBLIC
    assert set(dir(mambaloc)) == PUBLIC
    assert all(getattr(mambaloc, name) is not None for name in PUBLIC)


def test_names_are_listed_without_torch():
    code = "import sys, mambaloc; dir(mambaloc); sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_without_torch_a_name_says_what_to_install():
    code = "import sys, mambaloc; sys.modules['torch'] = None; mambaloc.load"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ended.stderr.endswith("mambaloc.load needs PyTorch. Run: pip install 'mambaloc[train]'\n")


@pytest.mark.parametrize(
    ("pattern", "systems"),
    [("student.*", ["student"]), ("*loc.*", ["atloc", "denseloc", "mambaloc"]), ("nothing*", [])],
)
def test_released_models_are_listed_by_wildcard(pattern, systems):
    names = mambaloc.list_models(pattern, pretrained=True)
    assert names == [f"{system}.embedded_room" for system in systems]
    assert set(names) <= set(mambaloc.list_models("*", pretrained=True))
    assert mambaloc.list_models("*", pretrained=True) == mambaloc.list_released()


def test_a_released_model_is_created_with_its_weights():
    model = mambaloc.create_model("student.embedded_room", pretrained=True)
    loaded = mambaloc.load("student.embedded_room").state_dict()
    assert not model.training
    assert all((value == loaded[name]).all() for name, value in model.state_dict().items())


def test_a_released_model_keeps_its_hyperparameters():
    with pytest.raises(InputError, match=r"keeps its hyperparameters\. Leave out width"):
        mambaloc.create_model("student.embedded_room", pretrained=True, width=8)


def test_an_architecture_has_no_weights_of_its_own():
    with pytest.raises(InputError, match=r"student: no such model. Did you mean student.embedded_room\?"):
        mambaloc.create_model("student", pretrained=True)
