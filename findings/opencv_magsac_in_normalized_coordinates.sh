#!/usr/bin/env bash
# Package:  opencv-python-headless 5.0.0.93 (cv2 5.0.0), numpy 2.4.6
# Guess:    cv2.solvePnPRansac with UsacParams gives the same pose whether points are in pixels with K, or in normalized
#           coordinates with K = I and the threshold divided by the focal length: the second is the first, scaled.
# Seen:     that holds for the MSAC score and for the plain RANSAC of solvePnPRansac. With SCORE_METHOD_MAGSAC the pose in
#           pixels is as good as MSAC's (3 mm), but in normalized coordinates the median error is some 20 cm and single
#           poses are metres off, with a third of the inliers. Every call reports success. It is the score: the local
#           optimization (INNER_LO, SIGMA, none) makes no difference.
# Hurts:    whoever undistorts points first (cv2.undistortPoints returns normalized coordinates) and then asks for the
#           robust score that is recommended most.
# Remedy:   keep pixels: undistort with P=K, pass K and a threshold in pixels; or use SCORE_METHOD_MSAC.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q --disable-pip-version-check opencv-python-headless==5.0.0.93 numpy==2.4.6
"$work/venv/bin/python" - <<'PYTHON'
import cv2
import numpy as np

K = np.array([[525.0, 0, 320], [0, 525, 240], [0, 0, 1]])


def error_m(score, lo_method, normalized, seed):
    """Camera centre's error: 200 points two to six metres away, a pixel of noise, half of the matches wrong."""
    rng = np.random.default_rng(seed)
    points_m = rng.uniform([-2, -2, 2], [2, 2, 6], (200, 3))
    rotation, t = cv2.Rodrigues(rng.normal(0, 0.2, 3))[0], rng.normal(0, 0.3, 3)
    seen = points_m @ rotation.T + t
    pixels = seen[:, :2] / seen[:, 2:] * 525 + [320, 240] + rng.normal(0, 1, (200, 2))
    wrong = rng.random(200) < 0.5
    pixels[wrong] = rng.uniform([0, 0], [640, 480], (wrong.sum(), 2))
    params = cv2.UsacParams()
    params.score, params.loMethod, params.sampler = score, lo_method, cv2.SAMPLING_UNIFORM
    params.confidence, params.maxIterations, params.loIterations, params.loSampleSize = 0.999, 1000, 5, 14
    params.randomGeneratorState = 0
    observed, camera, params.threshold = pixels, K.copy(), 4.0
    if normalized:
        observed, camera, params.threshold = (pixels - [320, 240]) / 525, np.eye(3), 4.0 / 525
    found, _, rvec, tvec, _ = cv2.solvePnPRansac(points_m, observed, camera, np.zeros(4), params=params)
    assert found
    found_rotation = cv2.Rodrigues(rvec)[0]
    return np.linalg.norm(found_rotation.T @ tvec.ravel() - rotation.T @ t)


print("cv2", cv2.__version__, "numpy", np.__version__)
medians = {}
for name, score, lo in (
    ("MSAC", cv2.SCORE_METHOD_MSAC, cv2.LOCAL_OPTIM_INNER_LO),
    ("MAGSAC", cv2.SCORE_METHOD_MAGSAC, cv2.LOCAL_OPTIM_SIGMA),
):
    for normalized in (False, True):
        errors = [error_m(score, lo, normalized, seed) for seed in range(30)]
        medians[name, normalized] = np.median(errors)
        where = "normalized" if normalized else "pixels"
        print(f"{name:6} {where:10} median {np.median(errors):.4f} m, worst {max(errors):.4f} m")
assert max(medians["MSAC", False], medians["MSAC", True], medians["MAGSAC", False]) < 0.01, "the others changed"
assert medians["MAGSAC", True] > 0.05, "MAGSAC now finds the pose in normalized coordinates too"
print("as described")
PYTHON
