"""What a training says on stderr, by the package's logger."""

import logging

import pytest

from mambaloc.callbacks import OnnxExport
from mambaloc.cli import main


@pytest.mark.slow
def test_the_reason_of_no_uncertainty_is_shown_on_stderr(tiny_recipe, tmp_path, capsys):
    """Guesses: Lightning's loggers being at WARNING does not silence ours (right); nobody else's handler prints our
    lines (wrong: importing onnxruntime's tools gives the root logger one).
    """
    run = tmp_path / "run"
    options = ["--data.validation", "none", "--onnx_export.enabled", "true", "--trainer.max_epochs", "1"]
    main([str(tiny_recipe), *options, "--trainer.default_root_dir", str(run)])
    output = capsys.readouterr()
    lines = [line for line in output.err.splitlines() if f"{run / 'model.onnx'}: within " in line]
    assert len(lines) == 1
    assert "of PyTorch, without uncertainty: " in lines[0]
    assert "model.onnx: within" not in output.out


def test_the_loggers_are_children_of_the_packages():
    logger = logging.getLogger(OnnxExport.__module__)
    while logger.parent is not logging.root:
        logger = logger.parent
    assert logger.name == "mambaloc"
