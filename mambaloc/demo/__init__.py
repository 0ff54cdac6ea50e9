"""A bundle in a browser: the page as a static site, and a server for this machine or the local network."""

from mambaloc.demo.server import serve, serve_page
from mambaloc.demo.site import build_site
from mambaloc.demo.video import embedded_video
from mambaloc.renamed import renamed

__getattr__ = renamed(__name__, {"embedded_film": "embedded_video"})
__all__ = ["build_site", "embedded_video", "serve", "serve_page"]
