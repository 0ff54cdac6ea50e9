"""Scene points that each frame may see: what Geometric PoseNet's reprojection error needs."""

from mambaloc.data.points.reading import read_points
from mambaloc.data.points.scene_points import ScenePoints

__all__ = ["ScenePoints", "read_points"]
