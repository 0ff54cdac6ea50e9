"""Where a scene's frame lies in the world of the data that it was made of, as a map's grid in metres."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

_LARGEST = 1e12


@dataclass(frozen=True)
class World:
    """A shift, which is removed while numbers are float64, so that float32 holds the rest, and undone in results.

    Args:
        offset_m: of the scene's origin in its source's world, in metres or the scene's unit.
        metres_per_unit: what the source's positions were multiplied by: its own numbers are ``position / this``.
    """

    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    metres_per_unit: float = 1.0

    def position_m(self, scene_m: ArrayLike) -> NDArray[np.float64]:
        """Positions (..., 3) of the scene's frame in the source's world, whose axes are the same; float64."""
        return np.asarray(scene_m, np.float64) + self.offset_m

    @classmethod
    def from_json(cls, value: Any) -> Self:
        """Read what ``asdict`` gives; no shift where an older file has none.

        Raises:
            ValueError: for anything else.
        """
        if value is None:
            return cls()
        try:
            x, y, z = (float(each) for each in value["offset_m"])
            scale = float(value["metres_per_unit"])
        except (TypeError, KeyError, ValueError) as error:
            raise ValueError(f"world: {type(error).__name__}: {error}") from None
        if not all(abs(each) <= _LARGEST for each in (x, y, z)) or not (math.isfinite(scale) and scale > 0):
            raise ValueError(f"world: {value}")
        return cls((x, y, z), scale)
