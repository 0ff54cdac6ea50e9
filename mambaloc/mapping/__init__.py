"""Sparse maps from posed frames; what reads datasets is in ``posed``."""

from mambaloc.mapping.building import MapSettings, PosedFrames, build_map

__all__ = ["MapSettings", "PosedFrames", "build_map"]
