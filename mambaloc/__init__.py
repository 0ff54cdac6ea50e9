"""Camera localization that anyone can train for their own place.

>>> import mambaloc
>>> mambaloc.list_models()
['atloc', 'lstm_posenet', 'mambaloc', 'mapnet', 'posenet', 'posenet_geometric', 'posenet_learned', 'student', ...]
>>> system = mambaloc.create_model("mambaloc", gis="gis")  # a LightningModule; .network is a plain nn.Module
"""

from importlib.metadata import version
from typing import TYPE_CHECKING

from mambaloc.lazy import lazy

if TYPE_CHECKING:
    from mambaloc.data import PoseDataModule
    from mambaloc.models.mambaloc import LitMambaLoc
    from mambaloc.zoo import create_model, create_transform, list_models, list_released, load

__version__ = version("mambaloc")

# Imported on first use: `import mambaloc` alone costs nothing and needs no torch.
_EXPORTS = {
    "LitMambaLoc": "mambaloc.models.mambaloc",
    "PoseDataModule": "mambaloc.data",
    "create_model": "mambaloc.zoo",
    "create_transform": "mambaloc.zoo",
    "list_models": "mambaloc.zoo",
    "list_released": "mambaloc.zoo",
    "load": "mambaloc.zoo",
}

__all__ = [
    "LitMambaLoc",
    "PoseDataModule",
    "__version__",
    "create_model",
    "create_transform",
    "list_models",
    "list_released",
    "load",
]


def __dir__() -> list[str]:
    return __all__


__getattr__ = lazy(__name__, _EXPORTS)
