"""An HTTP server of poses: an image in the body, JSON out; built on Starlette and Uvicorn."""

from __future__ import annotations

import asyncio
import hmac
import socket
import time
from argparse import ArgumentTypeError
from collections.abc import AsyncGenerator, AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import uvicorn
from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from starlette.applications import Starlette
from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from mambaloc.console import pinhole_matrix
from mambaloc.errors import InputError
from mambaloc.serving.workers import Answer, Task, WorkerLostError, Workers

LOOPBACK = ("127.0.0.1", "::1", "localhost")
"""Hosts that only this machine reaches."""

_BODY_S = 30.0  # in which a body must have come
_MULTIPART = "multipart/form-data"

_Matrix = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Limits:
    """What the server takes.

    Args:
        body_bytes: of a request, whatever its headers say.
        images: of a request.
        waiting: images that are localized or wait for it, beyond which requests are turned away with status 503.
        is_distorted: images are as the training camera stores them, unless a request says otherwise.
    """

    body_bytes: int = 32 * 2**20
    pictures: int = 32
    waiting: int = 256
    is_distorted: bool = False


class _Metrics:
    """Metrics for Prometheus."""

    def __init__(self, workers: Workers) -> None:
        self.registry = CollectorRegistry()
        options: dict[str, Any] = {"registry": self.registry, "namespace": "mambaloc"}
        self.requests = Counter(
            "requests", "Requests to localize, by bundle and status", ("bundle", "status"), **options
        )
        self.pictures = Counter("pictures", "Images, by bundle and what answered", ("bundle", "source"), **options)
        self.seconds = Histogram("picture_seconds", "Of an image, waiting included", ("bundle",), **options)
        self.waiting = Gauge("pictures_waiting", "Images that are localized or wait for it", **options)
        Gauge("workers", "Worker processes", **options).set(workers.count)
        replaced = Gauge("workers_replaced", "Workers that died or took too long", **options)
        replaced.set_function(lambda: workers.replaced)


class _Endpoints:
    def __init__(self, workers: Workers, limits: Limits, token: str | None) -> None:
        self.workers, self.limits, self.token = workers, limits, token
        self.metrics = _Metrics(workers)
        self.waiting = 0

    async def localize(self, request: Request) -> Response:
        """One image, as the body; or several, as the files of a form, which are answered in their order."""
        name = request.path_params.get("bundle") or next(iter(self.workers.scenes))
        try:
            response = JSONResponse(await self._answers(request, name))
        except HTTPException as error:
            response = await error_response(request, error)
        known = name if name in self.workers.scenes else ""
        self.metrics.requests.labels(known, response.status_code).inc()
        return response

    async def health(self, request: Request) -> Response:
        """What is served."""
        return JSONResponse({"status": "ok", "bundles": self.workers.scenes, "workers": self.workers.count})

    async def prometheus(self, request: Request) -> Response:
        """Figures in Prometheus' format."""
        self._check_token(request)
        return Response(generate_latest(self.metrics.registry), media_type=CONTENT_TYPE_LATEST)

    async def _answers(self, request: Request, name: str) -> Any:
        self._check_token(request)
        if name not in self.workers.scenes:
            raise HTTPException(
                404, f"bundle {name[:80]}: is not served. Choose one of {', '.join(self.workers.scenes)}."
            )
        if len(self.workers.scenes) > 1 and "bundle" not in request.path_params:
            names = ", ".join(f"/localize/{each}" for each in self.workers.scenes)
            raise HTTPException(404, f"/localize: several bundles are served. Choose one of {names}.")
        intrinsics = _intrinsics(request.query_params.get("intrinsics"))
        is_distorted = self._is_distorted(request.query_params.get("distorted"), intrinsics)
        is_form = request.headers.get("content-type", "").startswith(_MULTIPART)
        images = await _within(_BODY_S, self._images(request, is_form))
        if self.waiting + len(images) > self.limits.waiting:
            raise HTTPException(503, f"{self.waiting} images are waiting. Try again later.", {"Retry-After": "1"})
        answers = await asyncio.gather(
            *(self._localized(Task(name, each, intrinsics, is_distorted)) for each in images)
        )
        if is_form:
            return {"pictures": answers}
        if rule := answers[0].get("error"):
            raise HTTPException(422, rule)
        return answers[0]

    def _is_distorted(self, text: str | None, intrinsics: _Matrix | None) -> bool:
        """As a request says; unless it does, an image with intrinsics of its own is a pinhole's."""
        if text is None:
            return self.limits.is_distorted and intrinsics is None
        if text not in ("true", "false"):
            raise HTTPException(400, "distorted: give true or false.")
        if text == "true" and intrinsics is not None:
            raise HTTPException(400, "distorted: distorted images have the intrinsics of their lens. Leave out one.")
        return text == "true"

    async def _images(self, request: Request, is_form: bool) -> list[bytes]:
        if not is_form:
            return [b"".join([chunk async for chunk in self._limited(request)])]
        # The form's fields are files of any name; others are refused.
        parser = MultiPartParser(request.headers, self._limited(request), max_files=self.limits.pictures, max_fields=0)
        try:
            form = await parser.parse()
        except (MultiPartException, KeyError) as error:
            rule = getattr(error, "message", "no boundary is named")
            raise HTTPException(400, f"body: is not a form of at most {self.limits.pictures} files ({rule}).") from None
        files = [file for _, file in form.multi_items() if isinstance(file, UploadFile)]
        if not files:
            raise HTTPException(400, "body: the form contains no file. Give an image for each field.")
        try:
            return [await file.read() for file in files]
        finally:
            await form.close()

    async def _limited(self, request: Request) -> AsyncGenerator[bytes, None]:
        """The body in parts, until it is larger than may be; its headers may say anything."""
        size = 0
        async for chunk in request.stream():
            size += len(chunk)
            if size > self.limits.body_bytes:
                max_mib = self.limits.body_bytes / 2**20
                raise HTTPException(413, f"body: is larger than {max_mib:g} MiB. Give smaller images, or fewer.")
            yield chunk

    async def _localized(self, task: Task) -> Answer:
        began = time.perf_counter()
        self.waiting += 1
        self.metrics.waiting.set(self.waiting)
        try:
            answer = await self.workers.localize(task)
        except WorkerLostError:
            raise HTTPException(500, "image: no worker could localize it. Report it, with the image.") from None
        finally:
            self.waiting -= 1
            self.metrics.waiting.set(self.waiting)
        source = "error" if "error" in answer else answer["source"] or "none"
        self.metrics.pictures.labels(task.bundle, source).inc()
        self.metrics.seconds.labels(task.bundle).observe(time.perf_counter() - began)
        return answer

    def _check_token(self, request: Request) -> None:
        given = request.headers.get("authorization", "").removeprefix("Bearer ")
        if self.token is not None and not hmac.compare_digest(given.encode(), self.token.encode()):
            raise HTTPException(401, "Authorization: give Bearer and the token.", {"WWW-Authenticate": "Bearer"})


