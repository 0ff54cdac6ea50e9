"""Sweeps of trainings: run trial by trial on one machine or many, each result kept with where it comes from.

Running needs no torch; :mod:`mambaloc.sweep.report`, which reads results, does.
"""

from mambaloc.sweep.progress import print_plan
from mambaloc.sweep.running import run_sweep
from mambaloc.sweep.store import Store, StoredTrial
from mambaloc.sweep.trials import Sweep, Trial, read_sweep

__all__ = ["Store", "StoredTrial", "Sweep", "Trial", "print_plan", "read_sweep", "run_sweep"]
