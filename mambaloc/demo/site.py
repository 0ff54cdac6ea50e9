"""The demo page as a folder of static files, which any web server may serve."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
from functools import partial
from importlib.resources import as_file, files
from pathlib import Path

import cv2
from rich.console import Console

from mambaloc.demo.video import POSES_FILE, VIDEO_FILE
from mambaloc.errors import InputError
from mambaloc.files import atomic_folder
from mambaloc.renamed import renamed_arguments
from mambaloc.runtime.bundle import CONTRACT_FILE, verify_bundle
from mambaloc.user_cache import cached_folder

_WEB = files("mambaloc.demo") / "web"
_VENDORED = "vendor.json"  # the site's files that come from npm, and where they lie in node_modules
_NPM_FILES = ("package.json", "package-lock.json", ".npmrc")


@renamed_arguments(film="video")
def build_site(bundle: Path, out: Path, video: Path | None = None) -> Path:
    """Write the page for a bundle; the folder appears once it is whole.

    Args:
        bundle: which :func:`~mambaloc.runtime.bundle.verify_bundle` finds as it was written.
        out: the folder, which must not be there yet.
        video: a video for the page to play, or what :func:`embedded_video` gives.

    Raises:
        InputError: for an invalid bundle or video, a folder that cannot be written, or without Node.js's npm.
    """
    verify_bundle(bundle)
    if out.exists():
        raise InputError(f"{out}: already exists; choose another folder with --out, or remove it")
    modules = node_modules()
    with atomic_folder(out, "choose another folder with --out") as site:
        with as_file(_WEB) as web:
            shutil.copytree(web, site, dirs_exist_ok=True, ignore=shutil.ignore_patterns(_VENDORED, *_NPM_FILES))
        for name, source in json.loads((_WEB / _VENDORED).read_text(encoding="utf-8")).items():
            (site / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(modules / source, site / name)
        for name in _listed(bundle):
            (site / "bundle" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(bundle / name, site / "bundle" / name)
        _add_video(site, video)
    return out


def node_modules(dev: bool = False) -> Path:
    """What the page needs of npm, as ``package-lock.json`` pins it; installed into the user's cache on first use.

    Args:
        dev: also what only its tests need.

    Raises:
        InputError: where npm is not there, or does not install it.
    """
    lock = (_WEB / "package-lock.json").read_bytes()
    name = hashlib.sha256(lock).hexdigest()[:12] + ("-dev" if dev else "")
    return cached_folder(f"node/{name}", partial(_install, dev=dev)) / "node_modules"


def _install(folder: Path, dev: bool) -> None:
    for name in _NPM_FILES:
        (folder / name).write_bytes((_WEB / name).read_bytes())
    npm = shutil.which("npm")
    if npm is None:
        raise InputError("npm: not found, and the page's libraries come from it; install Node.js 20 or later")
    command = [npm, "ci", "--ignore-scripts", "--no-audit", "--no-fund", *([] if dev else ["--omit=dev"])]
    with Console(stderr=True).status("fetching the page's libraries, once"):
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        reason = next((line for line in done.stderr.splitlines() if line.strip()), "no reason given")
        raise InputError(f"npm ci: failed ({reason.strip()}). Check the network.")


def _listed(bundle: Path) -> list[str]:
    contract = json.loads((bundle / CONTRACT_FILE).read_text(encoding="utf-8"))
    return [CONTRACT_FILE, *contract["files"]]


def _add_video(site: Path, video: Path | None) -> None:
    if video is None:
        (site / POSES_FILE).write_text("null\n", encoding="utf-8")  # there is none
    elif (video / POSES_FILE).is_file():
        for name in (VIDEO_FILE, POSES_FILE):
            shutil.copyfile(video / name, site / name)
    elif video.is_file() and cv2.VideoCapture(str(video)).read()[0]:
        file = f"film{video.suffix.lower()}"
        shutil.copyfile(video, site / file)
        (site / POSES_FILE).write_text(json.dumps({"file": file}) + "\n", encoding="utf-8")
    else:
        raise InputError(f"{video}: no video that browsers play; give an MP4 or WebM")
