"""Matrices of trainings: read, run cell by cell on one machine or many, and kept with where each number comes from."""

from mambaloc.matrix.cells import Cell, Matrix, read_matrix
from mambaloc.matrix.progress import print_plan
from mambaloc.matrix.report import write_report
from mambaloc.matrix.running import run_matrix
from mambaloc.matrix.store import Store, StoredCell

__all__ = ["Cell", "Matrix", "Store", "StoredCell", "print_plan", "read_matrix", "run_matrix", "write_report"]
