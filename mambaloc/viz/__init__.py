"""Plots."""

from mambaloc.viz.trajectory import draw_trajectory

__all__ = ["draw_trajectory"]
