"""Novel views: images at poses without a real one, rendered from posed frames with depth."""

from mambaloc.renamed import renamed
from mambaloc.synthesis.consistency import agreement, confirmed, without_disagreeing
from mambaloc.synthesis.depth_from_images import depth_from_images
from mambaloc.synthesis.gate import Quality, held_out_quality
from mambaloc.synthesis.plane_sweep import PlaneSweep, SweepSettings
from mambaloc.synthesis.posed_depth import PosedDepth
from mambaloc.synthesis.sampling import PoseSampler, Spread
from mambaloc.synthesis.sensor_depth import carried_depth
from mambaloc.synthesis.splatting import Rendered, Splatter
from mambaloc.synthesis.views import Views, make_views

__all__ = [
    "PlaneSweep",
    "PoseSampler",
    "PosedDepth",
    "Quality",
    "Rendered",
    "Splatter",
    "Spread",
    "SweepSettings",
    "Views",
    "agreement",
    "carried_depth",
    "confirmed",
    "depth_from_images",
    "held_out_quality",
    "make_views",
    "without_disagreeing",
]

__getattr__ = renamed(__name__, {"depth_from_pictures": "depth_from_images"})
