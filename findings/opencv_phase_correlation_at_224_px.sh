#!/usr/bin/env bash
# Package:  opencv-python-headless 5.0.0.93 (cv2 5.0.0), numpy 2.4.6
# Guess:    cv2.phaseCorrelate of a picture with itself gives a shift of 0, whatever the picture's size.
# Seen:     it gives half a pixel along each axis whose length, as padded by cv2.getOptimalDFTSize, is odd. 224, the usual
#           side of a network's input, is padded to 225: every shift between pictures of 224 pixels is about half a pixel
#           off. 216, 240, 256 and 320 are right. NumPy's FFT finds the same peak at 0 for all of them.
# Hurts:    whoever aligns or compares crops of 224 pixels to less than a pixel, as to check a crop, a resize or a warp.
# Remedy:   use sides that are padded to an even length, or subtract the shift of a picture with itself.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q --disable-pip-version-check opencv-python-headless==5.0.0.93 numpy==2.4.6
"$work/venv/bin/python" - <<'PYTHON'
import cv2
import numpy as np


def peak(a, b):
    """Row and column of the cyclic shift from a to b, by NumPy's FFT."""
    cross = np.conj(np.fft.fft2(a)) * np.fft.fft2(b)
    correlation = np.fft.ifft2(cross / np.abs(cross)).real
    return np.unravel_index(correlation.argmax(), correlation.shape)


print("cv2", cv2.__version__, "numpy", np.__version__)
for side in (128, 216, 224, 225, 240, 256, 320):
    noise = np.random.default_rng(0).standard_normal((side, side))
    picture = cv2.GaussianBlur(noise, (0, 0), 2)
    moved = np.roll(picture, (3, 2), axis=(0, 1))
    (x, y), _ = cv2.phaseCorrelate(picture, picture)
    (moved_x, moved_y), _ = cv2.phaseCorrelate(picture, moved)
    padded = cv2.getOptimalDFTSize(side)
    print(f"{side} px, padded to {padded}: itself {x:.2f} {y:.2f}; moved by 2 3: {moved_x:.2f} {moved_y:.2f}")
    assert peak(picture, picture) == (0, 0) and peak(picture, moved) == (3, 2), "the pictures are not what they should be"
    expected = 0.5 if padded % 2 else 0.0
    assert abs(x - expected) < 0.01 and abs(y - expected) < 0.01, f"another shift of {side} pixels"
    assert (max(abs(moved_x - 2), abs(moved_y - 3)) > 0.2) == bool(padded % 2), f"another shift of {side} pixels"
print("as described")
PYTHON
