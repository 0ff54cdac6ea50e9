"""The steps of structure from motion, by COLMAP on the CPU: SIFT features (Lowe 2004), matches that obey a two-view
geometry, and incremental mapping (Schönberger and Frahm 2016).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from mambaloc.data.colmap import import_pycolmap
from mambaloc.errors import InputError

NEIGHBOURS = 10
"""How many frames before and after it a film's frame is matched with, beside those 2, 4, 8, ... apart."""

_FEATURES, _LONGEST_PX = 4096, 1600


def find_features(database: Path, images: Path, names: Sequence[str], one_camera: bool, threads: int) -> None:
    """Find SIFT features.

    Args:
        database: the file that all steps share.
        images: folder of the images.
        names: their files, in order.
        one_camera: whether they share one; otherwise each has its own.
        threads: how many; -1 for all.
    """
    pycolmap = import_pycolmap(images)
    mode = pycolmap.CameraMode.SINGLE if one_camera else pycolmap.CameraMode.PER_IMAGE
    options = pycolmap.FeatureExtractionOptions(num_threads=threads, max_image_size=_LONGEST_PX, use_gpu=False)
    options.sift.max_num_features = _FEATURES
    with pycolmap.Database.open(database):  # which makes it
        pass
    pycolmap.import_images(database, images, mode, names)  # else threads would number them as they come
    pycolmap.extract_features(database, images, names, mode, extraction_options=options)


def match_features(database: Path, in_order: bool, threads: int, seed: int) -> None:
    """Match images and keep what obeys a two-view geometry.

    Args:
        database: with features.
        in_order: match each with its neighbours; otherwise every pair.
        threads: how many; -1 for all.
        seed: of RANSAC.
    """
    pycolmap = import_pycolmap(database)
    matching = pycolmap.FeatureMatchingOptions(num_threads=threads, use_gpu=False)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    if in_order:
        pairing = pycolmap.SequentialPairingOptions(overlap=NEIGHBOURS, quadratic_overlap=True)
        pycolmap.match_sequential(database, matching, pairing, verification)
    else:
        pycolmap.match_exhaustive(database, matching, verification_options=verification)


def place_images(database: Path, images: Path, out: Path, seed: int, advance: Callable[[], None]) -> int:
    """Map incrementally and write the largest model, if there is any.

    Args:
        database: with matches.
        images: folder of the images.
        out: folder to write the model to, which is made.
        seed: of RANSAC.
        advance: called after each image.

    Returns:
        How many images that model places.
    """
    pycolmap = import_pycolmap(images)
    options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=seed, extract_colors=False)
    with TemporaryDirectory(dir=database.parent) as work:  # COLMAP writes every model there
        models = pycolmap.incremental_mapping(
            database, images, work, options, initial_image_pair_callback=advance, next_image_callback=advance
        )
    largest: Any = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
    if largest is None:
        return 0
    out.mkdir(parents=True)
    largest.write_binary(out)
    return int(largest.num_reg_images())


@contextmanager
def quiet_colmap(source: Path, remedy: str) -> Iterator[None]:
    """Keep COLMAP's log to itself, and tell what it throws in one line.

    Raises:
        InputError: that names the source and a remedy.
    """
    pycolmap = import_pycolmap(source)
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    try:
        yield
    except (RuntimeError, ValueError) as error:  # what pycolmap makes of C++'s
        reason = (str(error).strip().splitlines() or [type(error).__name__])[-1]
        raise InputError(f"{source}: COLMAP stopped ({reason[:200]}); {remedy}") from None
    finally:
        pycolmap.logging.minloglevel = before
