"""Structure from motion by COLMAP on the CPU: SIFT features (Lowe 2004), matches that obey a two-view geometry, and
incremental mapping (Schönberger and Frahm 2016).

This file is a program of its own: ``python reconstruction.py JOB``, where JOB is a JSON file with the fields of
:class:`~mambaloc.importing.sfm.process.Job`. It writes JSON lines to stdout: ``{"step": NAME, "of": COUNT}``,
``{"advance": 1}``, and ``{"placed": COUNT}`` or ``{"error": REASON}`` at the end. It imports neither OpenCV nor this
package: pycolmap and OpenCV bring a copy of zlib each, and where both are loaded, memory that one took is freed by the
other, which ends the process (pycolmap 4.2.1 and OpenCV 5.0: ``free(): invalid pointer`` at the next PNG).
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

_FEATURES, _LONGEST_PX = 4096, 1600

Report = Callable[..., None]


def main(job: Mapping[str, Any]) -> None:
    """Find features, match them, place the images, and write the largest model if there is one."""
    report = _reporter()
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    try:
        report(step="Finding features")
        find_features(pycolmap, job)
        report(step="Matching frames")
        match_features(pycolmap, job)
        report(step="Placing frames", of=len(job["names"]))
        report(placed=_place_images(pycolmap, job, report))
    except (RuntimeError, ValueError) as error:  # what pycolmap makes of C++'s
        lines = str(error).strip().splitlines() or [type(error).__name__]
        report(error=lines[-1][:200])


def _reporter() -> Report:
    """A function that writes a JSON line to stdout, where COLMAP no longer writes."""
    stdout = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)

    def report(**message: object) -> None:
        stdout.write(json.dumps(message) + "\n")
        stdout.flush()

    return report


def find_features(pycolmap: Any, job: Mapping[str, Any]) -> None:
    """Make the database, and fill it with the images' features."""
    mode = pycolmap.CameraMode.SINGLE if job["one_camera"] else pycolmap.CameraMode.PER_IMAGE
    options = pycolmap.FeatureExtractionOptions(num_threads=job["threads"], max_image_size=_LONGEST_PX, use_gpu=False)
    options.sift.max_num_features = _FEATURES
    with pycolmap.Database.open(job["database"]):  # which makes it
        pass
    # else threads would number them as they come
    pycolmap.import_images(job["database"], job["images"], mode, job["names"])
    pycolmap.extract_features(job["database"], job["images"], job["names"], mode, extraction_options=options)


def match_features(pycolmap: Any, job: Mapping[str, Any]) -> None:
    """Match the features of neighbours, or of every pair, and keep what one geometry explains."""
    matching = pycolmap.FeatureMatchingOptions(num_threads=job["threads"], use_gpu=False)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = job["seed"]
    if job["neighbours"] is None:
        pycolmap.match_exhaustive(job["database"], matching, verification_options=verification)
    else:
        pairing = pycolmap.SequentialPairingOptions(overlap=job["neighbours"], quadratic_overlap=True)
        pycolmap.match_sequential(job["database"], matching, pairing, verification)


def _place_images(pycolmap: Any, job: Mapping[str, Any], report: Report) -> int:
    """How many images the largest model places, which is written."""
    options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=job["seed"], extract_colors=False)
    work = Path(job["database"]).with_suffix(".models")  # COLMAP writes every model there
    work.mkdir()

    def advance() -> None:
        report(advance=1)

    models = pycolmap.incremental_mapping(
        job["database"], job["images"], work, options, initial_image_pair_callback=advance, next_image_callback=advance
    )
    largest: Any = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
    if largest is None:
        return 0
    Path(job["out"]).mkdir(parents=True)
    largest.write_binary(job["out"])
    return int(largest.num_reg_images())


if __name__ == "__main__":
    main(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")))
