"""Names that were renamed are importable for one release, and warn."""

import importlib
import inspect

import numpy as np
import pytest
import torch

from mambaloc.data import Frames
from mambaloc.demo import build_site, serve_page
from mambaloc.export import Parity
from mambaloc.nn import PositionScale
from mambaloc.renamed import renamed_arguments
from mambaloc.runtime import Localizer, PoseEstimate, frames_of
from mambaloc.runtime.maps import MapLocalizer
from mambaloc.synthesis import PosedDepth, Splatter

RENAMED = [
    ("mambaloc.runtime", "Localiser", "Localizer"),
    ("mambaloc.runtime", "Localisation", "Localization"),
    ("mambaloc.runtime.localiser", "Localiser", "Localizer"),
    ("mambaloc.runtime.localisation", "Localisation", "Localization"),
    ("mambaloc.runtime.maps", "MapLocaliser", "MapLocalizer"),
    ("mambaloc.runtime.maps", "MapLocalisation", "MapLocalization"),
    ("mambaloc.benchmark", "Setting", "BenchmarkConfig"),
    ("mambaloc.callbacks", "WholeCheckpoints", "AtomicCheckpointIO"),
    ("mambaloc.rendering", "Shot", "Frame"),
    ("mambaloc.rendering", "embedded_shots", "embedded_frames"),
    ("mambaloc.rendering", "shots_of_sequences", "frames_of_sequences"),
    ("mambaloc.demo", "embedded_film", "embedded_video"),
    ("mambaloc.nn", "Discretisation", "Discretization"),
    ("mambaloc.synthesis", "depth_from_pictures", "depth_from_images"),
    ("mambaloc.metrics", "summarise", "summarize"),
    ("mambaloc.metrics", "summarise_errors", "summarize_errors"),
]


@pytest.mark.parametrize(("module", "old", "new"), RENAMED)
def test_old_names_are_the_new_ones_and_warn(module, old, new):
    package = importlib.import_module(module)
    with pytest.warns(DeprecationWarning, match=rf"{module}\.{old} is now {new}\."):
        found = getattr(package, old)
    assert found is getattr(package, new)
    assert old not in dir(package)


@pytest.mark.parametrize("module", sorted({module for module, _, _ in RENAMED}))
def test_other_names_are_still_missing(module):
    with pytest.raises(AttributeError, match=f"module '{module}' has no attribute 'nothing'"):
        _ = importlib.import_module(module).nothing


@pytest.mark.parametrize(
    ("kind", "old", "new", "arguments"),
    [
        (Localizer, "localise", "localize", ("image", "intrinsics", True)),
        (Localizer, "localise_each", "localize_each", ("source", "intrinsics", True)),
        (MapLocalizer, "localise", "localize", ("image", "intrinsics", "prior")),
        (PosedDepth, "apart", "distance", ("world_from_cam",)),
    ],
)
def test_old_methods_call_the_new_ones_and_warn(monkeypatch, kind, old, new, arguments):
    monkeypatch.setattr(kind, new, lambda self, *given: given)
    with pytest.warns(DeprecationWarning, match=rf"{kind.__name__}\.{old} is now {new}\."):
        assert getattr(kind.__new__(kind), old)(*arguments) == arguments


@pytest.mark.parametrize(
    ("record", "old", "new"),
    [
        (PoseEstimate(*np.zeros((5, 3))), "turn_rad_s", "angular_velocity_rad_s"),
        (Parity(0.1, 0.2, 30.0), "reach_m", "max_norm_m"),
    ],
)
def test_old_fields_are_the_new_ones_and_warn(record, old, new):
    with pytest.warns(DeprecationWarning, match=rf"{type(record).__name__}\.{old} is now {new}\."):
        assert getattr(record, old) is getattr(record, new)


def test_positions_are_normalized_by_the_old_name():
    scale, position_m = PositionScale(), torch.tensor([[1.0, 2.0, 3.0], [3.0, 2.0, 1.0]])
    scale.fit(position_m)
    with pytest.warns(DeprecationWarning, match="PositionScale.normalise is now normalize"):
        torch.testing.assert_close(scale.normalise(position_m), scale.normalize(position_m))


def test_arguments_go_to_the_new_names_and_warn():
    @renamed_arguments(old="new")
    def double(new, other=0):
        return 2 * new + other

    with pytest.warns(DeprecationWarning, match=r"double: old is now new\. The old name is removed") as found:
        assert double(old=3, other=1) == 7
    assert found[0].filename == __file__
    assert double(4) == double(new=4) == 8
    with pytest.raises(TypeError, match="another"):
        double(another=3)


@pytest.mark.parametrize(
    ("function", "old", "new"),
    [
        (build_site, "film", "video"),
        (serve_page, "film", "video"),
        (frames_of, "pictures_hz", "images_hz"),
        (Frames.evenly_spread, "most", "count"),
        (Splatter.render, "most_holes", "max_holes"),
    ],
)
def test_old_arguments_warn(function, old, new):
    with pytest.warns(DeprecationWarning, match=f"{old} is now {new}"), pytest.raises(TypeError):
        function(**{old: None, "nothing": None})
    assert new in inspect.signature(function).parameters
