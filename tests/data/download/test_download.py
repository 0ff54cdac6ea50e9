"""Downloads from a server of our own: resumed, checked, unpacked whole or not at all, refused in one line."""

from __future__ import annotations

import hashlib
import io
import json
import os
import random
import re
import socket
import stat
import subprocess
import sys
import threading
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from filelock import FileLock

from mambaloc.data.datasets.cambridge import SOURCE as CAMBRIDGE
from mambaloc.data.datasets.dataset import Archive, Source
from mambaloc.data.datasets.registry import SOURCES, describe_sources, how_to_get
from mambaloc.data.datasets.seven_scenes import SOURCE as SEVENSCENES
from mambaloc.data.download import download
from mambaloc.data.download import scene as download_module
from mambaloc.data.download.archives import require_space, unpack
from mambaloc.data.download.fetch import fetch
from mambaloc.errors import InputError

REPOSITORY = Path(__file__).parents[3]


@dataclass
class Shelf:
    """One file on the test server, and how badly the server behaves about it."""

    body: bytes
    etag: str | None = '"v1"'
    date: str | None = None
    ranges: bool = True
    heeds_if_range: bool = True
    tells_length: bool = True
    cuts: list[int] = field(default_factory=list)  # bytes after which each coming answer breaks off
    codes: list[int] = field(default_factory=list)  # errors that come first
    content_type: str = "application/zip"
    asked: list[str | None] = field(default_factory=list)  # Range headers seen
    served: int = 0


class Handler(BaseHTTPRequestHandler):
    def log_message(self, *args: object) -> None:
        pass

    def do_GET(self) -> None:
        shelf: Shelf | None = self.server.shelves.get(self.path)  # type: ignore[attr-defined]
        if shelf is None or shelf.codes:
            return self.send_error(shelf.codes.pop(0) if shelf else 404)
        wanted = self.headers.get("Range")
        shelf.asked.append(wanted)
        same = self.headers.get("If-Range") in (None, shelf.etag, shelf.date) or not shelf.heeds_if_range
        start = int(wanted[6:-1]) if wanted and shelf.ranges and same else 0
        if start > len(shelf.body):
            return self.send_error(416)
        rest = shelf.body[start:]
        self.send_response(206 if start else 200)
        self.send_header("Content-Type", shelf.content_type)
        if shelf.tells_length:
            self.send_header("Content-Length", str(len(rest)))
        if start:
            self.send_header("Content-Range", f"bytes {start}-{len(shelf.body) - 1}/{len(shelf.body)}")
        for name, value in (("ETag", shelf.etag), ("Last-Modified", shelf.date)):
            if value:
                self.send_header(name, value)
        self.end_headers()
        sent = rest[: shelf.cuts.pop(0)] if shelf.cuts else rest
        self.wfile.write(sent)
        shelf.served += len(sent)
        if len(sent) < len(rest):
            self.wfile.flush()
            self.connection.shutdown(socket.SHUT_RDWR)


