"""tools/demo.py as a person starts it, and wrongly."""

import re
import runpy
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

TOOL = Path(__file__).parents[2] / "tools/demo.py"
pytestmark = pytest.mark.slow


@pytest.fixture
def demo(monkeypatch):
    """Runs the tool in this process."""

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["demo.py", *map(str, words)])
        runpy.run_path(str(TOOL), run_name="__main__")

    return run


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM])
def test_it_serves_until_it_is_ended(bundle, modules, ending, tmp_path, monkeypatch):
    """In a process of its own, and without torch, as the bundle is there."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    # A shell's background job ignores Ctrl-C, and so would what it starts.
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    program = f"import runpy, sys; sys.modules['torch'] = None; runpy.run_path({str(TOOL)!r}, run_name='__main__')"
    command = [sys.executable, "-c", program, str(bundle), "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    signal.signal(signal.SIGINT, handler)
    address = re.search(r"http://127\.0\.0\.1:\d+/", process.stdout.readline())[0]
    assert b"MambaLoc" in urllib.request.urlopen(address, timeout=10).read()
    process.send_signal(ending)
    _, said = process.communicate(timeout=30)
    assert process.returncode == 0
    assert said == ""
    assert not [path for path in tmp_path.iterdir() if path.is_dir()]  # the site is gone


def test_it_writes_the_page(demo, site, bundle, tmp_path, capsys):
    demo(bundle, "--out", tmp_path / "page")
    assert capsys.readouterr().out == f"wrote {tmp_path / 'page'}\n"
    assert (tmp_path / "page/index.html").is_file()
    assert (tmp_path / "page/film.json").read_text() == "null\n"  # it was filmed elsewhere


def test_unless_told_otherwise_it_shows_what_the_package_brings(demo, site, bundle, tmp_path, monkeypatch):
    monkeypatch.setattr("mambaloc.zoo.bundles.released_bundle", lambda: bundle)  # whose export is tested as a tool
    demo("--out", tmp_path / "page")
    for name in ("bundle/contract.json", "film.json", "film.webm"):
        assert (tmp_path / "page" / name).read_bytes() == (site / name).read_bytes()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["none"], "give a bundle's folder"),
        (["{bundle}", "--film", "none.mp4"], "none.mp4: no video"),
        (["{bundle}", "--film", ""], "no video"),
        (["{bundle}", "--port", "70000"], "from 0 to 65535"),
        (["{bundle}", "--out", "{bundle}"], "already exists"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(demo, site, bundle, words, message, capsys):
    handler = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as ended:
        demo(*(word.format(bundle=bundle) for word in words))
    signal.signal(signal.SIGTERM, handler)
    said = capsys.readouterr().err
    assert ended.value.code == 2
    assert message in said
    assert len(said.strip().splitlines()) == 1
