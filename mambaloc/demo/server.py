"""Serve a folder of static files to this machine, or by HTTPS to the local network."""

from __future__ import annotations

import os
import signal
import ssl
import sys
from contextlib import suppress
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from socketserver import TCPServer
from tempfile import TemporaryDirectory
from typing import Any

from mambaloc.demo.lan import lan_address, qr_code, self_signed
from mambaloc.demo.site import build_site
from mambaloc.errors import InputError
from mambaloc.renamed import renamed_arguments

LOOPBACK = "127.0.0.1"
_TYPES = {".js": "text/javascript", ".mjs": "text/javascript", ".wasm": "application/wasm", ".webm": "video/webm"}
_HEADERS = {
    "Cross-Origin-Opener-Policy": "same-origin",  # this and the next: WebAssembly has threads
    "Cross-Origin-Embedder-Policy": "require-corp",
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
    "Content-Security-Policy": (
        "default-src 'self'; script-src 'self' 'wasm-unsafe-eval'; style-src 'self' 'unsafe-inline'; "
        "img-src 'self' blob: data:; media-src 'self' blob:; worker-src 'self' blob:; connect-src 'self' blob: data:; "
        "object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
}


@renamed_arguments(film="video")
def serve_page(bundle: Path, video: Path | None, port: int, lan: bool) -> None:
    """Build the page of a bundle, say where it is, and serve it until Ctrl-C or the process is asked to end.

    Args:
        bundle: as :func:`~mambaloc.demo.site.build_site` takes it.
        video: a video for the page to play, or the folder of a video with poses.
        port: as :func:`serve` takes it.
        lan: serve the local network by HTTPS, and print the address as a code to scan, too.

    Raises:
        InputError: as :func:`~mambaloc.demo.site.build_site` and :func:`serve`; no network; no extra ``lan``.
    """
    host = lan_address() if lan else LOOPBACK
    tls = self_signed(host) if lan else None
    code = qr_code if lan else (lambda _: "")
    code("")  # so that a missing package is reported before the page is built
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())  # as Ctrl-C does, leave nothing behind
    with TemporaryDirectory() as folder:
        site = build_site(bundle, Path(folder, "site"), video)
        with serve(site, port, host, tls) as server, suppress(KeyboardInterrupt):
            url = f"{'https' if tls else 'http'}://{host}:{server.server_port}/"
            print(f"{code(url)}{url}  (Ctrl-C ends)", flush=True)
            server.serve_forever()


def serve(site: Path, port: int, host: str = LOOPBACK, tls: ssl.SSLContext | None = None) -> ThreadingHTTPServer:
    """Listen, and return the server; ``serve_forever`` answers.

    Args:
        site: the folder.
        port: 0 takes a free one, which ``server_port`` has.
        host: address to listen at.
        tls: with it, HTTPS.

    Raises:
        InputError: where the port is taken, or none of a user's.
    """
    try:
        server = _Server((host, port), partial(_Handler, directory=str(site)))
    except OverflowError:
        raise InputError(f"--port {port}: ports go from 0 to 65535") from None
    except OSError as error:
        raise InputError(f"--port {port}: cannot be opened ({error.strerror}); choose another") from None
    if tls is not None:
        server.socket = tls.wrap_socket(server.socket, server_side=True, do_handshake_on_connect=False)
    return server


class _Server(ThreadingHTTPServer):
    request_queue_size = 128  # with the default of 5, one of many at once waits for seconds to be let in
    allow_reuse_address = os.name != "nt"  # where it would let two servers share a port

    def server_bind(self) -> None:
        """Bind without asking the network for this machine's name, as the base does: that can take seconds."""
        TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Keep quiet of browsers that hang up, or do not trust the certificate yet."""


class _Handler(SimpleHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    timeout = 60  # seconds that a connection may say nothing
    extensions_map = SimpleHTTPRequestHandler.extensions_map | _TYPES

    def end_headers(self) -> None:
        """Add what every answer carries."""
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        super().end_headers()

    def send_head(self) -> Any:
        """Answer only who asked for this machine: no other site's name leads here. And only of the folder."""
        host = self.headers.get("Host", "").rpartition(":")[0] or self.headers.get("Host", "")
        if host not in (self.server.server_name, "localhost"):  # type: ignore[attr-defined]
            self.send_error(403)
            return None
        path = self.translate_path(self.path)
        if "\0" in path or not Path(path).resolve().is_relative_to(Path(self.directory).resolve()):
            self.send_error(404)
            return None
        return super().send_head()

    def list_directory(self, path: Any) -> None:
        """Show no folder's listing."""
        self.send_error(404)

    def log_message(self, format: str, *args: Any) -> None:
        """Keep quiet."""
