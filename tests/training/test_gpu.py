"""What only a CUDA device can show."""

from pathlib import Path

import pytest
import torch

from mambaloc.cli import main

REPOSITORY = Path(__file__).parents[2]


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_gpu_overlay_trains(tiny_recipe, tmp_path):
    overlay = REPOSITORY / "recipes/overlays/gpu.yaml"
    cli = main([str(tiny_recipe), str(overlay), "--trainer.default_root_dir", str(tmp_path / "run")])
    assert cli.trainer.callback_metrics["val/position_error_m"].isfinite()
    assert (tmp_path / "run/evaluation/last/metrics.json").is_file()
