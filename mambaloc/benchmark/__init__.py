"""Measurements of the library itself: each a ratio taken in one run."""

from mambaloc.benchmark.loading import LoadingRates, measure_loading
from mambaloc.benchmark.sizes import published_accounting

__all__ = ["LoadingRates", "measure_loading", "published_accounting"]
