"""Public datasets from their official addresses."""

from mambaloc.data.download.origins import SOURCES, Archive, Source, describe_sources, how_to_get
from mambaloc.data.download.scene import download

__all__ = ["SOURCES", "Archive", "Source", "describe_sources", "download", "how_to_get"]
