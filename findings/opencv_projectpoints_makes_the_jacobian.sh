#!/usr/bin/env bash
# Package:  opencv-python-headless 5.0.0.93
# Guess:    cv2.projectPoints of N points takes memory for its result, 16 bytes a point, and little more.
# Seen:     it takes about 30 times its result: the Python function always asks for the Jacobian as well, 2 N rows of
#           10 + distortion coefficients doubles, and there is no argument to do without it. One million points take half a
#           gigabyte with five coefficients; the formula in NumPy takes a fifth of the time.
# Hurts:    users who project every pixel of a picture, to undistort or render it: 12 million pixels take gigabytes.
# Remedy:   cv2.initUndistortRectifyMap for whole pictures; project points in parts.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q --disable-pip-version-check opencv-python-headless==5.0.0.93 numpy==2.4.6
"$work/venv/bin/python" - <<'PYTHON'
import resource
import time

import cv2
import numpy as np

POINTS = 1_000_000
K = np.array([[800.0, 0, 640], [0, 800, 360], [0, 0, 1]])
DISTORTION = np.array([-0.1, 0.02, 0.001, -0.002, 0.003])


def peak_mib():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def by_formula(points):
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    k1, k2, p1, p2, k3 = DISTORTION
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack((K[0, 0] * u + K[0, 2], K[1, 1] * v + K[1, 2]), axis=1)


points = np.random.default_rng(0).uniform((-0.5, -0.3, 1), (0.5, 0.3, 2), (POINTS, 3))
cv2.projectPoints(points[:10], np.zeros(3), np.zeros(3), K, DISTORTION)
started = time.perf_counter()
expected = by_formula(points)
formula_s = time.perf_counter() - started
before_mib = peak_mib()
started = time.perf_counter()
found, jacobian = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, DISTORTION)
opencv_s = time.perf_counter() - started
more_mib, result_mib = peak_mib() - before_mib, found.nbytes / 2**20
print("opencv", cv2.__version__, "numpy", np.__version__)
print(f"largest difference from the formula {np.abs(found[:, 0] - expected).max():.1e} px")
print(f"the result takes {result_mib:.0f} MiB, the Jacobian beside it {jacobian.nbytes / 2**20:.0f} MiB {jacobian.shape}")
print(f"the call raises the largest memory by {more_mib:.0f} MiB; {opencv_s:.2f} s, the formula {formula_s:.2f} s")
assert np.abs(found[:, 0] - expected).max() < 1e-6
assert jacobian.shape == (2 * POINTS, 10 + len(DISTORTION)), jacobian.shape
assert more_mib > 10 * result_mib, "the Jacobian is no longer made"
PYTHON
echo "as described"
