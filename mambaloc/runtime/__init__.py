"""Localize with an exported network and a sparse map on ONNX Runtime, NumPy and OpenCV: nothing here imports torch."""

from mambaloc.renamed import renamed
from mambaloc.runtime.contract import Contract, Preprocessing
from mambaloc.runtime.filter_noise import Noise
from mambaloc.runtime.localization import Localization, combined
from mambaloc.runtime.localizer import Localizer
from mambaloc.runtime.pose_filter import PoseEstimate, PoseFilter, smooth
from mambaloc.runtime.sources import frames_of
from mambaloc.runtime.trajectory import write_tum

__all__ = [
    "Contract",
    "Localization",
    "Localizer",
    "Noise",
    "PoseEstimate",
    "PoseFilter",
    "Preprocessing",
    "combined",
    "frames_of",
    "smooth",
    "write_tum",
]

__getattr__ = renamed(__name__, {"Localiser": "Localizer", "Localisation": "Localization"})
