"""Released models: what they are, where they came from, and how to load one by name."""

from mambaloc.zoo.loading import list_released, load
from mambaloc.zoo.manifest import Manifest, Result

__all__ = ["Manifest", "Result", "list_released", "load"]
