"""Released models: what they are, where they came from, and how to load one by name."""

from mambaloc.zoo.loading import create_model, list_models, list_released, load
from mambaloc.zoo.manifest import Manifest, Result
from mambaloc.zoo.transform import Transform, create_transform

__all__ = [
    "Manifest",
    "Result",
    "Transform",
    "create_model",
    "create_transform",
    "list_models",
    "list_released",
    "load",
]
