#!/usr/bin/env bash
# Package:  pycolmap 4.2.1
# Guess:    a text model loses nothing if the blank lines at the end of its images.txt are trimmed, as editors and version
#           control do: the last image has no points, so its second line is empty and there is nothing in it to lose.
# Seen:     the last image is gone, without an error or a warning. The reader drops an image whose second line it cannot read,
#           and an empty last line that is not there cannot be read. With the blank line there are three images, without two.
# Hurts:    users who write images.txt for known poses, to triangulate with them, where no image has points: the model, and
#           all that is made with it, has one picture fewer than the file.
# Remedy:   end images.txt with a line that is not empty, such as a comment, and compare num_images() with the lines.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q --disable-pip-version-check pycolmap==4.2.1
"$work/venv/bin/python" - "$work" <<'PYTHON'
import sys
from pathlib import Path

import pycolmap

print("pycolmap", pycolmap.__version__)
model = Path(sys.argv[1], "model")
model.mkdir()
(model / "cameras.txt").write_text("1 PINHOLE 640 480 500 500 320 240\n")
(model / "points3D.txt").write_text("# no points yet\n")
images = "".join(f"{number} 1 0 0 0 {number} 0 0 1 {number}.png\n\n" for number in (1, 2, 3))


def read(text):
    (model / "images.txt").write_text(text)
    found = pycolmap.Reconstruction(model).images.values()
    return sorted(image.name for image in found)


whole, trimmed, commented = read(images), read(images.rstrip("\n") + "\n"), read(images + "# end\n")
print(f"with the blank line: {whole}; trimmed: {trimmed}; with a comment at the end: {commented}")
assert whole == commented == ["1.png", "2.png", "3.png"], "the whole file is not read whole"
assert trimmed == ["1.png", "2.png"], "the last image is read now"
print("as described")
PYTHON
