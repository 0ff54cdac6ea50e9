"""Folders that are whole or not there, and made once by whoever comes first."""

import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path

import pytest

from mambaloc.errors import InputError
from mambaloc.files import atomic_folder, path_inside, read_json
from mambaloc.user_cache import cached_folder


def test_a_folder_gets_its_name_when_it_is_whole(tmp_path):
    with atomic_folder(tmp_path / "new/a", "choose another") as partial:
        (partial / "file").write_text("1")
        assert not (tmp_path / "new/a").exists()
    assert (tmp_path / "new/a/file").read_text() == "1"
    assert (tmp_path / "new/a").stat().st_mode & 0o777 == 0o755


def test_an_error_leaves_nothing(tmp_path):
    with suppress(ValueError), atomic_folder(tmp_path / "a", "choose another") as partial:
        (partial / "file").write_text("1")
        raise ValueError("half-way")
    assert not list(tmp_path.iterdir())


def test_two_writers_do_not_meet(tmp_path):
    slower = atomic_folder(tmp_path / "a", "choose another")
    (slower.__enter__() / "second").write_text("2")
    with atomic_folder(tmp_path / "a", "choose another") as faster:
        assert not list(faster.iterdir())
        (faster / "first").write_text("1")
    with pytest.raises(InputError, match=r"a: .*; choose another"):
        slower.__exit__(None, None, None)
    assert [file.relative_to(tmp_path).as_posix() for file in sorted(tmp_path.rglob("*"))] == ["a", "a/first"]


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    with pytest.raises(InputError, match=r"none\.txt: No such file"), atomic_folder(tmp_path / "a", "choose another"):
        (tmp_path / "none.txt").read_text()


def test_a_folder_of_the_cache_is_made_once(tmp_path, monkeypatch):
    monkeypatch.setenv("MAMBALOC_CACHE", str(tmp_path))
    calls, may_go_on = [], threading.Event()

    def make(partial):
        calls.append(partial)
        may_go_on.wait(10)
        (partial / "file").write_text("1")

    found = []
    threads = [threading.Thread(target=lambda: found.append(cached_folder("kind/a", make))) for _ in range(3)]
    for thread in threads:
        thread.start()
    may_go_on.set()
    for thread in threads:
        thread.join()
    assert found == [tmp_path / "kind/a"] * 3
    assert len(calls) == 1
    assert cached_folder("kind/a", make) == tmp_path / "kind/a"


def test_a_killed_maker_leaves_nothing_that_is_found(tmp_path, monkeypatch):
    monkeypatch.setenv("MAMBALOC_CACHE", str(tmp_path))
    program = (
        "import os, signal; from mambaloc.user_cache import cached_folder\n"
        "cached_folder('a', lambda p: ((p / 'half').write_text('1'), os.kill(os.getpid(), signal.SIGKILL)))"
    )
    subprocess.run([sys.executable, "-c", program], check=False)
    assert not (tmp_path / "a").exists()
    assert [f.name for f in cached_folder("a", lambda p: (p / "whole").write_text("1")).iterdir()] == ["whole"]


def test_a_cache_that_cannot_be_written(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("MAMBALOC_CACHE", str(tmp_path / "file"))
    with pytest.raises(InputError, match="set MAMBALOC_CACHE"):
        cached_folder("kind/a", lambda partial: None)


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("images/a.png", "images/a.png"),
        ("./images/a b.png", "images/a b.png"),
        ("images\\a.png", "images/a.png"),
        ("..a/b..png", "..a/b..png"),
        ("../a.png", None),
        ("images/../../a.png", None),
        ("images\\..\\a.png", None),
        ("/a.png", None),
        ("\\a.png", None),
        ("C:\\a.png", None),
        ("C:a.png", None),
        (".", None),
        ("", None),
        ("a\0.png", None),
        ("a" * 256, None),
        ("a/" * 600, None),
        ("\ud800.png", None),
    ],
)
def test_a_name_in_a_file_stays_inside_of_the_folder(name, found):
    assert path_inside(Path("f"), name) == (Path("f", found) if found else None)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "cannot be read .*; add it"),
        *((each, "is not JSON .*; repair it") for each in (b"{", b"\xff\xfe", b"9" * 5000, b"[" * 100_000)),
    ],
)
def test_what_is_no_json(content, message, tmp_path):
    path = tmp_path / "a.json"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        read_json(path, "add it", "repair it")
    assert "\n" not in str(caught.value)


def test_json_that_is_too_large(tmp_path, monkeypatch):
    (tmp_path / "a.json").write_text("[1, 2, 3]")
    assert read_json(tmp_path / "a.json", "add it", "repair it") == [1, 2, 3]
    monkeypatch.setattr("mambaloc.files._MAX_JSON_BYTES", 5)
    with pytest.raises(InputError, match="larger than 5 bytes; repair it"):
        read_json(tmp_path / "a.json", "add it", "repair it")
