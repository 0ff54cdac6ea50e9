"""The site: whole, reproducible, and only of what was verified."""

import json
import re
import shutil
import subprocess
from importlib import resources

import pytest

from mambaloc.demo import build_site
from mambaloc.demo import site as site_module
from mambaloc.errors import InputError

pytestmark = pytest.mark.slow
WEB = resources.files("mambaloc.demo") / "web"


def test_it_holds_what_it_speaks_of(site, bundle):
    text = "".join(path.read_text() for path in site.glob("*.*") if path.suffix in (".html", ".js", ".css"))
    for name in re.findall(r'(?:href|src)="([^"#:]+)"', (site / "index.html").read_text()):
        assert (site / name).is_file()
    for name in re.findall(r'from "\./([^"]+)"', text):
        assert (site / name).is_file()
    declared = json.loads((WEB / "package.json").read_text())["dependencies"]
    for name, source in json.loads((WEB / "vendor.json").read_text()).items():
        assert (site / name).stat().st_size > 500
        assert source.partition("/")[0] in declared  # not of those that only tests need
    assert (site / "bundle/contract.json").read_bytes() == (bundle / "contract.json").read_bytes()
    assert not list(site.rglob("package*.json"))


def test_nothing_comes_from_elsewhere(site):
    own = [path for path in site.iterdir() if path.suffix in (".html", ".js", ".css")]
    assert own
    for path in own:
        assert not re.search(r"https?://", path.read_text().replace("http://www.w3.org/2000/svg", "")), path


def test_the_lock_pins_every_package_and_names_no_registry():
    lock = json.loads((WEB / "package-lock.json").read_text())
    packages = {name: entry for name, entry in lock["packages"].items() if name}
    assert all(entry["integrity"].startswith("sha512-") for entry in packages.values())
    assert not any("resolved" in entry for entry in packages.values())
    declared = json.loads((WEB / "package.json").read_text())
    for name, version in {**declared["dependencies"], **declared["devDependencies"]}.items():
        assert packages[f"node_modules/{name}"]["version"] == version  # exact, no range


def test_a_video_alone_is_a_film_without_true_poses(bundle, film, tmp_path, site):
    video = tmp_path / "Walk.WEBM"
    shutil.copyfile(film / "film.webm", video)
    out = build_site(bundle, tmp_path / "site", video)
    assert json.loads((out / "film.json").read_text()) == {"file": "film.webm"}
    assert (out / "film.webm").read_bytes() == video.read_bytes()


def test_what_is_refused(bundle, site, tmp_path):
    def refused(message, *arguments):
        with pytest.raises(InputError, match=message):
            build_site(*arguments)
        assert not (tmp_path / "site").exists()
        assert not list(tmp_path.glob(".*"))

    refused("give a bundle's folder", tmp_path / "none", tmp_path / "site")
    refused("already exists", bundle, site)
    refused("no video", bundle, tmp_path / "site", tmp_path / "none.mp4")
    refused("no video", bundle, tmp_path / "site", tmp_path)  # a folder is not copied whole
    (tmp_path / "film.md").write_text("words")
    refused("no video", bundle, tmp_path / "site", tmp_path / "film.md")
    changed = shutil.copytree(bundle, tmp_path / "changed")
    (changed / "trajectory.json").write_text("{}")
    refused("has another sha256 than the contract", changed, tmp_path / "site")


def test_without_npm_its_name_is_told(bundle, tmp_path, monkeypatch):
    monkeypatch.setenv("MAMBALOC_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(InputError, match=r"install Node\.js"):
        build_site(bundle, tmp_path / "site")


def test_a_failing_npm_leaves_nothing(bundle, tmp_path, monkeypatch):
    monkeypatch.setenv("MAMBALOC_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(shutil, "which", lambda name: "/bin/npm")

    def run(command, **_):
        return subprocess.CompletedProcess(command, 1, "", "npm error code EAI_AGAIN\n")

    monkeypatch.setattr(site_module.subprocess, "run", run)
    with pytest.raises(InputError, match=r"npm ci: failed \(npm error code EAI_AGAIN\)"):
        build_site(bundle, tmp_path / "site")
    assert [path.suffix for path in (tmp_path / "cache/node").iterdir()] == [".lock"]
