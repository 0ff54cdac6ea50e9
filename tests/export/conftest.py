"""A network is converted to ONNX once: the conversion costs seconds, what is made of it and checked on it does not."""

import hashlib
import shutil

import pytest

from mambaloc.export import onnx as onnx_module

_convert = onnx_module._write


@pytest.fixture(scope="module")
def converted_once(shared_folder):
    """A network that is exported again, with the same contract, gets the same file; its parity is checked again."""

    def write(deployed, contract, path):
        name = "onnx " + hashlib.sha256(contract.to_json().encode()).hexdigest()  # has the weights' own digest in it
        made = shared_folder(name, lambda folder: _convert(deployed, contract, folder / "model.onnx"))
        shutil.copyfile(made / "model.onnx", path)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(onnx_module, "_write", write)
        yield
