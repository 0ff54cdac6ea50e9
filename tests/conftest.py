"""Data that every test may use: a tiny rendered scene, and recipes small enough to train in seconds."""

import os

import pytest

if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # each worker a core of its own; read when torch is imported


@pytest.fixture(scope="session", autouse=True)
def cache_dir(tmp_path_factory):
    """A cache of the session's own, seen by subprocesses too: tests neither use nor fill the user's."""
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MAMBALOC_CACHE", str(folder))
        yield folder


@pytest.fixture(scope="session")
def scenes(tmp_path_factory):
    """A folder of rendered scenes in the 7-Scenes layout; ``heads`` has 2 x 12 training and 8 test frames."""
    from mambaloc.rendering.scenes.layouts import write_7scenes
    from mambaloc.rendering.scenes.shots import shots_of_sequences
    from mambaloc.rendering.trajectories import smooth_trajectory

    root = tmp_path_factory.mktemp("scenes")
    inside_m = ((-1.0, -1.0, 1.2), (1.0, 1.0, 1.6))
    sequences = {n: smooth_trajectory(8 if n == 3 else 12, seed=n, inside_m=inside_m) for n in (1, 2, 3)}
    write_7scenes(root, "heads", shots_of_sequences(sequences, {3}), size=(96, 72), depth=True)
    return root


@pytest.fixture
def tiny_recipe(scenes, tmp_path):
    """A recipe that trains on ``scenes`` in about a second an epoch; its runs go under ``tmp_path``."""
    recipe = tmp_path / "tiny.yaml"
    recipe.write_text(
        f"""
model:
  class_path: LitMambaLoc
  init_args:
    backbone: resnet10t
    dim: 16
    heads: 2
    encoder_layers: 1
    feedforward: 16
    head_hidden: 16
    lr: 0.001
    lr_step_epochs: 2
    normalise_position: true
data:
  root: {scenes}
  scene: heads
  image_size: 32
  short_side: 36
  batch_size: 4
  validation: sequences
trainer:
  max_epochs: 4
  accelerator: cpu
onnx_export:
  enabled: false
"""
    )
    return recipe
