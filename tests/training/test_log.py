"""What a training says on stderr, by the package's logger."""

import logging

import pytest

from mambaloc.callbacks import OnnxExport
from mambaloc.cli import main


@pytest.mark.slow
def test_the_reason_of_no_uncertainty_is_shown_on_stderr(tiny_recipe, tmp_path, capsys):
    """Guess: Lightning's loggers being at WARNING does not silence ours, whose parent is the root logger."""
    run = tmp_path / "run"
    options = ["--data.validation", "none", "--onnx_export.enabled", "true", "--trainer.max_epochs", "1"]
    main([str(tiny_recipe), *options, "--trainer.default_root_dir", str(run)])
    output = capsys.readouterr()
    lines = [line for line in output.err.splitlines() if line.startswith(f"{run / 'model.onnx'}: within ")]
    assert len(lines) == 1
    assert "of PyTorch, without uncertainty: " in lines[0]
    assert "model.onnx: within" not in output.out


def test_the_loggers_are_children_of_the_packages():
    logger = logging.getLogger(OnnxExport.__module__)
    while logger.parent is not logging.root:
        logger = logger.parent
    assert logger.name == "mambaloc"
