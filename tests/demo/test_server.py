"""The server: this machine alone, its folder alone; by HTTPS for the network."""

import http.client
import socket
import ssl
import sys
from datetime import UTC, datetime, timedelta

import cv2
import numpy as np
import pytest
from cryptography import x509

from mambaloc.demo import serve
from mambaloc.demo.lan import lan_address, qr_code, self_signed
from mambaloc.errors import InputError

PAGE = "<!doctype html><title>a page</title>"


@pytest.fixture
def folder(tmp_path):
    site = tmp_path / "site"
    (site / "sub").mkdir(parents=True)
    (site / "index.html").write_text(PAGE)
    (site / "sub/a.mjs").write_text("1")
    (site / "m.wasm").write_bytes(b"\0asm")
    (tmp_path / "secret.txt").write_text("secret")
    return site


def asked(server, path, method="GET", **headers):
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)
    connection.request(method, path, headers=headers)
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer, body


def test_files_come_with_what_threads_and_safety_need(folder, served):
    with served(folder) as server:
        answer, body = asked(server, "/")
        assert (answer.status, body.decode()) == (200, PAGE)
        assert answer.headers["Cross-Origin-Opener-Policy"] == "same-origin"
        assert answer.headers["Cross-Origin-Embedder-Policy"] == "require-corp"
        policy = answer.headers["Content-Security-Policy"]
        assert "default-src 'self'" in policy
        assert "script-src 'self' 'wasm-unsafe-eval';" in policy
        assert asked(server, "/sub/a.mjs")[0].headers["Content-Type"] == "text/javascript"
        assert asked(server, "/m.wasm")[0].headers["Content-Type"] == "application/wasm"


@pytest.mark.parametrize(
    "path",
    [
        "/../secret.txt",
        "/%2e%2e/secret.txt",
        "/..%2fsecret.txt",
        "/sub/../../secret.txt",
        "//secret.txt",
        "/%5c..%5csecret.txt",
        "/sub/",
        "/sub",
        "/nothing",
        "/%00",
    ],
)
def test_nothing_outside_and_no_listing(folder, path, served):
    with served(folder) as server:
        answer, body = asked(server, path)
        assert answer.status in (301, 404)
        assert b"secret" not in body
        assert b"a.mjs" not in body


def test_a_link_leads_nowhere_else(folder, served):
    (folder / "link").symlink_to(folder.parent / "secret.txt")
    with served(folder) as server:
        assert asked(server, "/link")[0].status == 404


@pytest.mark.parametrize(("host", "status"), [("evil.example", 403), ("evil.example:80", 403), ("localhost:1", 200)])
def test_no_other_name_leads_here(folder, host, status, served):
    with served(folder) as server:
        assert asked(server, "/index.html", Host=host)[0].status == status


def test_only_reading_is_answered(folder, served):
    with served(folder) as server:
        for method in ("POST", "PUT", "DELETE"):
            assert asked(server, "/", method)[0].status == 501


def test_it_listens_to_this_machine_alone(folder, served):
    with served(folder) as server:
        assert server.server_address[0] == "127.0.0.1"


def test_a_port_that_cannot_be_had(folder):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        with pytest.raises(InputError, match=r"--port \d+: cannot be opened .*; choose another"):
            serve(folder, other.getsockname()[1])
    with pytest.raises(InputError, match="from 0 to 65535"):
        serve(folder, 70000)


# --- on the network ---------------------------------------------------------------------------------------------------


def test_https_by_a_certificate_of_the_address(folder, tmp_path, monkeypatch, served):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    with served(folder, tls=self_signed("127.0.0.1")) as server:
        address = ("127.0.0.1", server.server_port)
        pem = ssl.get_server_certificate(address, timeout=10)
        trusting = ssl.create_default_context(cadata=pem)  # checks the address and the dates
        with (
            socket.create_connection(address) as plain,
            trusting.wrap_socket(plain, server_hostname="127.0.0.1") as tls,
        ):
            tls.sendall(b"GET / HTTP/1.0\r\nHost: 127.0.0.1\r\n\r\n")
            assert tls.recv(64).startswith(b"HTTP/1.1 200")
    certificate = x509.load_pem_x509_certificate(pem.encode())
    lasts = certificate.not_valid_after_utc - datetime.now(UTC)
    assert timedelta(days=1) < lasts < timedelta(days=8)
    assert not list((tmp_path / "temporary").iterdir())  # no key is left


def test_two_certificates_have_two_keys(folder, served):
    pems = []
    for _ in range(2):
        with served(folder, tls=self_signed("127.0.0.1")) as server:
            pems.append(ssl.get_server_certificate(("127.0.0.1", server.server_port), timeout=10))
    first, second = (x509.load_pem_x509_certificate(pem.encode()).public_key() for pem in pems)
    assert first != second


def test_who_does_not_speak_tls_stops_nobody(folder, served):
    with served(folder, tls=self_signed("127.0.0.1")) as server:
        address = ("127.0.0.1", server.server_port)
        silent, rude = socket.create_connection(address), socket.create_connection(address)
        rude.sendall(b"GET / HTTP/1.0\r\n\r\n")
        assert ssl.get_server_certificate(address, timeout=10)
        silent.close()
        rude.close()


def test_the_code_says_the_address():
    """Read back by OpenCV from the blocks that the terminal shows; dark modules are the terminal's background."""
    halves = {" ": (0, 0), "▀": (1, 0), "▄": (0, 1), "█": (1, 1)}
    rows = []
    for line in qr_code("https://192.168.1.20:8000/").splitlines():
        rows += [[halves[block][half] for block in line] for half in (0, 1)]
    picture = np.kron(np.array(rows, np.uint8) * 255, np.ones((8, 8), np.uint8))
    assert cv2.QRCodeDetector().detectAndDecode(picture)[0] == "https://192.168.1.20:8000/"


def test_without_the_extra_its_name_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "cryptography", None)
    monkeypatch.setitem(sys.modules, "segno", None)
    for call in (lambda: self_signed("127.0.0.1"), lambda: qr_code("a")):
        with pytest.raises(InputError, match=r"pip install 'mambaloc\[lan\]'"):
            call()


def test_the_address_is_one_of_this_machine():
    try:
        address = lan_address()
    except InputError:
        pytest.skip("this machine has no network")
    with socket.socket() as here:
        here.bind((address, 0))
