"""The rule of acceptance, calibrated: how probable a pose is that a map finds in frames held out of its training."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from maps_disturbances import DISTURBANCES, exposure, motion_blur, occlusion, smaller
from maps_robustness import FAR_DEG, FAR_M, wilson_interval
from maps_scenes import key_and_query, sequence_of, timed_map
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.stats import chi2

from mambaloc.console import progress
from mambaloc.errors import InputError
from mambaloc.files import writing
from mambaloc.images import Image, read_image
from mambaloc.mapping.building import MapSettings
from mambaloc.mapping.posed import read_frames
from mambaloc.mapping.recipe import MapRecipe
from mambaloc.runtime.maps import CameraPose, MapLocalization, MapLocalizer
from mambaloc.runtime.maps.acceptance import MAX_DEVIATION, MIN_PROBABILITY, Evidence
from mambaloc.runtime.maps.features import rescaled_intrinsics
from mambaloc.runtime.maps.viewpoints import spread_m
from mambaloc.runtime.rotations import matrix_from_quaternion

EVIDENCE_FILE = "evidence.npz"
_RANDOM = "at random"
_DRAWN = 7  # disturbances of random strength a frame, beside the fixed ones
_PRIOR = (0.25, 5.0)  # deviations: of the key frames' spread, and degrees about each axis
_FIELDS = (
    "fold", "frame", "picture", "disturbance", "cells", "deviation", "turn_deg", "inliers", "accepted", "focal",
    "off_m", "off_deg", "pose_chi2", "position_chi2",
)  # fmt: skip
_THRESHOLDS = (0.85, 0.9, 0.92, 0.95, 0.97, 0.98, 0.99)
_BOUNDS = (0.06, 0.09, 0.12, 0.16, 0.24, np.inf)
_MAX_WRONG = 0.005
_NAMES = [*DISTURBANCES, _RANDOM, "focal length x 0.9", "focal length x 1.1"]

Floats = NDArray[np.float64]


def collect_evidence(recipe: MapRecipe, queries: int, out: Path) -> None:
    """Hold out each sequence of the training frames in turn, and localize its frames, disturbed, in a map of the rest.

    Args:
        recipe: scene and settings of the maps.
        queries: frames of each sequence.
        out: folder to write ``evidence.npz`` to: a row an answer, a column a name of ``_FIELDS``.
    """
    sequences = sorted({sequence_of(image).name for image in read_frames(recipe, "train").images})
    rows: list[tuple[float, ...]] = []
    for fold, name in enumerate(sequences):
        train, held = key_and_query(recipe, name)
        sparse_map, _ = timed_map(train, recipe)
        localizer = MapLocalizer(sparse_map)
        chosen = np.unique(np.linspace(0, len(held) - 1, queries).round().astype(int))
        for row in progress(chosen, name, len(chosen)):
            image = held.images[row]
            rgb = read_image(image) if isinstance(image, Path) else image
            shot = (rgb, held.intrinsics[row], held.world_from_cam[row])
            rows += [(fold, row, *answer) for answer in _answers(localizer, *shot, np.random.default_rng((fold, row)))]
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(out / EVIDENCE_FILE, rows=np.array(rows, np.float64))


def _answers(
    localizer: MapLocalizer, rgb: Image, intrinsics: Floats, truth: Floats, rng: np.random.Generator
) -> list[tuple[float, ...]]:
    """Without a prior, and, where that is not accepted, with one that is near the truth."""
    near_m = _PRIOR[0] * spread_m(localizer.map.key_poses)
    turn = cv2.Rodrigues(np.radians(rng.normal(0, _PRIOR[1], 3)))[0]
    prior = CameraPose(turn @ truth[:3, :3], truth[:3, 3] + rng.normal(0, near_m, 3))
    found = []
    for count, (number, image, scale) in enumerate(_disturbed(rgb, rng)):
        matrix = rescaled_intrinsics(intrinsics, (rgb.shape[1], rgb.shape[0]), (image.shape[1], image.shape[0]))
        features = localizer.features(image, np.diag((scale, scale, 1)) @ matrix + _centered(matrix, scale))
        alone = localizer.localize_features(features)
        answers = [alone] if alone.is_accepted else [alone, localizer.localize_features(features, prior)]
        distinct = {answer.evidence: answer for answer in answers if answer.evidence is not None}
        found += [(count, number, *_scores(answer, evidence, truth)) for evidence, answer in distinct.items()]
    return found


def _centered(matrix: Floats, scale: float) -> Floats:
    """What keeps the centre where it is once the focal length is scaled."""
    kept = np.zeros((3, 3))
    kept[:2, 2] = (1 - scale) * matrix[:2, 2]
    return kept


def _disturbed(rgb: Image, rng: np.random.Generator) -> list[tuple[int, Image, float]]:
    """Number of each disturbance, the image, and by what its focal length is stated wrongly."""
    fixed = [(number, disturb(rgb, rng), 1.0) for number, disturb in enumerate(DISTURBANCES.values())]
    drawn = [(_NAMES.index(_RANDOM), _drawn(rgb, rng), 1.0) for _ in range(_DRAWN)]
    return [*fixed, *drawn, (len(_NAMES) - 2, rgb, 0.9), (len(_NAMES) - 1, rgb, 1.1)]


def _drawn(rgb: Image, rng: np.random.Generator) -> Image:
    """One disturbance, or three times in ten two, of random strength."""
    ways: list[Callable[[Image], Image]] = [
        lambda image: motion_blur(image, rng, rng.uniform(8, 75)),
        lambda image: exposure(image, rng, float(np.exp(rng.uniform(np.log(0.08), np.log(0.5))))),
        lambda image: occlusion(image, rng, rng.uniform(0.2, 0.8)),
        lambda image: smaller(image, rng, int(rng.integers(2, 6))),
    ]
    for way in sorted(rng.choice(4, 2 if rng.random() < 0.3 else 1, replace=False, p=(0.3, 0.2, 0.35, 0.15))):
        rgb = ways[way](rgb)
    return rgb


def _scores(answer: MapLocalization, evidence: Evidence, truth: Floats) -> tuple[float, ...]:
    """The last columns of ``_FIELDS``."""
    rotation = matrix_from_quaternion(answer.quaternion)
    off = np.concatenate((truth[:3, 3] - answer.position_m, cv2.Rodrigues(truth[:3, :3] @ rotation.T)[0][:, 0]))
    chi2s = [off[:end] @ np.linalg.pinv(answer.covariance[:end, :end]) @ off[:end] for end in (6, 3)]
    scores = (evidence.cells, evidence.deviation, evidence.turn_deg, answer.inliers, answer.is_accepted)
    focal = answer.focal_scale or 0.0
    return (*scores, focal, np.linalg.norm(off[:3]), np.degrees(np.linalg.norm(off[3:])), *chi2s)


def calibrate(folders: Sequence[Path]) -> str:
    """Fit the regression to what :func:`collect_evidence` wrote, choose its threshold, and say what the rule accepts.

    The threshold is chosen on other frames than the regression is fitted to: each sequence's probabilities are those of
    a fit to all others.

    Raises:
        InputError: for a folder without evidence.
    """
    of, scene = _read(folders)
    is_wrong = (of["off_m"] > FAR_M) | (of["off_deg"] > FAR_DEG)
    has_evidence = np.isfinite(of["deviation"])
    columns = zip(of["cells"], of["deviation"], of["turn_deg"], strict=True)
    evidence = [Evidence(int(cells), *others) for cells, *others in columns]
    known = np.array([each.logarithms() for each in evidence])
    is_asked = of["disturbance"] <= _NAMES.index(_RANDOM)
    group = 100 * scene + of["fold"]
    image_keys = np.column_stack((group, of["frame"], of["picture"]))
    fit = _fit(known[has_evidence & is_asked], is_wrong[has_evidence & is_asked])
    lines = [
        "constant, log(cells + 0.5), log(deviation), log(turn + 0.1): " + " ".join(f"{each:.2f}" for each in fit),
        f"{len(np.unique(image_keys[:, :2], axis=0))} frames, {len(np.unique(image_keys[is_asked], axis=0))} images "
        f"with a pose, {int(is_asked.sum())} poses",
    ]
    has_matches = (of["focal"] == 0) & (of["inliers"] >= MapSettings().least_inliers)
    can = has_matches & (of["deviation"] <= MAX_DEVIATION)
    probability = _left_out(known, is_wrong, has_evidence, is_asked, group)
    chosen = is_asked & _likeliest(image_keys, probability)
    is_likely = has_matches & (probability >= MIN_PROBABILITY)
    for max_deviation in _BOUNDS:
        lines.append(
            _shares(
                f"deviations to {max_deviation:.2f}", chosen, is_likely & (of["deviation"] <= max_deviation), is_wrong
            )
        )
    lines += _thresholds(chosen, np.where(can, probability, 0), is_wrong)
    probability = np.array([each.probability for each in evidence])
    is_final, accepted = _likeliest(image_keys, probability), can & (probability >= MIN_PROBABILITY)
    rows = {"the rule as it is": is_asked}
    rows |= {folder.name: is_asked & (scene == number) for number, folder in enumerate(folders)}
    rows |= {name: of["disturbance"] == number for number, name in enumerate(_NAMES)}
    lines += [_shares(name, each & is_final, accepted, is_wrong) for name, each in rows.items() if each.any()]
    lines += _bins(probability[is_asked & is_final], of["off_m"][is_asked & is_final], is_wrong[is_asked & is_final])
    sure = (of["disturbance"] == 0) & accepted & is_final & ~is_wrong
    return "\n".join(lines + [_covered(folder.name, of, sure & (scene == n)) for n, folder in enumerate(folders)])


def _thresholds(chosen: NDArray[np.bool_], probability: Floats, is_wrong: NDArray[np.bool_]) -> list[str]:
    """What each threshold accepts, and the least of those that bound the share of wrong poses."""
    lines, lowest = [], None
    for threshold in _THRESHOLDS:
        accepted = probability >= threshold
        lines.append(_shares(f"fitted to others, {threshold:.2f}", chosen, accepted, is_wrong))
        if lowest is None and is_wrong[chosen & accepted].mean() <= _MAX_WRONG:
            lowest = threshold
    return [*lines, f"the least threshold with at most {_MAX_WRONG:.1%} of accepted poses wrong: {lowest}"]


def _left_out(
    known: Floats,
    is_wrong: NDArray[np.bool_],
    has_evidence: NDArray[np.bool_],
    is_asked: NDArray[np.bool_],
    group: Floats,
) -> Floats:
    """Probabilities by regressions on the other groups; 0 for answers without evidence."""
    probability = np.zeros(len(has_evidence))
    for each in np.unique(group):
        rest, left_out = has_evidence & is_asked & (group != each), has_evidence & (group == each)
        probability[left_out] = _probability(_fit(known[rest], is_wrong[rest]), known[left_out])
    return probability


def _covered(name: str, of: dict[str, Floats], rows: NDArray[np.bool_]) -> str:
    inside = [(of[key][rows] <= chi2.ppf(0.9, n)).mean() for key, n in (("pose_chi2", 6), ("position_chi2", 3))]
    return f"{name}: {inside[0]:.1%} of poses, {inside[1]:.1%} of positions in the 90 % ellipsoid"


def _read(folders: Sequence[Path]) -> tuple[dict[str, Floats], NDArray[np.int64]]:
    """Columns by name, and the number of each row's folder."""
    tables = []
    for folder in folders:
        if not (folder / EVIDENCE_FILE).is_file():
            raise InputError(f"{folder}: contains no {EVIDENCE_FILE}. Write it with maps.py acceptance.")
        tables.append(np.load(folder / EVIDENCE_FILE, allow_pickle=False)["rows"])
    scene = np.repeat(np.arange(len(tables)), [len(each) for each in tables])
    return dict(zip(_FIELDS, np.concatenate(tables).T, strict=True)), scene


