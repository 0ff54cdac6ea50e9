#!/usr/bin/env bash
# Package:  opencv-python-headless 5.0.0.93
# Guess:    cv2.resize with INTER_AREA rounds a mean that lies halfway between two levels by one rule, whatever the factor.
# Seen:     images that are exactly halved round halves up; at a quarter, a sixth or an eighth halves go to the even level.
#           Halved noise has an eighth of its levels one higher than by the other rule.
# Hurts:    ports of a preprocessing, to ONNX, Core ML or a shader, that are checked at one size: whichever rule they use,
#           their levels are off at other sizes, and a network's poses with them, by millimetres.
# Remedy:   round halves up where both sides are exactly halved, to even otherwise; check a port at a half and at a quarter.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q --disable-pip-version-check opencv-python-headless==5.0.0.93 numpy==2.4.6
"$work/venv/bin/python" - <<'PYTHON'
import cv2
import numpy as np

print("opencv", cv2.__version__)
rng = np.random.default_rng(0)
for factor in (2, 4, 6, 8):
    for channels in (1, 3):
        image = rng.integers(0, 256, (48 * factor, 64 * factor, channels), dtype=np.uint8)
        small = cv2.resize(image, (64, 48), interpolation=cv2.INTER_AREA).reshape(48, 64, channels).astype(int)
        total = image.reshape(48, factor, 64, factor, channels).sum(axis=(1, 3), dtype=int)
        area = factor * factor
        level, rest = np.divmod(total, area)
        is_half = 2 * rest == area
        others = level + (2 * rest > area)
        assert (small == others)[~is_half].all()
        up = (small == level + 1)[is_half].mean()
        even = (small % 2 == 0)[is_half].mean()
        print(f"1/{factor}, {channels} channels: {is_half.sum()} halves, {up:.0%} of them up, {even:.0%} to the even level")
        if factor == 2:
            off = (small != level + (2 * rest > area) + (is_half & (level % 2 == 1))).mean()
            print(f"{off:.1%} of all levels are not what rounding to even gives")
            assert up == 1
            assert 0.1 < off < 0.15
        else:
            assert even == 1
            assert is_half.sum() > 5
PYTHON
