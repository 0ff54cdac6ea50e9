"""Plots."""

from mambaloc.viz.agreement import draw_agreement
from mambaloc.viz.capture import draw_capture
from mambaloc.viz.features import draw_features, position_features, principal_colors
from mambaloc.viz.heatmaps import BranchHeat, draw_heat_maps, heat_maps
from mambaloc.viz.scene_page import write_scene_page
from mambaloc.viz.top_view import draw_top_view
from mambaloc.viz.trajectory import draw_trajectory

__all__ = [
    "BranchHeat",
    "draw_agreement",
    "draw_capture",
    "draw_features",
    "draw_heat_maps",
    "draw_top_view",
    "draw_trajectory",
    "heat_maps",
    "position_features",
    "principal_colors",
    "write_scene_page",
]