def _likeliest(image_keys: Floats, probability: Floats) -> NDArray[np.bool_]:
    """Which pose of each image, a row of keys, is the answer."""
    _, number = np.unique(image_keys, axis=0, return_inverse=True)
    order = np.lexsort((-probability, number.ravel()))
    is_first = np.diff(number.ravel()[order], prepend=-1) > 0
    chosen = np.zeros(len(probability), bool)
    chosen[order[is_first]] = True
    return chosen


def _fit(known: Floats, is_wrong: NDArray[np.bool_]) -> Floats:
    """Constant and coefficients of a logistic regression."""
    mean, deviation = known.mean(axis=0), known.std(axis=0)
    design = np.column_stack((np.ones(len(known)), (known - mean) / deviation))
    sign = np.where(is_wrong, -1.0, 1.0)

    def cost(of: Floats) -> tuple[float, Floats]:
        margin = sign * (design @ of)
        slope = -(sign / (1 + np.exp(margin))) @ design / len(design)
        shrink = np.r_[0, of[1:]] * 1e-3
        return float(np.logaddexp(0, -margin).mean() + (shrink @ of)), slope + 2 * shrink

    found: Floats = minimize(cost, np.zeros(design.shape[1]), jac=True, method="BFGS").x
    each = found[1:] / deviation
    return np.r_[found[0] - each @ mean, each]


