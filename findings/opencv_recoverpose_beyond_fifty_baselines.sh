#!/usr/bin/env bash
# Package:  opencv-python-headless 5.0.0.93 (cv2 5.0.0), numpy 2.4.6
# Guess:    cv2.recoverPose takes the right one of an essential matrix's four poses if matches are exact, however far the
#           scene is: points lie in front of both cameras for that one alone.
# Seen:     points farther than 50 baselines count for none of the four (the C++ distanceThresh, which this overload of the
#           Python binding does not even name). At 60 baselines no point counts, and the rotation is right in about half of
#           the runs, as by a coin. A count of 0 is the only sign; nothing is raised.
# Hurts:    visual odometry and structure from motion at a film's rate: two frames a centimetre apart, in a room or outside.
# Remedy:   use the overload with distanceThresh, set to 1e4 or so; and refuse a pose for which few points count.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q --disable-pip-version-check opencv-python-headless==5.0.0.93 numpy==2.4.6
"$work/venv/bin/python" - <<'PYTHON'
import cv2
import numpy as np

K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
RUNS = 40


def run(baselines, seed, far=None):
    """How many points count, and whether the pose is the true one, of exact matches so many baselines away."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-0.4, -0.3, 0.95], [0.4, 0.3, 1.2], (200, 3)) * baselines
    rvec, t = rng.normal(0, 0.05, 3), np.array([1, 0.1, 0.05]) / np.linalg.norm([1, 0.1, 0.05])
    first = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, None)[0][:, 0]
    second = cv2.projectPoints(points, rvec, t, K, None)[0][:, 0]
    rotation = cv2.Rodrigues(rvec)[0]
    essential = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]]) @ rotation
    more = {} if far is None else {"distanceThresh": far}
    count, found, direction, *_ = cv2.recoverPose(essential, first, second, K, **more)
    turned = np.linalg.norm(cv2.Rodrigues(found @ rotation.T)[0])
    return count, turned < 0.02 and direction.ravel() @ t > 0.99


print("cv2", cv2.__version__, "numpy", np.__version__)
for baselines, far in ((10, None), (40, None), (60, None), (300, None), (300, 1e4)):
    counts, right = zip(*(run(baselines, seed, far) for seed in range(RUNS)))
    how = "as it is" if far is None else f"distanceThresh {far:g}"
    print(f"{baselines} baselines away, {how}: {np.median(counts):g} of 200 points count, {sum(right)} of {RUNS} poses right")
    is_lost = baselines > 50 and far is None
    assert (max(counts) == 0) == is_lost, "far points are counted otherwise"
    assert (sum(right) == RUNS) != is_lost, "far scenes are solved otherwise"
print("as described")
PYTHON
