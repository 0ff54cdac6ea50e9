"""From a trained system to files that run without PyTorch."""

from mambaloc.export.bundle import FORMATS, write_bundle
from mambaloc.export.onnx import Parity, contract_of, contract_of_training, export_onnx
from mambaloc.export.pages import TARGETS

__all__ = ["FORMATS", "TARGETS", "Parity", "contract_of", "contract_of_training", "export_onnx", "write_bundle"]
