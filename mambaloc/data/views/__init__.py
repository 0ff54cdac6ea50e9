"""Synthetic views of a scene beside its training frames: made from their depth, mixed into their batches."""

from mambaloc.data.views.depth import ViewDepth, poses_of
from mambaloc.data.views.making import SceneViews, ViewRequest, make_scene_views
from mambaloc.data.views.mixing import FramesAndViews, MixedSampler
from mambaloc.data.views.points import points_of_frames_by_depth, points_of_views

__all__ = [
    "FramesAndViews",
    "MixedSampler",
    "SceneViews",
    "ViewDepth",
    "ViewRequest",
    "make_scene_views",
    "points_of_frames_by_depth",
    "points_of_views",
    "poses_of",
]
