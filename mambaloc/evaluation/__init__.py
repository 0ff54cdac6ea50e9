"""Measure a trained system honestly: numbers with where they come from."""

from mambaloc.evaluation.evaluate import evaluate_checkpoint
from mambaloc.evaluation.report import print_scenes, print_table
from mambaloc.evaluation.scenes import evaluate_scenes
from mambaloc.evaluation.with_map import measure_map, measure_map_of_run

__all__ = [
    "evaluate_checkpoint",
    "evaluate_scenes",
    "measure_map",
    "measure_map_of_run",
    "print_scenes",
    "print_table",
]
