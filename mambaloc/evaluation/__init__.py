"""Measure a trained system honestly: numbers with where they come from."""

from mambaloc.evaluation.evaluate import evaluate_checkpoint
from mambaloc.evaluation.report import print_table

__all__ = ["evaluate_checkpoint", "print_table"]
