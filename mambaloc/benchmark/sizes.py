"""Parameters as the paper counts them: what it publishes beside what is shipped."""

from __future__ import annotations

import timm
import torch

from mambaloc.models.mambaloc import MambaLoc

_PUBLISHED_TABLES = 3 * 60 * 128


def published_accounting(network: MambaLoc) -> dict[str, int]:
    """Count a network's parameters, item by item, as the paper's model has them.

    The published TransPoseNet and MambaLoc carry the whole EfficientNet-B0, of which the last stages, last
    convolution and classifier never touch the output, and three position tables of 60 x 128 whatever the image.

    Returns:
        ``shipped``, then what the published model adds and replaces, and their sum ``published``.
    """
    with torch.device("meta"):
        whole = timm.create_model(network.backbone.name)
    tables = [p for e in (network.position_encoder, network.orientation_encoder) for p in e.positions.parameters()]
    items = {
        "shipped": sum(p.numel() for p in network.parameters()),
        "dead backbone": sum(p.numel() for p in whole.parameters())
        - sum(p.numel() for p in network.backbone.parameters()),
        "our position tables": -sum(table.numel() for table in tables),
        "published position tables": _PUBLISHED_TABLES,
    }
    return {**items, "published": sum(items.values())}
