"""A server of two bundles, asked over HTTP as clients do."""

import http.client
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import event_loop
import numpy as np
import pytest

from mambaloc.images import read_image
from mambaloc.runtime import Localizer
from mambaloc.serving.workers import Task, WorkerLostError, Workers

TOKEN = "a token of the tests"
COMMAND = [sys.executable, "-c", "from mambaloc.commands.serve import main; main()"]
finds_workers = pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds the workers in /proc")

INTRINSICS = ((90.0, 0, 63.5), (0, 90.0, 47.5), (0, 0, 1))


@pytest.fixture(scope="module")
def bundles(tmp_path_factory, bundle_of_tensors, bundles_for_lenses):
    folder = tmp_path_factory.mktemp("bundles")
    shutil.copytree(bundle_of_tensors, folder / "den")
    shutil.copytree(bundles_for_lenses / "pictures", folder / "lenses")
    return folder


@pytest.fixture(scope="module")
def server(bundles, tmp_path_factory):
    """The port, and the process."""
    token = tmp_path_factory.mktemp("token") / "token"
    token.write_text(f"{TOKEN}\n")
    options = ["--port", "0", "--workers", "2", "--megabytes", "1", "--token-file", str(token)]
    command = [*COMMAND, str(bundles / "den"), str(bundles / "lenses"), *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        port = int(re.search(r":(\d+)/localize/den", process.stdout.readline())[1])
        wait_until_up(port)
        yield port, process
        process.send_signal(signal.SIGINT)
        assert process.wait(30) in (0, 130)
        assert "Traceback" not in process.stderr.read()


def wait_until_up(port):
    for _ in range(300):
        try:
            if ask(port, "/health", method="GET")[0] == 200:
                return
        except OSError:
            time.sleep(0.1)
    raise AssertionError("the server does not come up")


def ask(port, path, body=None, headers=None, method="POST", token=TOKEN):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    try:
        connection.request(method, path, body, {"Authorization": f"Bearer {token}", **(headers or {})})
        answer = connection.getresponse()
        text = answer.read().decode()
    finally:
        connection.close()
    return answer.status, json.loads(text) if text.startswith("{") else text


@pytest.fixture(scope="module")
def frame(bundles):
    return sorted((bundles / "den/frames").glob("*.png"))[0]


def form_of(*pictures: bytes):
    """A form as browsers send it, and its headers."""
    parts = [
        b'--line\r\nContent-Disposition: form-data; name="p%d"; filename="p"\r\n\r\n%b\r\n' % (row, each)
        for row, each in enumerate(pictures)
    ]
    return b"".join(parts) + b"--line--\r\n", {"Content-Type": "multipart/form-data; boundary=line"}


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_the_pose_is_that_of_a_localizer_here(server, bundles, frame, suffix):
    data = cv2.imencode(suffix, cv2.cvtColor(read_image(frame), cv2.COLOR_RGB2BGR))[1].tobytes()
    picture = cv2.cvtColor(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
    expected = Localizer(bundles / "den", threads=1).localize(picture)
    status, found = ask(server[0], "/localize/den", data)
    assert status == 200
    assert (found["bundle"], found["source"]) == ("den", "network")
    np.testing.assert_allclose(found["position_m"], expected.position_m, atol=1e-5)
    np.testing.assert_allclose(found["quaternion_wxyz"], expected.quaternion, atol=1e-5)


def test_intrinsics_reach_the_network(server, bundles):
    picture = sorted((bundles / "lenses/frames").glob("*.png"))[0]
    localizer = Localizer(bundles / "lenses", threads=1)
    poses = []
    for query, intrinsics in (("", None), ("?intrinsics=90,90,63.5,47.5", INTRINSICS)):
        status, found = ask(server[0], f"/localize/lenses{query}", picture.read_bytes())
        assert status == 200, found
        np.testing.assert_allclose(found["position_m"], localizer.localize(picture, intrinsics).position_m, atol=1e-4)
        poses.append(found["quaternion_wxyz"])
    assert np.abs(np.subtract(*poses)).max() > 1e-3


def test_a_form_is_answered_in_order_and_a_bad_picture_spoils_no_other(server, frame):
    alone = ask(server[0], "/localize/den", frame.read_bytes())[1]
    body, headers = form_of(frame.read_bytes(), b"no image", frame.read_bytes())
    status, found = ask(server[0], "/localize/den", body, headers)
    first, second, third = found["pictures"]
    assert status == 200
    assert second == {"error": "image cannot be decoded"}
    assert first["position_m"] == third["position_m"] == alone["position_m"]


@pytest.mark.parametrize(
    ("path", "body", "headers", "status", "said"),
    [
        ("/localize/den", b"", {}, 422, "image cannot be decoded"),
        ("/localize/den", b"GIF89a and text", {}, 422, "image cannot be decoded"),
        ("/localize/den", "half", {}, 422, "image is truncated"),
        ("/localize/den", bytes(2**20 + 1), {}, 413, "body: is larger than 1 MiB. Give smaller images, or fewer."),
        ("/localize/den", "endless", {}, 413, "body: is larger than 1 MiB. Give smaller images, or fewer."),
        ("/localize/den", b"x", {"Content-Type": "multipart/form-data"}, 400, "body: is not a form of at most 32"),
        ("/localize/den", *form_of(), 400, "body: the form contains no file"),
        ("/localize/den", *form_of(*[b"x"] * 33), 400, "Too many files"),
        ("/localize/den?intrinsics=1,2", b"", {}, 400, "intrinsics: give FX,FY,CX,CY in pixels of the image."),
        ("/localize/den?intrinsics=1,2,nan,4", b"", {}, 400, "intrinsics: give finite numbers."),
        ("/localize/lenses?intrinsics=1,1,1,1", "frame", {}, 422, "intrinsics"),
        ("/localize/cellar", b"", {}, 404, "bundle cellar: is not served. Choose one of den, lenses."),
        ("/localize", b"", {}, 404, "Choose one of /localize/den, /localize/lenses."),
        ("/", b"", {}, 404, "Not Found"),
    ],
)  # fmt: skip
def test_what_is_no_request_is_told_in_a_line(server, frame, path, body, headers, status, said):
    named = {
        "half": frame.read_bytes()[:300],
        "frame": frame.read_bytes(),
        "endless": (bytes(2**16) for _ in range(64)),
    }
    try:
        found, answer = ask(server[0], path, named.get(body, body), headers)
    except (BrokenPipeError, ConnectionResetError):  # the server did not wait for the rest
        assert status == 413
    else:
        assert found == status
        assert said in answer["error"]
        assert "\n" not in answer["error"]
    assert ask(server[0], "/localize/den", frame.read_bytes())[0] == 200


def test_the_token_and_the_host_are_asked_for(server, frame):
    port, data = server[0], frame.read_bytes()
    assert ask(port, "/localize/den", data, token="another token")[0] == 401
    assert ask(port, "/metrics", method="GET", token="")[0] == 401
    assert ask(port, "/health", method="GET", token="")[1]["bundles"].keys() == {"den", "lenses"}
    assert ask(port, "/localize/den", data, {"Host": "elsewhere.example"})[0] == 400
    assert ask(port, "/localize/den", method="GET")[0] == 405


def test_prometheus_is_told(server, frame):
    before = figure(server[0], 'mambaloc_pictures_total{bundle="den",source="network"}')
    assert ask(server[0], "/localize/den", frame.read_bytes())[0] == 200
    assert figure(server[0], 'mambaloc_pictures_total{bundle="den",source="network"}') == before + 1
    assert figure(server[0], "mambaloc_pictures_waiting") == 0
    assert figure(server[0], "mambaloc_workers") == 2


def figure(port, name):
    lines = ask(port, "/metrics", method="GET")[1].splitlines()
    return next((float(line.removeprefix(name)) for line in lines if line.startswith(f"{name} ")), 0.0)


@finds_workers
def test_no_request_is_lost_where_workers_are_killed(server, frame):
    port, process = server
    data = frame.read_bytes()
    with ThreadPoolExecutor(8) as clients:
        answers = [clients.submit(ask, port, "/localize/den", data) for _ in range(400)]
        for _ in range(3):
            time.sleep(0.2)
            os.kill(workers_of(process.pid)[0], signal.SIGKILL)
        assert {each.result()[0] for each in answers} == {200}
    assert figure(port, "mambaloc_workers_replaced") >= 1
    for _ in range(100):
        if len(workers_of(process.pid)) == 2:
            return
        time.sleep(0.1)
    raise AssertionError("a worker was not replaced")


def workers_of(server):
    children = [
        word for task in Path(f"/proc/{server}/task").iterdir() for word in (task / "children").read_text().split()
    ]
    return [int(each) for each in children if b"spawn_main" in Path(f"/proc/{each}/cmdline").read_bytes()]


@finds_workers
def test_a_worker_that_hangs_is_replaced_and_its_picture_tried_again(bundles, frame):
    async def localize():
        workers = Workers({"den": bundles / "den"}, 1, seconds=1.0)
        await workers.start()
        try:
            os.kill(workers_of(os.getpid())[0], signal.SIGSTOP)
            return await workers.localize(Task("den", frame.read_bytes())), workers.replaced
        finally:
            workers.stop()

    answer, replaced = event_loop.run(localize())
    assert answer["source"] == "network"
    assert replaced == 1


def test_a_picture_that_ends_every_worker_is_given_up(bundles, frame, monkeypatch):
    async def localize():
        workers = Workers({"den": bundles / "den"}, 1)
        await workers.start()
        monkeypatch.setattr("mambaloc.serving.workers._Worker.ask", lambda worker, task: ended(worker))
        try:
            with pytest.raises(WorkerLostError):
                await workers.localize(Task("den", frame.read_bytes()))
            return workers.replaced
        finally:
            workers.stop()

    def ended(worker):
        raise WorkerLostError

    assert event_loop.run(localize()) == 3


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nowhere"], "nowhere: "),
        (["{den}", "--host", "0.0.0.0"], "--host 0.0.0.0: others may reach it, so a token is needed."),
        (["{den}", "--host", "0.0.0.0", "--token-file", "{short}"], "is not a token of 16 characters or more."),
        (["{den}", "--distorted"], "--distorted: den does not know the lens of its camera. Leave --distorted out."),
        (["{den}", "{den}"], "has the same name, den, as "),
        (["{den}", "--port", "70000"], "--port: 70000: give a whole number from 0 to 65535"),
        (["{den}", "--host", "no.such.host.example", "--token-file", "{token}"], "cannot be opened"),
    ],
)
def test_wrong_uses_end_with_a_line(bundles, tmp_path, arguments, said):
    (tmp_path / "short").write_text("abc")
    (tmp_path / "token").write_text(TOKEN)
    files = {"den": bundles / "den", "short": tmp_path / "short", "token": tmp_path / "token"}
    command = [*COMMAND, *(each.format(**files) for each in arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert said in done.stderr
    assert done.stderr.count("\n") == 1
