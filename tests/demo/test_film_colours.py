"""One video of each standard, decoded by Python's reader and by the browser: the same colours within 3 levels.

Node decodes no video; what the page's module makes of the same pixels there is compared in ``test_node.py``.
"""

from __future__ import annotations

import shutil
from importlib import resources

import numpy as np
import pytest
from films import COLORS, colored_film, patches

from mambaloc.runtime.sources import frames_of

pytestmark = pytest.mark.slow
WEB = resources.files("mambaloc.demo") / "web"
FIRST_FRAME = """async () => {
    const { Stream } = await import("./sources.js");
    const video = document.querySelector("video");
    const bitmap = await new Promise((resolve) => new Stream(video, async (frame) => resolve(frame)));
    const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext("2d");
    context.drawImage(bitmap, 0, 0);
    return [bitmap.width, bitmap.height, [...context.getImageData(0, 0, bitmap.width, bitmap.height).data]];
}"""


@pytest.mark.parametrize("standard", ["bt601", "bt709"])
def test_the_browser_sees_the_colors_that_python_sees(browser, served, tmp_path, standard):
    film = colored_film(tmp_path / "film.webm", standard)
    shutil.copy(WEB / "sources.js", tmp_path)
    (tmp_path / "index.html").write_text('<!doctype html><video src="film.webm" muted autoplay></video>')
    with served(tmp_path) as server:
        page = browser.new_page()
        page.goto(f"http://127.0.0.1:{server.server_port}/")
        width, height, rgba = page.evaluate(FIRST_FRAME)
        page.close()
    in_browser = patches(np.array(rgba, np.uint8).reshape(height, width, 4)[..., :3])
    in_python = patches(next(frames_of(film)[0]).image)
    worst = np.abs(in_browser - in_python).max()
    print(f"{standard}: {worst:.0f} levels apart, browser {np.abs(in_browser - COLORS).max():.0f} from its colours")
    assert worst <= 3
