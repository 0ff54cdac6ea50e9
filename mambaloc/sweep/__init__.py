"""Matrices of trainings: read, run cell by cell on one machine or many, and kept with where each number comes from."""

from mambaloc.sweep.cells import Cell, Matrix, read_matrix
from mambaloc.sweep.progress import print_plan
from mambaloc.sweep.report import write_report
from mambaloc.sweep.running import run_matrix
from mambaloc.sweep.store import Store, StoredCell

__all__ = ["Cell", "Matrix", "Store", "StoredCell", "print_plan", "read_matrix", "run_matrix", "write_report"]
