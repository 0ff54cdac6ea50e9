"""From a trained system to files that run without PyTorch."""

from mambaloc.export.onnx import Parity, export_onnx

__all__ = ["Parity", "export_onnx"]
