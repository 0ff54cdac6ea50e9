"""MambaLoc: TransPoseNet with a Global Information Selector (GIS) between each encoder and its head."""

from __future__ import annotations

from typing import Any

from mambaloc.models.registry import register_model
from mambaloc.models.transposenet import LitTransPoseNet, TransPoseNet
from mambaloc.nn import Backbone, GISMode


class MambaLoc(TransPoseNet):
    """The network of MambaLoc (its section III-B); :class:`~mambaloc.models.transposenet.TransPoseNet` lists its parts.

    The arguments are its; ``gis`` is what makes it MambaLoc.
    """

    def __init__(
        self, backbone: Backbone, image_size: tuple[int, int] = (224, 224), *, gis: GISMode = "gis", **kwargs: Any
    ) -> None:
        super().__init__(backbone, image_size, gis=gis, **kwargs)


@register_model("mambaloc")
class LitMambaLoc(LitTransPoseNet):
    """MambaLoc with the paper's training: learned weights from (-0.5, -6.5), Adam, a single phase.

    The arguments are those of :class:`~mambaloc.models.transposenet.LitTransPoseNet`.
    """

    network_class = MambaLoc

    def __init__(self, gis: GISMode = "gis", **shared: Any) -> None:
        super().__init__(gis=gis, **shared)
