"""Recipes that train in seconds."""

from pathlib import Path

import yaml

TINY_BACKBONE = "test_efficientnet"
"""timm's own network for tests: 82,000 parameters, feature maps at strides 2 to 32."""

TINY_MAMBALOC = {
    "backbone": TINY_BACKBONE, "dim": 16, "heads": 2, "encoder_layers": 1, "feedforward": 16, "head_hidden": 16,
    "lr": 0.001, "lr_step_epochs": 2, "normalise_position": True,
}  # fmt: skip

TWO_SCENES = ["heads", "lab"]
LAB_OFFSET_M = (500_000.0, 4_000_000.0, 30.0)
"""Where the lab's frame lies in its world."""


def write_recipe(path: Path, scenes: Path, model: dict, data: dict, **trainer) -> Path:
    """Write a recipe that trains a system on ``scenes``."""
    recipe = {
        "model": model,
        "data": {"root": str(scenes), "scene": "heads", "image_size": 32, "short_side": 36, "batch_size": 4, **data},
        "trainer": {"accelerator": "cpu", **trainer},
        "onnx_export": {"enabled": False},
    }
    path.write_text(yaml.safe_dump(recipe))
    return path
