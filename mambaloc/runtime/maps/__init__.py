"""Localize in a sparse map: OpenCV and NumPy alone, neither torch nor a network."""

from mambaloc.renamed import renamed
from mambaloc.runtime.maps.absolute_pose import CameraPose
from mambaloc.runtime.maps.localizer import MapLocalization, MapLocalizer
from mambaloc.runtime.maps.sparse_map import MAP_FILE, SparseMap

__all__ = ["MAP_FILE", "CameraPose", "MapLocalization", "MapLocalizer", "SparseMap"]

__getattr__ = renamed(__name__, {"MapLocaliser": "MapLocalizer", "MapLocalisation": "MapLocalization"})
