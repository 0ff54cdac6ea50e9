"""Localise in a sparse map: OpenCV and NumPy alone, neither torch nor a network."""

from mambaloc.runtime.maps.localiser import MapLocalisation, MapLocaliser
from mambaloc.runtime.maps.sparse_map import SparseMap

__all__ = ["MapLocalisation", "MapLocaliser", "SparseMap"]
