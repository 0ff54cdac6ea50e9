"""Fetch one large file over HTTP: resumed where it broke off, started again where the server's file changed."""

from __future__ import annotations

import json
import re
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from email.message import Message
from http.client import HTTPException, HTTPResponse
from pathlib import Path
from urllib.error import HTTPError, URLError
from urllib.parse import urlsplit
from urllib.request import Request, urlopen

_CHUNK_BYTES = 1 << 20
_TIMEOUT_S = 60
_LONGEST_PAUSE_S = 30.0


class UnreachableError(Exception):
    """No address gave the file; the message has each server's answer."""


class _DroppedError(Exception):
    """The attempt ended early, and another may succeed."""


@dataclass(frozen=True)
class Offer:
    """One version of a file on a server; ``tag`` is its ETag or date of change, whichever can prove it the same."""

    url: str
    size_bytes: int | None
    tag: str | None


def fetch(
    urls: Sequence[str],
    target: Path,
    *,
    on_offer: Callable[[int | None, int], None] = lambda size_bytes, start: None,
    on_bytes: Callable[[int], None] = lambda count: None,
    tries: int = 5,
    pause_s: float = 1.0,
) -> Offer:
    """Fetch ``target`` from the first of ``urls`` that has it.

    Until it is whole the file is ``<target>.part``, with ``<target>.part.json``, which records its version:
    killed or cut off, it continues there at the next call.

    Args:
        urls: addresses of the same file, tried in order.
        target: the file to write.
        on_offer: called with the file's size (None where the server is silent) and the byte where this transfer starts,
            before the first byte is taken; it may raise to decline.
        on_bytes: called with the size of every chunk.
        tries: attempts in a row that bring no new byte, before an address is given up.
        pause_s: the wait before a retry, doubled each time.

    Raises:
        UnreachableError: no address gave the file.
    """
    answers = []
    for url in urls:
        transfer = _Transfer(url, target.with_name(f"{target.name}.part"), on_offer, on_bytes)
        try:
            offer = transfer.persist(tries, pause_s)
        except UnreachableError as answer:
            answers.append(str(answer))
            continue
        transfer.part.replace(target)
        transfer.state.unlink(missing_ok=True)
        return offer
    raise UnreachableError("; ".join(answers))


@dataclass
class _Transfer:
    """One address and the unfinished file."""

    url: str
    part: Path
    on_offer: Callable[[int | None, int], None]
    on_bytes: Callable[[int], None]

    @property
    def state(self) -> Path:
        return self.part.with_name(f"{self.part.name}.json")

    @property
    def have(self) -> int:
        return self.part.stat().st_size if self.part.exists() else 0

    def persist(self, tries: int, pause_s: float) -> Offer:
        furthest, failures = self.have, 0
        while True:
            try:
                return self._attempt()
            except _DroppedError as drop:
                failures = 0 if self.have > furthest else failures + 1
                furthest = max(furthest, self.have)
                if failures >= tries:
                    raise UnreachableError(f"{self.url}: {drop}, {tries} times in a row") from None
            time.sleep(min(pause_s * 2**failures, _LONGEST_PAUSE_S))

    def _attempt(self) -> Offer:
        kept = self._kept()
        if kept is not None and kept.size_bytes == self.have:
            return kept
        with self._ask(kept) as response:
            offer = self._agreed(response, kept)
            self.on_offer(offer.size_bytes, self.have if offer is kept else 0)
            if offer is not kept:
                self.part.unlink(missing_ok=True)  # before the new state: old bytes must never pass for new ones
                self.state.write_text(json.dumps(asdict(offer)))
            self._save(response, offer.size_bytes)
        return offer

    def _kept(self) -> Offer | None:
        """The version that the unfinished file is of, None without such a file or a known version."""
        try:
            kept = Offer(**json.loads(self.state.read_text()))
        except (OSError, ValueError, TypeError):
            return None
        return kept if kept.url == self.url and self.have else None

    def _ask(self, kept: Offer | None) -> HTTPResponse:
        """Open the address; ask for the rest alone where the server can compare versions."""
        headers = {"User-Agent": "mambaloc-download", "Accept-Encoding": "identity"}
        if kept is not None and kept.tag is not None:
            headers |= {"Range": f"bytes={self.have}-", "If-Range": kept.tag}
        try:
            response: HTTPResponse = urlopen(Request(self.url, headers=headers), timeout=_TIMEOUT_S)
        except HTTPError as error:
            if error.code == 416:  # what is here is longer than what is there
                self.part.unlink(missing_ok=True)
            if error.code in (408, 416, 429) or error.code >= 500:
                raise _DroppedError(f"answered {error.code} {error.reason}") from None
            raise UnreachableError(f"{self.url} answered {error.code} {error.reason}") from None
        except (URLError, HTTPException, OSError) as error:
            reason = getattr(error, "reason", error)
            if isinstance(reason, socket.gaierror):
                raise UnreachableError(f"{urlsplit(self.url).netloc} cannot be found (no network?)") from None
            raise _DroppedError(f"no connection ({reason})") from None
        if response.headers.get_content_type() == "text/html":
            response.close()
            raise UnreachableError(f"{self.url} answered with a web page instead of the file")
        return response

    def _agreed(self, response: HTTPResponse, kept: Offer | None) -> Offer:
        """What the response carries: the rest of ``kept``, or another version from its first byte."""
        tag = _tag(response.headers)
        if kept is None or response.status != 206:
            length = response.headers.get("Content-Length")
            return Offer(self.url, int(length) if length else None, tag)
        rest = re.fullmatch(r"bytes (\d+)-\d+/(\d+)", response.headers.get("Content-Range", ""))
        promised = (self.have, kept.size_bytes, kept.tag)
        if rest is None or (int(rest[1]), int(rest[2]), tag or kept.tag) != promised:
            self.part.unlink()  # a server that heeds Range but not If-Range
            raise _DroppedError("the file changed on the server")
        return kept

    def _save(self, response: HTTPResponse, size_bytes: int | None) -> None:
        with self.part.open("ab") as file:
            while size_bytes is None or file.tell() < size_bytes:
                try:
                    chunk = response.read1(_CHUNK_BYTES)  # what has arrived, so that a cut loses nothing
                except (HTTPException, OSError) as error:
                    raise _DroppedError(f"the connection broke off ({error})") from None
                if not chunk:
                    break
                file.write(chunk)
                self.on_bytes(len(chunk))
        if size_bytes not in (None, self.have):
            raise _DroppedError(f"the connection broke off at byte {self.have} of {size_bytes}")


def _tag(headers: Message) -> str | None:
    etag = headers.get("ETag")
    return headers.get("Last-Modified") if etag is None or etag.startswith("W/") else etag  # If-Range takes no weak tag
