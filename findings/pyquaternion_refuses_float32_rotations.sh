#!/usr/bin/env bash
# Package:  pyquaternion 0.9.9, numpy 2.4.6, scipy 1.17.1
# Guess:    Quaternion(matrix=R) takes a rotation matrix in float32, or one that was written with six digits.
# Seen:     nearly all are refused with "Matrix must be orthogonal": off the diagonal of R R^T it allows 1e-8, which float32
#           cannot meet: of 200 random rotations it takes 25, and none of six digits. Quarter turns pass, so that a simple test
#           does not show it.
# Hurts:    users who read poses from a text (7-Scenes, ScanNet, TUM tools) or from a network, and drop or crash on single
#           frames. SciPy, OpenCV and Open3D take the same matrices.
# Remedy:   project onto the rotations first (SVD), or pass atol=1e-5 beside the matrix.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q --disable-pip-version-check pyquaternion==0.9.9 numpy==2.4.6 scipy==1.17.1
"$work/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version

import numpy as np
from pyquaternion import Quaternion
from scipy.spatial.transform import Rotation

RUNS = 200
matrices = Rotation.random(RUNS, rng=np.random.default_rng(0)).as_matrix()


def taken(matrix, **more):
    try:
        Quaternion(matrix=matrix, **more)
    except ValueError as error:
        assert "orthogonal" in str(error), error
        return False
    return True


print("pyquaternion", version("pyquaternion"), "numpy", np.__version__)
kinds = {"float64": lambda r: r, "float32": np.float32, "six digits": lambda r: r.round(6)}
counts = {name: sum(taken(make(matrix)) for matrix in matrices) for name, make in kinds.items()}
print(f"taken of {RUNS}:", counts)
patient = sum(taken(matrix.astype(np.float32), atol=1e-5) for matrix in matrices)
quarter = taken(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]], np.float32))
print(f"float32 with atol=1e-5: {patient}; a quarter turn in float32: {quarter}")
assert counts["float64"] == RUNS and patient == RUNS and quarter, "what was taken is refused"
assert max(counts["float32"], counts["six digits"]) < 0.2 * RUNS, "rounded matrices are taken now"
print("as described")
PYTHON
