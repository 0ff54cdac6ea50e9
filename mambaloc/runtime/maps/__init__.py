"""Localise in a sparse map: OpenCV and NumPy alone, neither torch nor a network."""

from mambaloc.runtime.maps.absolute_pose import CameraPose
from mambaloc.runtime.maps.localiser import MapLocalisation, MapLocaliser
from mambaloc.runtime.maps.sparse_map import MAP_FILE, SparseMap

__all__ = ["MAP_FILE", "CameraPose", "MapLocalisation", "MapLocaliser", "SparseMap"]