def _probability(of: Floats, known: Floats) -> Floats:
    return np.asarray(1 / (1 + np.exp(-(of[0] + known @ of[1:]))))


def _shares(name: str, rows: NDArray[np.bool_], accepted: NDArray[np.bool_], is_wrong: NDArray[np.bool_]) -> str:
    good, bad = int((rows & accepted & ~is_wrong).sum()), int((rows & accepted & is_wrong).sum())
    low, high = wilson_interval(bad, good + bad)
    return (
        f"{name:24} accepted {good + bad:5d} of {int(rows.sum()):5d}, {good / max((rows & ~is_wrong).sum(), 1):6.1%} "
        f"of the right ones; wrong {bad:3d}, {bad / max(good + bad, 1):.2%} ({low:.2%} to {high:.2%})"
    )


def _bins(probability: Floats, off_m: Floats, is_wrong: NDArray[np.bool_]) -> list[str]:
    lines = []
    for low, high in pairwise((0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 0.9, 0.97, 1.001)):
        rows = (probability >= low) & (probability < high)
        if rows.any():
            median, mean = np.median(off_m[rows]), np.minimum(off_m[rows], 1).mean()
            lines.append(
                f"probability {low:.2f} to {high:.2f}: {rows.sum():5d}, right {1 - is_wrong[rows].mean():.3f}, "
                f"off by {median:.3f} m (median), {mean:.3f} m (mean, cut at 1 m)"
            )
    return lines
