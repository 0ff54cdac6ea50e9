"""Novel views: pictures at poses where nobody took one, rendered from posed frames with depth."""

from mambaloc.synthesis.posed_depth import PosedDepth
from mambaloc.synthesis.sampling import PoseSampler, Spread
from mambaloc.synthesis.sensor_depth import carried_depth
from mambaloc.synthesis.splatting import Rendered, Splatter
from mambaloc.synthesis.views import MOST_HOLES, Views, make_views

__all__ = [
    "MOST_HOLES",
    "PoseSampler",
    "PosedDepth",
    "Rendered",
    "Splatter",
    "Spread",
    "Views",
    "carried_depth",
    "make_views",
]
