"""Serve a folder of static files to this machine, or by HTTPS to the local network."""

from __future__ import annotations

import base64
import hashlib
import re
import ssl
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from mambaloc.errors import InputError

LOOPBACK = "127.0.0.1"
_TYPES = {".js": "text/javascript", ".mjs": "text/javascript", ".wasm": "application/wasm", ".webm": "video/webm"}
_HEADERS = {
    "Cross-Origin-Opener-Policy": "same-origin",  # this and the next: WebAssembly has threads
    "Cross-Origin-Embedder-Policy": "require-corp",
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}


def serve(site: Path, port: int, host: str = LOOPBACK, tls: ssl.SSLContext | None = None) -> ThreadingHTTPServer:
    """Listen, and return the server; ``serve_forever`` answers.

    Args:
        site: the folder.
        port: 0 takes a free one, which ``server_port`` tells.
        host: address to listen at.
        tls: with it, HTTPS.

    Raises:
        InputError: where the port is taken, or none of a user's.
    """
    handler = partial(_Handler, directory=str(site), policy=_content_policy((site / "index.html").read_text("utf-8")))
    try:
        server = _Server((host, port), handler)
    except OverflowError:
        raise InputError(f"--port {port}: ports go from 0 to 65535") from None
    except OSError as error:
        raise InputError(f"--port {port}: cannot be listened at ({error.strerror}); choose another") from None
    if tls is not None:
        server.socket = tls.wrap_socket(server.socket, server_side=True, do_handshake_on_connect=False)
    return server


def _content_policy(page: str) -> str:
    """Everything from here alone, and no script in the page but its import map, if it has one."""
    maps = re.findall(r'<script type="importmap">(.*?)</script>', page, re.DOTALL)
    digests = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in maps]
    allowed = " ".join(["'self'", "'wasm-unsafe-eval'", *(f"'sha256-{digest}'" for digest in digests)])
    return (
        f"default-src 'self'; script-src {allowed}; style-src 'self' 'unsafe-inline'; img-src 'self' blob: data:; "
        "media-src 'self' blob:; worker-src 'self' blob:; connect-src 'self' blob: data:; "
        "object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Keep quiet of browsers that hang up, or do not trust the certificate yet."""


class _Handler(SimpleHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    timeout = 60  # of a connection that says nothing
    extensions_map = SimpleHTTPRequestHandler.extensions_map | _TYPES

    def __init__(self, *args: Any, policy: str, **kwargs: Any) -> None:
        self.policy = policy
        super().__init__(*args, **kwargs)

    def end_headers(self) -> None:
        """Add what every answer carries."""
        for name, value in {**_HEADERS, "Content-Security-Policy": self.policy}.items():
            self.send_header(name, value)
        super().end_headers()

    def list_directory(self, path: Any) -> None:
        """Show no folder's listing."""
        self.send_error(404)

    def log_message(self, format: str, *args: Any) -> None:
        """Keep quiet."""
