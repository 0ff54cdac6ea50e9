"""The views that a training draws from, which may change while it runs."""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from typing import Self

import numpy as np
from numpy.typing import NDArray

from mambaloc.memory import release_pages
from mambaloc.synthesis import Views

Rows = NDArray[np.int64]


class ViewPool:
    """Views in a fixed number of places; others may be put in the place of some.

    Args:
        views: in all places, at first.
    """

    def __init__(self, views: Views) -> None:
        self._sets = [views]
        self._set = np.zeros(len(views), np.int64)
        self._row = np.arange(len(views))
        self.shape = views.images.shape[1:]

    def __len__(self) -> int:
        return len(self._row)

    @property
    def first(self) -> Views:
        """The views that were there at first."""
        return self._sets[0]

    @property
    def nbytes(self) -> int:
        """Of all images."""
        return self.first.images.nbytes

    @property
    def replaced(self) -> int:
        """How many views have been replaced."""
        return sum(map(len, self._sets[1:]))

    def copy(self) -> Self:
        """Return a pool of the same views that changes by itself."""
        other = copy(self)
        other._sets, other._set, other._row = list(self._sets), self._set.copy(), self._row.copy()
        return other

    def replace(self, places: Rows, views: Views) -> None:
        """Put N views in N places."""
        self._set[places], self._row[places] = len(self._sets), np.arange(len(views))
        self._sets.append(views)

    def images(self, places: Rows) -> NDArray[np.uint8]:
        """Images of some views, (B, 3, H, W)."""
        found = np.empty((len(places), *self.shape), np.uint8)
        for at, (views, row) in enumerate(self._found(places)):
            found[at] = views.images[row]
        for number in np.unique(self._set[places]):
            release_pages(self._sets[number].images)
        return found

    def holes(self, places: Rows) -> NDArray[np.bool_]:
        """Which pixels of some views have no depth, (B, H, W)."""
        found = np.empty((len(places), *self.shape[1:]), dtype=bool)
        for at, (views, row) in enumerate(self._found(places)):
            np.isnan(views.depth_m[row], out=found[at])
        for number in np.unique(self._set[places]):
            release_pages(self._sets[number].depth_m)
        return found

    def _found(self, places: Rows) -> Iterator[tuple[Views, int]]:
        for number, row in zip(self._set[places].tolist(), self._row[places].tolist(), strict=True):
            yield self._sets[number], row
