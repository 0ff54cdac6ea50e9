"""A bundle in a browser: the page as a static site, and a server for this machine or the local network."""

from mambaloc.demo.film import embedded_film
from mambaloc.demo.server import serve, serve_page
from mambaloc.demo.site import build_site

__all__ = ["build_site", "embedded_film", "serve", "serve_page"]