@dataclass
class Server:
    address: str
    shelves: dict[str, Shelf]

    def source(self, body: bytes, scene: str = "heads", like: Source = SEVENSCENES, **known: object) -> Source:
        self.shelves[f"/{scene}.zip"] = Shelf(body)
        return replace(like, archives={scene: Archive((f"{self.address}/{scene}.zip",), **known)})  # type: ignore[arg-type]


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    httpd = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    httpd.shelves = {}  # type: ignore[attr-defined]
    thread = threading.Thread(target=httpd.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield Server(f"http://127.0.0.1:{httpd.server_port}", httpd.shelves)  # type: ignore[attr-defined]
    httpd.shutdown()
    thread.join()
    httpd.server_close()


def zipped(members: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return buffer.getvalue()


NOISE = random.Random(0).randbytes(300_000)
HEADS = zipped(
    {
        "heads/TrainSplit.txt": b"sequence2\r\n",
        "heads/TestSplit.txt": b"sequence1\r\n",
        "heads/seq-01.zip": zipped({"seq-01/frame-000000.color.png": NOISE[:100_000], "seq-01/Thumbs.db": b"litter"}),
        "heads/seq-02.zip": zipped({"seq-02\\frame-000000.color.png": NOISE[100_000:]}),
    }
)
HEADS_FILES = {
    "TestSplit.txt",
    "TrainSplit.txt",
    "seq-01/frame-000000.color.png",
    "seq-02/frame-000000.color.png",
}


def files_in(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def left_in(root: Path) -> set[str]:
    return {path.name for path in root.iterdir() if path.suffix != ".lock"}


def get(source: Source, root: Path, scene: str = "heads", **options: object) -> list[Path]:
    return download(source, scene, root, pause_s=0.0, **options)  # type: ignore[arg-type]


def test_a_scene_comes_whole_with_licence_and_record(
    server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = server.source(HEADS, size_bytes=len(HEADS), sha256=hashlib.sha256(HEADS).hexdigest())
    assert get(source, tmp_path) == [tmp_path / "heads"]
    assert files_in(tmp_path / "heads") == HEADS_FILES
    assert (tmp_path / "heads/seq-02/frame-000000.color.png").read_bytes() == NOISE[100_000:]
    assert left_in(tmp_path) == {"heads", "heads.download.json"}
    record = json.loads((tmp_path / "heads.download.json").read_text())
    assert record["sha256"] == hashlib.sha256(HEADS).hexdigest()
    assert record["size_bytes"] == len(HEADS)
    assert record["url"] == f"{server.address}/heads.zip"
    assert record["date"].endswith("+00:00")
    said = capsys.readouterr().out
    assert said.index("Microsoft 7-Scenes licence: non-commercial research") < said.index("heads is ready")
    assert SEVENSCENES.page in said


def test_a_second_call_does_nothing(server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = server.source(HEADS)
    get(source, tmp_path)
    served = server.shelves["/heads.zip"].served
    capsys.readouterr()
    get(source, tmp_path)
    assert server.shelves["/heads.zip"].served == served
    assert capsys.readouterr().out == f"{tmp_path / 'heads'} is complete: nothing to do\n"


def test_cambridge_with_and_without_a_top_folder(server: Server, tmp_path: Path) -> None:
    header = b"Visual Landmark Dataset V1\nImageFile, Camera Position [X Y Z W P Q R]\n\n"
    lists = {"dataset_train.txt": header + b"seq2/frame00001.png 0 0 0 1 0 0 0\n", "dataset_test.txt": header}
    scene = {**lists, "seq2/frame00001.png": b"png"}
    for name, members in (("ShopFacade", scene), ("Street", {f"Street/{k}": v for k, v in scene.items()})):
        source = server.source(zipped(members, zipfile.ZIP_DEFLATED), name, CAMBRIDGE)
        get(source, tmp_path, name)
        assert files_in(tmp_path / name) == set(scene)
        assert source.missing(tmp_path / name) is None


@pytest.mark.parametrize("tags", [{}, {"etag": None, "date": "Tue, 01 Jan 2013 00:00:00 GMT"}])
def test_a_dropped_connection_is_resumed(server: Server, tmp_path: Path, tags: dict[str, str | None]) -> None:
    source = server.source(HEADS)
    shelf = server.shelves["/heads.zip"] = replace(Shelf(HEADS, cuts=[100_000, 50_000]), **tags)  # type: ignore[arg-type]
    get(source, tmp_path)
    assert shelf.asked == [None, "bytes=100000-", "bytes=150000-"]
    assert shelf.served == len(HEADS)
    assert files_in(tmp_path / "heads") == HEADS_FILES


def test_a_later_run_resumes_what_an_earlier_one_left(server: Server, tmp_path: Path) -> None:
    source = server.source(HEADS)
    shelf = server.shelves["/heads.zip"] = Shelf(HEADS, cuts=[100_000, 0, 0, 0, 0, 0])
    with pytest.raises(InputError, match=r"broke off at byte 100000 of .* 5 times in a row; run this again to resume"):
        get(source, tmp_path)
    assert (tmp_path / "heads.zip.part").stat().st_size == 100_000
    get(source, tmp_path)
    assert shelf.served == len(HEADS)
    assert left_in(tmp_path) == {"heads", "heads.download.json"}


@pytest.mark.parametrize("shelf", [Shelf(HEADS, ranges=False), Shelf(HEADS, etag=None), Shelf(HEADS, etag='W/"v1"')])
def test_a_server_that_cannot_resume_restarts_from_zero(server: Server, tmp_path: Path, shelf: Shelf) -> None:
    source = server.source(HEADS)
    server.shelves["/heads.zip"] = replace(shelf, cuts=[100_000])
    get(source, tmp_path)
    assert server.shelves["/heads.zip"].served == len(HEADS) + 100_000
    assert files_in(tmp_path / "heads") == HEADS_FILES


def test_an_endless_restart_is_given_up(server: Server, tmp_path: Path) -> None:
    source = server.source(HEADS)
    server.shelves["/heads.zip"] = Shelf(HEADS, ranges=False, cuts=[100_000] * 50)
    with pytest.raises(InputError, match="5 times in a row"):
        get(source, tmp_path)
    assert len(server.shelves["/heads.zip"].asked) == 6


@pytest.mark.parametrize("heeds_if_range", [True, False])
def test_a_file_changed_between_attempts_restarts(server: Server, tmp_path: Path, heeds_if_range: bool) -> None:
    source = server.source(HEADS)
    server.shelves["/heads.zip"] = Shelf(NOISE * 2, etag='"old"', cuts=[100_000, 0, 0, 0, 0, 0])
    with pytest.raises(InputError):
        get(source, tmp_path)
    shelf = server.shelves["/heads.zip"] = Shelf(HEADS, etag='"new"', heeds_if_range=heeds_if_range)
    get(source, tmp_path)
    assert shelf.asked == ["bytes=100000-"] + [None] * (not heeds_if_range)
    assert files_in(tmp_path / "heads") == HEADS_FILES


def test_a_partial_file_longer_than_the_servers_restarts(server: Server, tmp_path: Path) -> None:
    server.shelves["/f"] = Shelf(NOISE[:100], heeds_if_range=False)
    state = {"url": f"{server.address}/f", "size_bytes": 900, "tag": '"v1"'}
    (tmp_path / "f.part").write_bytes(b"x" * 500)
    (tmp_path / "f.part.json").write_text(json.dumps(state))
    fetch([state["url"]], tmp_path / "f", pause_s=0.0)  # type: ignore[list-item]
    assert (tmp_path / "f").read_bytes() == NOISE[:100]


def test_a_whole_partial_file_needs_no_server(tmp_path: Path) -> None:
    (tmp_path / "f.part").write_bytes(b"whole")
    (tmp_path / "f.part.json").write_text(json.dumps({"url": "http://127.0.0.1:1/f", "size_bytes": 5, "tag": None}))
    fetch(["http://127.0.0.1:1/f"], tmp_path / "f", pause_s=0.0)
    assert left_in(tmp_path) == {"f"}


def test_the_partial_file_of_another_address_is_not_taken_for_this_ones(server: Server, tmp_path: Path) -> None:
    server.shelves["/f"] = Shelf(NOISE[:100])
    (tmp_path / "f.part").write_bytes(b"whole")
    (tmp_path / "f.part.json").write_text(json.dumps({"url": "http://127.0.0.1:1/f", "size_bytes": 5, "tag": '"v1"'}))
    fetch([f"{server.address}/f"], tmp_path / "f", pause_s=0.0)
    assert (tmp_path / "f").read_bytes() == NOISE[:100]


def test_busy_servers_are_asked_again_and_silent_sizes_are_accepted(server: Server, tmp_path: Path) -> None:
    source = server.source(HEADS)
    server.shelves["/heads.zip"] = Shelf(HEADS, codes=[503, 429], tells_length=False)
    get(source, tmp_path)
    assert files_in(tmp_path / "heads") == HEADS_FILES


def test_the_next_address_is_tried_where_one_has_no_file(server: Server, tmp_path: Path) -> None:
    server.shelves |= {"/page": Shelf(b"<html>", content_type="text/html"), "/good": Shelf(HEADS)}
    archive = Archive(tuple(f"{server.address}/{name}" for name in ("gone", "page", "good")))
    get(replace(SEVENSCENES, archives={"heads": archive}), tmp_path)
    assert json.loads((tmp_path / "heads.download.json").read_text())["url"].endswith("/good")


@pytest.mark.parametrize(
    ("url", "answer"),
    [
        ("{server}/gone.zip", "answered 404 Not Found"),
        ("http://no-such-host.invalid/heads.zip", "cannot be found"),
        ("http://127.0.0.1:1/heads.zip", "no connection"),
    ],
)
def test_an_address_out_of_reach_is_one_line_with_a_way_out(
    server: Server, tmp_path: Path, url: str, answer: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("no_proxy", "*")
    source = replace(SEVENSCENES, archives={"heads": Archive((url.format(server=server.address),))})
    with pytest.raises(InputError) as caught:
        get(source, tmp_path)
    message = str(caught.value)
    assert answer in message
    assert f"(project page {SEVENSCENES.page}), save it as {tmp_path / 'heads.zip'} and run" in message
    assert "\n" not in message


def test_a_wrong_checksum_is_refused_and_the_file_can_be_accepted(server: Server, tmp_path: Path) -> None:
    source = server.source(HEADS, sha256="0" * 64)
    with pytest.raises(InputError, match=rf"heads.zip has sha256 .*, the one known is {'0' * 64}: delete it"):
        get(source, tmp_path)
    assert left_in(tmp_path) == {"heads.zip"}
    get(source, tmp_path, accept_changed=True)
    assert server.shelves["/heads.zip"].served == len(HEADS)  # not fetched twice


def test_a_checksum_other_than_the_recorded_one_is_refused(server: Server, tmp_path: Path) -> None:
    source = server.source(HEADS)
    get(source, tmp_path)
    (tmp_path / "heads").rename(tmp_path / "away")
    server.shelves["/heads.zip"].body = HEADS + b"\0"
    with pytest.raises(InputError, match=r"the one in heads\.download\.json is"):
        get(source, tmp_path)


def test_another_size_is_refused_before_the_download(server: Server, tmp_path: Path) -> None:
    source = server.source(HEADS, size_bytes=5)
    with pytest.raises(InputError, match=r"heads.zip on the server has .* bytes, the known one has 5"):
        get(source, tmp_path)
    assert left_in(tmp_path) == set()


def test_a_full_disk_is_told_before_and_during(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"1000000000.0 GB are needed and .* GB are free"):
        require_space(tmp_path, 1e18)

    def full(*args: object, **options: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(download_module, "unpack", full)
    with pytest.raises(InputError, match="No space left on device; free some space and run this again"):
        get(server.source(HEADS), tmp_path)


def test_an_archive_that_is_there_is_used_and_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "heads.zip").write_bytes(HEADS)
    get(replace(SEVENSCENES, archives={"heads": Archive(())}), tmp_path)
    assert left_in(tmp_path) == {"heads", "heads.zip", "heads.download.json"}
    assert "heads.zip is kept" in capsys.readouterr().out


def test_keep_archive_keeps_it(server: Server, tmp_path: Path) -> None:
    get(server.source(HEADS), tmp_path, keep_archive=True)
    assert (tmp_path / "heads.zip").read_bytes() == HEADS


def test_an_interrupted_unpack_leaves_nothing(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(archive: Path, folder: Path, **options: object) -> None:
        (folder / "half").write_bytes(b"half")
        raise KeyboardInterrupt

    source = server.source(HEADS)
    monkeypatch.setattr(download_module, "unpack", interrupted)
    with pytest.raises(KeyboardInterrupt):
        get(source, tmp_path)
    monkeypatch.undo()
    assert left_in(tmp_path) == {"heads.zip"}
    (tmp_path / ".heads.unpacking/seq-01").mkdir(parents=True)  # what a run that was killed outright leaves
    get(source, tmp_path)
    assert left_in(tmp_path) == {"heads", "heads.zip", "heads.download.json"}
    assert files_in(tmp_path / "heads") == HEADS_FILES


def test_a_damaged_archive_leaves_no_scene(server: Server, tmp_path: Path) -> None:
    at = HEADS.index(NOISE[:100])
    with pytest.raises(InputError, match=r"heads.zip.* cannot be read as a zip .*Delete it and download it again"):
        get(server.source(HEADS[:at] + b"?" + HEADS[at + 1 :]), tmp_path)
    assert left_in(tmp_path) == {"heads.zip"}


def test_another_archive_than_a_scenes_is_refused(server: Server, tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"contains no TrainSplit.txt and TestSplit.txt, so it is not a scene of 7-Scenes"
    ):
        get(server.source(zipped({"readme.txt": b""})), tmp_path)


def test_a_scene_that_lacks_a_sequence_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "heads").mkdir()
    (tmp_path / "heads/TrainSplit.txt").write_text("sequence2")
    (tmp_path / "heads/TestSplit.txt").write_text("sequence1")
    (tmp_path / "heads/seq-02").mkdir()
    with pytest.raises(InputError, match=r"heads: the folder exists, but seq-01 is missing. Move the folder away"):
        download("7scenes", "heads", tmp_path)


def test_a_malformed_split_file_is_named_as_the_reader_names_it(tmp_path: Path) -> None:
    (tmp_path / "heads/seq-01").mkdir(parents=True)
    for split in SEVENSCENES.splits:
        (tmp_path / "heads" / split).write_text("sequence1\nseq-01\n")
    with pytest.raises(InputError, match=r"TrainSplit\.txt, line 2: 'seq-01' is not a 'sequenceN'"):
        download("7scenes", "heads", tmp_path)


def test_two_processes_do_not_get_one_scene(server: Server, tmp_path: Path) -> None:
    with FileLock(tmp_path / ".heads.lock"), pytest.raises(InputError, match="another process is getting this scene"):
        get(server.source(HEADS), tmp_path)


def linked(name: str) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name)
    info.create_system = 3
    info.external_attr = (stat.S_IFLNK | 0o777) << 16
    return info


@pytest.mark.parametrize(
    "member", ["../evil", "/etc/evil", "a/../../evil", "..\\evil", "C:\\evil", "C:evil", linked("evil")], ids=str
)
@pytest.mark.parametrize("nested", [False, True])
def test_members_that_escape_are_refused_by_name(tmp_path: Path, member: str | zipfile.ZipInfo, nested: bool) -> None:
    evil = zipped({"good": b"1", member: b"/etc/passwd"})  # type: ignore[dict-item]
    (tmp_path / "a.zip").write_bytes(zipped({"seq-01.zip": evil}) if nested else evil)
    folder = tmp_path / "folder"
    folder.mkdir()
    with pytest.raises(InputError, match=r"member '.*evil' (leads out of the folder|is a link or a device)"):
        unpack(tmp_path / "a.zip", folder, limit_bytes=10_000)
    assert files_in(folder) <= {"seq-01.zip"}
    assert not list(tmp_path.glob("evil"))


def test_a_member_without_a_name_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.zip").write_bytes(zipped({"good": b"1", "x": b"2"}).replace(b"x", b"\0"))  # cut at a null, as C does
    with pytest.raises(InputError, match=r"a\.zip: a member has no name; nothing is unpacked"):
        unpack(tmp_path / "a.zip", tmp_path / "folder", limit_bytes=10_000)


def test_bombs_are_refused(tmp_path: Path) -> None:
    bomb = zipped({"zeros": bytes(1_000_000)}, zipfile.ZIP_DEFLATED)
    half = zipped({"zeros": bytes(300_000)}, zipfile.ZIP_DEFLATED)
    for content in (bomb, zipped({"b.zip": bomb}), zipped({"b.zip": half, "c.zip": half})):
        (tmp_path / "a.zip").write_bytes(content)
        with pytest.raises(InputError, match=r"it unpacks to .* bytes where .* are allowed"):
            unpack(tmp_path / "a.zip", tmp_path, limit_bytes=500_000)
    (tmp_path / "a.zip").write_bytes(zipped({"b.zip": zipped({"c.zip": zipped({"d": b""})})}))
    with pytest.raises(InputError, match=r"a.zip/b.zip: member 'c.zip' is a zip nested too deep"):
        unpack(tmp_path / "a.zip", tmp_path, limit_bytes=500_000)


def test_all_gets_every_scene(server: Server, tmp_path: Path) -> None:
    archives = {name: Archive((server.address + "/heads.zip",)) for name in ("heads", "stairs")}
    server.shelves["/heads.zip"] = Shelf(HEADS)
    assert get(replace(SEVENSCENES, archives=archives), tmp_path, "all") == [tmp_path / "heads", tmp_path / "stairs"]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: download("7scene", "heads"), "'7scene' is not a dataset .* Did you mean 7scenes?"),
        (lambda: download("7scenes", "haeds"), "'haeds' is not a scene of 7-Scenes. Did you mean heads?"),
        (lambda: download("cambridge", "kingscollege"), "Did you mean KingsCollege?"),
        (lambda: download("7scenes", "zzz"), "Choose one of chess, fire, heads, .*, all"),
        (lambda: download("7scenes", None), "7scenes needs a scene: give one of chess, .*, or all"),
    ],
)
def test_unknown_names_are_told_the_nearest(call: Callable[[], object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        call()


def test_how_to_get_is_one_line_with_the_command() -> None:
    assert how_to_get("7scenes", "heads", Path("data/7scenes")) == (
        f"heads is not in data/7scenes; 7-Scenes is at {SEVENSCENES.page} (non-commercial research); "
        "get it with: mambaloc download 7scenes heads"
    )
    assert how_to_get("cambridge", "Street", Path("/big")).endswith("mambaloc download cambridge Street --root /big")
    assert how_to_get("7scenes", "chees", Path("d")).endswith("nor a scene of 7-Scenes. Did you mean chess?")


def test_the_table_of_addresses_is_sane() -> None:
    assert [len(source.archives) for source in SOURCES.values()] == [7, 6]
    archives = [archive for source in SOURCES.values() for archive in source.archives.values()]
    assert all(archive.urls[0].startswith("https://") for archive in archives)
    assert len({archive.urls[0] for archive in archives}) == len(archives)
    assert all(archive.sha256 is None or re.fullmatch("[0-9a-f]{64}", archive.sha256) for archive in archives)
    for word in ("7scenes", "CC BY-NC-SA 2.0 UK", "heads", "1.0 GB", "KingsCollege", CAMBRIDGE.page):
        assert word in describe_sources()


def test_downloading_needs_no_torch() -> None:
    told = "import sys, mambaloc.data.download; print({'torch', 'lightning'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", told], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"


def test_the_tool_ends_in_one_line_and_code_2(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, REPOSITORY / "tools/download.py", "7scenes", "haeds"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert done.stderr == "error: 'haeds' is not a scene of 7-Scenes. Did you mean heads?\n"
