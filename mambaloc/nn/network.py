"""Base of every network: images in, poses out."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from mambaloc.nn.backbone import ImageBackbone
from mambaloc.nn.cells import CellHead
from mambaloc.nn.heads import PoseHead
from mambaloc.types import PosePrediction


class PoseNetwork(nn.Module):
    """Base of every network: a backbone, a global feature for each branch, and the head that reads them.

    :meth:`forward` runs :meth:`forward_backbone`, :meth:`features` and :meth:`forward_head`; callers that need
    what lies between them call them one by one, and compute nothing twice.

    Shape:
        (B, 3, H, W) in 0..1 -> :class:`~mambaloc.types.PosePrediction`.
    """

    takes_intrinsics: bool = False
    """Whether the pose depends on the camera; other networks are given its intrinsics and leave them unread."""

    default_intrinsics: Tensor
    """(3, 3): the training camera's, of a network that takes intrinsics; read where none are given."""

    backbone: ImageBackbone
    head: PoseHead | CellHead
    scenes: int = 1
    """How many scenes the network knows. With several it recognises each image's; the pose is in that one's frame."""

    scene_tables: tuple[str, ...] = ()
    """Beginnings of the names of those weights that have as many rows for each scene, in their order."""

    image_size: tuple[int, int] | None = None
    """(height, width) that the network was built for; None takes any."""

    def features(self, feats: Any) -> tuple[Tensor, Tensor]:
        """Turn what the backbone returns into the position and orientation branches' features.

        Shape:
            (B, D) each of the whole image; (B, N, D) each of a dense head's N cells, or of the queries of N scenes.
        """
        raise NotImplementedError

    def forward_backbone(self, image: Tensor) -> Any:
        """Run the backbone alone; (B, 3, H, W) in 0..1 -> its feature (B, D) or its maps, a list of (B, C, H, W).

        Raises:
            ValueError: for images of another size than the network was built for.
        """
        if self.image_size is not None and image.shape[-2:] != torch.Size(self.image_size):
            raise ValueError(f"images are {tuple(image.shape[-2:])}, the network was built for {self.image_size}")
        return self.backbone(image)

    def forward_features(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Turn images, (B, 3, H, W) in 0..1, into both branches' features, as :meth:`features`."""
        return self.features(self.forward_backbone(image))

    def forward_head(
        self, branches: tuple[Tensor, Tensor], intrinsics: Tensor | None = None, scene: Tensor | None = None
    ) -> PosePrediction:
        """Turn both branches' features into poses."""
        return self.head(*branches)

    def forward(self, image: Tensor, intrinsics: Tensor | None = None, scene: Tensor | None = None) -> PosePrediction:
        """Localize images.

        Args:
            image: (B, 3, H, W) in 0..1.
            intrinsics: (B, 3, 3) in pixels of ``image``; where the network takes them, the training camera's unless
                given.
            scene: (B,), in whose frame each pose is to be, of a network that knows several; the likeliest unless given.

        Raises:
            ValueError: as :meth:`forward_backbone`.
        """
        return self.forward_head(self.forward_features(image), intrinsics, scene)
