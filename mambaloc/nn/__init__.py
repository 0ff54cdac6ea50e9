"""Blocks that know no batch and no file."""

from mambaloc.nn.backbone import Backbone, ImageBackbone, PooledBackbone
from mambaloc.nn.cells import CellDetail, CellHead, CellPosition, CellRotation
from mambaloc.nn.encoder import TokenEncoder
from mambaloc.nn.frozen import SplitBackbone
from mambaloc.nn.gis import GISMode, GlobalInformationSelector, build_gis
from mambaloc.nn.heads import PoseHead, PositionScale, RegressionHead, Rotation, last_layers
from mambaloc.nn.network import PoseNetwork
from mambaloc.nn.recomputed import recompute_stages
from mambaloc.nn.ssm import Discretization, MambaMixer, selective_scan
from mambaloc.renamed import renamed

__all__ = [
    "Backbone",
    "CellDetail",
    "CellHead",
    "CellPosition",
    "CellRotation",
    "Discretization",
    "GISMode",
    "GlobalInformationSelector",
    "ImageBackbone",
    "MambaMixer",
    "PooledBackbone",
    "PoseHead",
    "PoseNetwork",
    "PositionScale",
    "RegressionHead",
    "Rotation",
    "SplitBackbone",
    "TokenEncoder",
    "build_gis",
    "last_layers",
    "recompute_stages",
    "selective_scan",
]

__getattr__ = renamed(__name__, {"Discretisation": "Discretization"})
