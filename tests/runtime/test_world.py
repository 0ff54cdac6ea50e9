"""The world of a scene: millimetres in a map's grid survive every place that tells a position."""

from __future__ import annotations

import json

import numpy as np
import pytest
from test_other_lenses import CONTRACT

from mambaloc.data.datasets.capture import world_of
from mambaloc.errors import InputError
from mambaloc.runtime.contract import Contract
from mambaloc.runtime.localization import Localization
from mambaloc.runtime.localizer import Localizer
from mambaloc.runtime.trajectory import write_tum
from mambaloc.runtime.world import World

GRID = World((441548.0, 5121946.0, 346.0), 0.3048)


class Echo:
    """A network that answers one pose, in the scene's frame and float32 as exported networks do."""

    contract = Contract(**{**CONTRACT.__dict__, "world": GRID})

    def localize(self, images, intrinsics=None):
        return [Localization(np.array([0.2072, 0.5531, -0.4352], np.float32), np.array([1.0, 0, 0, 0]), 0.0)]


def test_a_localizer_answers_in_the_sources_world():
    localizer = Localizer.__new__(Localizer)
    localizer._network, localizer._map = Echo(), None
    found = localizer.localize(np.zeros((96, 128, 3), np.uint8))
    np.testing.assert_allclose(found.position_m, (441548.2072, 5121946.5531, 345.5648), atol=1e-7)
    assert localizer.world == GRID


def test_a_trajectory_keeps_millimetres(tmp_path):
    write_tum(tmp_path / "a.tum", [0.5], np.array([[441548.2072, 5121946.5531, 346.5648]]), np.array([[1.0, 0, 0, 0]]))
    assert (tmp_path / "a.tum").read_text().splitlines()[1] == (
        "0.500000000 441548.207200 5121946.553100 346.5648 0 0 0 1"
    )


def test_a_contract_carries_it_and_older_ones_have_none():
    contract = Echo.contract
    assert Contract.from_json(contract.to_json(), "a").world == GRID
    told = json.loads(contract.to_json())
    del told["world"]
    assert Contract.from_json(json.dumps(told), "a").world == World()


@pytest.mark.parametrize(
    "world",
    [
        {"offset_m": [1, 2], "metres_per_unit": 1},
        {"offset_m": [1, 2, "x"], "metres_per_unit": 1},
        {"offset_m": [1, 2, float("nan")], "metres_per_unit": 1},
        {"offset_m": [1, 2, 3], "metres_per_unit": 0},
        {"offset_m": [1, 2, 3]},
        7,
    ],
)
def test_a_damaged_world_is_refused_in_one_line(tmp_path, world):
    told = json.loads(Echo.contract.to_json()) | {"world": world}
    with pytest.raises(InputError, match="a: its contract cannot be read"):
        Contract.from_json(json.dumps(told), "a")
    (tmp_path / "scene.json").write_text(json.dumps({"world": world}))
    with pytest.raises(InputError, match=r"scene\.json: world: "):
        world_of(tmp_path)


def test_an_older_scene_has_no_shift(tmp_path):
    (tmp_path / "scene.json").write_text("{}")
    assert world_of(tmp_path) == World()