def create_app(workers: Workers, limits: Limits | None = None, token: str | None = None, host: str = "*") -> Starlette:
    """Make the application, for any ASGI server of one process.

    Args:
        workers: not yet started; they are started and stopped with the application.
        limits: of requests.
        token: that requests must carry, ``Authorization: Bearer TOKEN``; ``/health`` needs none.
        host: where it is served; on a loopback address, requests for another host are refused, so that no page of
            another site reaches it.
    """
    endpoints = _Endpoints(workers, limits or Limits(), token)

    @asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        await workers.start()
        try:
            yield
        finally:
            workers.stop()

    hosts = ["127.0.0.1", "localhost", "[::1]"] if host in LOOPBACK else ["*"]
    return Starlette(
        routes=[
            Route("/localize", endpoints.localize, methods=["POST"]),
            Route("/localize/{bundle}", endpoints.localize, methods=["POST"]),
            Route("/health", endpoints.health),
            Route("/metrics", endpoints.prometheus),
        ],
        middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=hosts, www_redirect=False)],
        exception_handlers={HTTPException: error_response},  # type: ignore[dict-item]
        lifespan=lifespan,
    )


def serve_bundles(
    bundles: Mapping[str, Path],
    host: str,
    port: int,
    count: int,
    limits: Limits | None = None,
    token: str | None = None,
) -> None:
    """Serve until Ctrl-C or the process is asked to end; requests in hand are answered first.

    Args:
        bundles: by name.
        host: address to listen at.
        port: 0 takes a free one.
        count: of worker processes.
        limits: of requests.
        token: that requests must carry.

    Raises:
        InputError: for a bundle that cannot be served, or that knows no lens where images are distorted; an address
            that cannot be listened at; or no token where others than this machine reach the server.
    """
    if token is None and host not in LOOPBACK:
        raise InputError(f"--host {host}: others may reach it, so a token is needed. Give --token-file FILE.")
    workers = Workers(bundles, count)
    if limits is not None and limits.is_distorted and workers.without_lens:
        names = ", ".join(workers.without_lens)
        raise InputError(f"--distorted: {names} does not know the lens of its camera. Leave --distorted out.")
    try:
        listening = socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
    except (OSError, OverflowError) as error:
        raise InputError(
            f"--host {host} --port {port}: cannot be opened ({error}). Choose another host or port."
        ) from None
    # asyncio does so for sockets of its own alone, and answers then wait 40 ms for what they acknowledge.
    listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    app = create_app(workers, limits, token, host)
    config = uvicorn.Config(app, log_level="warning", lifespan="on", server_header=False, timeout_keep_alive=30)
    with listening:
        shown = f"[{host}]" if ":" in host else host
        for name, scene in workers.scenes.items():
            print(f"http://{shown}:{listening.getsockname()[1]}/localize/{name}  ({scene})")
        print(f"{count} workers; /health, /metrics; Ctrl-C ends", flush=True)
        uvicorn.Server(config).run(sockets=[listening])


async def error_response(request: Request, error: HTTPException) -> JSONResponse:
    """A mistake as JSON."""
    return JSONResponse({"error": error.detail}, error.status_code, error.headers)


async def _within(seconds: float, coming: Any) -> Any:
    try:
        return await asyncio.wait_for(coming, seconds)
    except TimeoutError:
        raise HTTPException(408, f"body: did not come within {seconds:g} s.") from None
    except ClientDisconnect:
        raise HTTPException(400, "body: ended early.") from None


def _intrinsics(text: str | None) -> _Matrix | None:
    if text is None:
        return None
    try:
        matrix = pinhole_matrix(text)
    except ArgumentTypeError:
        raise HTTPException(400, "intrinsics: give FX,FY,CX,CY in pixels of the image.") from None
    if not np.isfinite(matrix).all():
        raise HTTPException(400, "intrinsics: give finite numbers.")
    return tuple(map(tuple, matrix.tolist()))
