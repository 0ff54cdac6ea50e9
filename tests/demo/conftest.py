"""A site, served, and a browser to look at it with; what costs seconds is made once for all workers, and read only."""

import shutil
import subprocess
import threading
from contextlib import contextmanager, suppress

import pytest

from mambaloc.demo import build_site, embedded_video, serve
from mambaloc.demo import video as video_module
from mambaloc.demo.site import node_modules

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
def node():
    """Run a script in Node, and return what it prints."""

    def run(*words, **options):
        done = subprocess.run(["node", *map(str, words)], capture_output=True, text=True, check=False, **options)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


@pytest.fixture(scope="session")
def bundle(shared_folder, scenes):
    """A model that takes normalised tensors, and does not say how sure it is."""
    return shared_folder("demo_bundle", lambda folder: _export(folder / "bundle", scenes, "heads")) / "bundle"


@pytest.fixture(scope="session")
def raw_bundle(shared_folder, scenes):
    """Models that resize, crop and scale by themselves, and say how sure they are."""

    def make(folder):
        _export(folder / "bundle", scenes, "heads", ("onnx", "fp16"), raw_input=True, knows_its_frames=True)

    return shared_folder("demo_raw_bundle", make) / "bundle"


@pytest.fixture(scope="session")
def map_bundle(shared_folder, den, map_of_den):
    """A model and a map of the embedded room."""

    def make(folder):
        _export(folder / "bundle", den, "den", sparse_map=map_of_den, knows_its_frames=True)

    return shared_folder("demo_map_bundle", make) / "bundle"


def _export(out, root, scene, formats=("onnx",), raw_input=False, knows_its_frames=False, sparse_map=None):
    """Export a student that was never trained: its poses differ by centimetres from frame to frame of a film."""
    import torch  # what is made already needs none of it

    from mambaloc.data import PoseDataModule
    from mambaloc.export import write_bundle
    from mambaloc.models.student import LitStudent

    size = (32, 40)
    validation = "sequences" if scene == "heads" else "none"
    data = PoseDataModule("7scenes", str(root), scene, image_size=size, short_side=36, validation=validation)
    data.setup("fit")
    torch.manual_seed(0)
    system = LitStudent(backbone="test_efficientnet", width=16, image_size=size)
    head = system.network.head
    head.position_scale.fit(4 * torch.randn(9, 3))
    with torch.no_grad():
        head.position[0].weight *= 30
        head.rotation[0].bias.zero_()
    system.provenance = {"data": data.describe()} if knows_its_frames else {}
    write_bundle(system.eval(), data, out, formats, "web", raw_input=raw_input, sparse_map=sparse_map)


@pytest.fixture(scope="session")
def film():
    """The video of the embedded scene, a tenth of its length."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(video_module, "_FRAMES", 24)
        return embedded_video()


@pytest.fixture(scope="session")
def modules():
    """What the page and its tests need of npm."""
    if shutil.which("npm") is None:
        pytest.skip("the page's libraries come by npm, which is not here")
    modules = node_modules(dev=True)
    without_dev = modules.parent.with_name(modules.parent.name.removesuffix("-dev"))
    with suppress(FileExistsError):
        without_dev.symlink_to(modules.parent)  # npm has brought them once
    return modules


@pytest.fixture(scope="session")
def site(shared_folder, bundle, film, modules):
    return shared_folder("demo_site", lambda folder: build_site(bundle, folder / "site", film)) / "site"


@pytest.fixture(scope="session")
def raw_site(shared_folder, raw_bundle, modules):
    return shared_folder("demo_raw_site", lambda folder: build_site(raw_bundle, folder / "site")) / "site"


@pytest.fixture(scope="session")
def map_site(shared_folder, map_bundle, film, modules):
    return shared_folder("demo_map_site", lambda folder: build_site(map_bundle, folder / "site", film)) / "site"


@pytest.fixture(scope="session")
def lens_site(shared_folder, bundles_for_lenses, modules):
    bundle = bundles_for_lenses / "tensors"
    return shared_folder("demo_lens_site", lambda folder: build_site(bundle, folder / "site")) / "site"


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
