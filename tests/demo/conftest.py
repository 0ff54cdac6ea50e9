"""The embedded scene's site, served; and a browser to look at it with."""

import shutil
import threading
from contextlib import contextmanager

import pytest

from mambaloc.demo import build_site, embedded_film, serve
from mambaloc.export import write_bundle
from mambaloc.zoo.bundles import EMBEDDED, load_with_data, released_bundle

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
SWITCHES = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--use-fake-device-for-media-stream",
    "--use-fake-ui-for-media-stream",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-quic",
]


@pytest.fixture(scope="session")
def bundle():
    return released_bundle()


@pytest.fixture(scope="session")
def raw_bundle(tmp_path_factory):
    """Models that resize, crop and scale by themselves."""
    out = tmp_path_factory.mktemp("raw") / "bundle"
    write_bundle(*load_with_data(EMBEDDED), out, ("onnx", "fp16"), "pc", raw_input=True)
    return out


@pytest.fixture(scope="session")
def film():
    return embedded_film()


@pytest.fixture(scope="session")
def site(bundle, film, tmp_path_factory):
    if shutil.which("npm") is None:
        pytest.skip("the page's libraries come by npm, which is not here")
    return build_site(bundle, tmp_path_factory.mktemp("site") / "site", film)


@pytest.fixture(scope="session")
def served():
    """Serves a folder as long as a block lasts."""
    return _served


@contextmanager
def _served(site, **options):
    with serve(site, 0, **options) as server:
        threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        try:
            yield server
        finally:
            server.shutdown()


@pytest.fixture(scope="session")
def browser():
    if CHROMIUM is None:
        pytest.skip("needs Chromium, which is not here")
    api = pytest.importorskip("playwright.sync_api")
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=SWITCHES)
        yield browser
        browser.close()
