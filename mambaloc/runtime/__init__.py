"""Localise with an exported network and a sparse map on ONNX Runtime, NumPy and OpenCV: nothing here imports torch."""

from mambaloc.runtime.contract import Contract, Preprocessing
from mambaloc.runtime.filter_noise import Noise
from mambaloc.runtime.localisation import Localisation, combined
from mambaloc.runtime.localiser import Localiser
from mambaloc.runtime.pose_filter import PoseEstimate, PoseFilter, smooth
from mambaloc.runtime.sources import frames_of
from mambaloc.runtime.trajectory import write_tum

__all__ = [
    "Contract",
    "Localisation",
    "Localiser",
    "Noise",
    "PoseEstimate",
    "PoseFilter",
    "Preprocessing",
    "combined",
    "frames_of",
    "smooth",
    "write_tum",
]
