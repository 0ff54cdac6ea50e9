"""The demo's server under attack: endless requests, silent and slow clients, paths that lead out."""

import contextlib
import http.client
import socket
import threading
import time

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from mambaloc.demo import serve
from mambaloc.demo.server import _Handler

PAGE = b"<!doctype html><title>a page</title>"
SECRET = b"what nobody may read"


@pytest.fixture
def server(tmp_path):
    (tmp_path / "site/sub").mkdir(parents=True)
    (tmp_path / "site/index.html").write_bytes(PAGE)
    (tmp_path / "secret.txt").write_bytes(SECRET)
    with serve(tmp_path / "site", 0) as server:
        threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        yield server
        server.shutdown()


def sent(server, *pieces):
    """All that is answered to raw bytes, until the server hangs up."""
    answer, address = b"", ("127.0.0.1", server.server_port)
    hung_up = contextlib.suppress(ConnectionResetError, BrokenPipeError)  # on what it had not read
    with socket.create_connection(address, timeout=20) as connection, hung_up:
        for piece in pieces:
            connection.sendall(piece)
        while piece := connection.recv(1 << 16):
            answer += piece
    return answer


def assert_answers(server):
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=20)
    connection.request("GET", "/")
    assert connection.getresponse().read() == PAGE
    connection.close()


START = b"GET / HTTP/1.1\r\nHost: localhost\r\n"


@pytest.mark.parametrize(
    ("what", "pieces", "answers"),
    [
        ("an endless request line", [b"GET /" + b"a" * 10**7], {b"414", b""}),
        ("an endless header", [START, b"A: " + b"a" * 10**7], {b"431", b""}),
        ("endless headers", [START, *[b"A: b\r\n"] * 10**5, b"\r\n"], {b"431", b""}),
        ("a large body", [START + b"Content-Length: 10000000\r\n\r\n", b"a" * 10**7], {b"200", b""}),
        ("a large body to take", [START.replace(b"GET", b"PUT") + b"\r\n", b"a" * 10**7], {b"501", b""}),
        ("another protocol", [b"\x16\x03\x01" + b"\0" * 10**5], {b"400", b"414", b""}),
    ],
)
def test_requests_without_end(what, pieces, answers, server, tally):
    answer = sent(server, *pieces)
    assert len(answer) < 10_000
    assert answer[9:12] in answers if answer.startswith(b"HTTP/1.1 ") else b"400" in answer or not answer
    assert_answers(server)
    tally(f"demo: {what}", "refused, or hung up on")


@pytest.mark.parametrize("said", [b"", b"GET / HTTP/1.1\r\nHo"], ids=["silent", "half-way"])
def test_many_who_never_finish(said, server, tally, monkeypatch):
    monkeypatch.setattr(_Handler, "timeout", 1)
    before, address = threading.active_count(), ("127.0.0.1", server.server_port)
    crowd = [socket.create_connection(address, timeout=20) for _ in range(50)]
    for connection in crowd:
        connection.sendall(said)
    assert_answers(server)
    for connection in crowd:
        assert connection.recv(1) == b""  # hung up on
        connection.close()
    deadline = time.monotonic() + 20
    while threading.active_count() > before and time.monotonic() < deadline:
        time.sleep(0.05)
    assert threading.active_count() <= before
    tally(f"demo: {len(crowd)} clients that are {'slow' if said else 'silent'}", "hung up on in time, others served")


def test_no_path_leads_out(server, tries, tally):
    parts = st.sampled_from(["..", "%2e%2e", "%2E.", ".", "", "sub", "secret.txt", "%00", "%5c", "..%2f", "..%5c", "~"])

    @settings(max_examples=max(100, tries), deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(st.lists(parts, min_size=1, max_size=6).map("/".join))
    @example("../secret.txt")
    @example("..%2fsecret.txt")
    def attacked(path):
        answer = sent(server, f"GET /{path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n".encode())
        assert SECRET not in answer
        assert answer.startswith(b"HTTP/1.1 ")
        tally("demo: paths that may lead out", "refused" if answer[9:10] == b"4" else "inside, or moved there")

    attacked()
    assert_answers(server)
