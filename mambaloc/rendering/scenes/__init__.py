"""Rendered frames on disk in the layouts of the public datasets, and the embedded scene."""
