"""From a trained system to files that run without PyTorch."""

from mambaloc.export.onnx import Parity, contract_of, export_onnx

__all__ = ["Parity", "contract_of", "export_onnx"]
