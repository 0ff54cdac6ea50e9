#!/usr/bin/env bash
# Package:  pycolmap 4.2.1, numpy 2.4.6
# Guess:    VisualIndex.query finds the indexed images that look most like a query's descriptors.
# Seen:     its last argument is COLMAP's output, a vector of ImageScore, bound as an input: the list is copied, the copy is
#           filled, the list stays as it was, and the method returns None. Nothing of the result reaches Python, though
#           build, add, prepare and query all run without an error. Both overloads are bound like this.
# Hurts:    users who retrieve images by COLMAP's vocabulary tree from Python, as to localize without matching every image.
# Remedy:   compare descriptors otherwise, as by VLAD in NumPy, or run the colmap program's vocab_tree_retriever.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q --disable-pip-version-check pycolmap==4.2.1 numpy==2.4.6
"$work/venv/bin/python" - <<'PYTHON'
import numpy as np
import pycolmap
from pycolmap import VisualIndex

print("pycolmap", pycolmap.__version__, "numpy", np.__version__)
rng = np.random.default_rng(0)


def described(count):
    data = rng.random((count, 128), np.float32)
    data /= np.linalg.norm(data, axis=1, keepdims=True)
    return pycolmap.FeatureDescriptorsFloat(type=pycolmap.FeatureExtractorType.SIFT, data=data)


def keypoints(count):
    return pycolmap.FeatureKeypoints([pycolmap.FeatureKeypoint() for _ in range(count)])


index = VisualIndex.create(128, 64)
index.build(VisualIndex.BuildOptions(num_visual_words=16, num_threads=1), described(2000))
images = {number: described(200) for number in (1, 2, 3)}
for number, descriptors in images.items():
    index.add(VisualIndex.IndexOptions(num_threads=1), number, keypoints(200), descriptors)
index.prepare()
assert index.num_images() == 3 and index.is_image_indexed(1), "the images are not indexed"
options = VisualIndex.QueryOptions(num_threads=1)
for given in ([], [pycolmap.ImageScore()]):
    before = [(each.image_id, each.score) for each in given]
    returned = index.query(options, images[1], given)
    after = [(each.image_id, each.score) for each in given]
    print(f"a query with an indexed image's own descriptors: returned {returned}, list {before} before, {after} after")
    assert returned is None and after == before, "the result reaches Python"
    assert index.query(options, keypoints(200), images[1], given) is None and len(given) == len(before), "the result reaches Python"
print(VisualIndex.query.__doc__.strip().splitlines()[-1])
print("as described")
PYTHON
