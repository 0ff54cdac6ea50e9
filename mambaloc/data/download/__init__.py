"""Public datasets from their official addresses."""

from mambaloc.data.datasets.registry import describe_sources
from mambaloc.data.download.scene import download

__all__ = ["describe_sources", "download"]
