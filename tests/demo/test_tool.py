"""tools/demo.py as a person starts it, and wrongly."""

import re
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

TOOL = Path(__file__).parents[2] / "tools/demo.py"
pytestmark = pytest.mark.slow


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM])
def test_it_serves_until_it_is_ended(site, ending, tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    # A shell's background job ignores Ctrl-C, and so would what it starts.
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    command = [sys.executable, str(TOOL), "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    signal.signal(signal.SIGINT, handler)
    address = re.search(r"http://127\.0\.0\.1:\d+/", process.stdout.readline())[0]
    assert b"MambaLoc" in urllib.request.urlopen(address, timeout=10).read()
    process.send_signal(ending)
    _, said = process.communicate(timeout=30)
    assert process.returncode == 0
    assert said == ""
    assert not [path for path in tmp_path.iterdir() if path.is_dir()]  # the site is gone


def test_it_writes_the_page(site, bundle, tmp_path):
    command = [sys.executable, str(TOOL), str(bundle), "--out", str(tmp_path / "page")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, f"wrote {tmp_path / 'page'}\n")
    assert (tmp_path / "page/index.html").is_file()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["none"], "give a bundle's folder"),
        (["{bundle}", "--film", "none.mp4"], "none.mp4: no film"),
        (["{bundle}", "--film", ""], "no film"),
        (["{bundle}", "--port", "70000"], "ports go from 0 to 65535"),
        (["{bundle}", "--out", "{bundle}"], "is there already"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(site, bundle, words, message):
    command = [sys.executable, str(TOOL), *(word.format(bundle=bundle) for word in words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
