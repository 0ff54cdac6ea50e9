"""Poses over HTTP: bundles served by worker processes."""

from mambaloc.serving.server import Limits, create_app, serve_bundles
from mambaloc.serving.workers import Workers

__all__ = ["Limits", "Workers", "create_app", "serve_bundles"]
