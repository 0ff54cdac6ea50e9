"""Blocks that know no pose, no batch and no file."""

from mambaloc.nn.backbone import Backbone
from mambaloc.nn.encoder import TokenEncoder
from mambaloc.nn.gis import GISMode, GlobalInformationSelector, build_gis
from mambaloc.nn.heads import PositionScale, RegressionHead
from mambaloc.nn.ssm import Discretisation, MambaMixer, selective_scan

__all__ = [
    "Backbone",
    "Discretisation",
    "GISMode",
    "GlobalInformationSelector",
    "MambaMixer",
    "PositionScale",
    "RegressionHead",
    "TokenEncoder",
    "build_gis",
    "selective_scan",
]
