"""The rule of acceptance, calibrated: the regression on drawn evidence, and answers in a rendered room."""

import maps_acceptance
import numpy as np
import pytest
from maps_acceptance import calibrate

from mambaloc.errors import InputError
from mambaloc.mapping import PosedFrames
from mambaloc.mapping.building import MapSettings, build_map
from mambaloc.rendering import default_intrinsics, embedded_room, embedded_walk, render
from mambaloc.runtime.maps import MapLocalizer
from mambaloc.runtime.maps.acceptance import MAX_DEVIATION

FIELDS = maps_acceptance._FIELDS


def drawn(count, coefficients, rng):
    """Rows whose poses are right with the probability that the coefficients say."""
    rows = np.zeros((count, len(FIELDS)))
    of = {name: rows[:, column] for column, name in enumerate(FIELDS)}
    of["fold"][:], of["frame"][:], of["picture"][:] = rng.integers(0, 4, count), np.arange(count), 0
    of["cells"][:], of["deviation"][:] = rng.integers(1, 17, count), np.exp(rng.uniform(-5, 0, count))
    of["inliers"][:] = 30
    of["turn_deg"][:] = np.exp(rng.uniform(-2, 2, count))
    known = np.log(np.column_stack((of["cells"] + 0.5, of["deviation"], of["turn_deg"] + 0.1)))
    is_right = rng.random(count) < 1 / (1 + np.exp(-(coefficients[0] + known @ coefficients[1:])))
    of["off_m"][:] = np.where(is_right, 0.05, 0.5)
    return rows, is_right


def test_coefficients_and_shares_of_drawn_evidence(tmp_path):
    coefficients = np.array([-5.0, 3.0, -0.5, -0.8])
    rows, is_right = drawn(20_000, coefficients, np.random.default_rng(0))
    np.savez(tmp_path / "evidence.npz", rows=rows)
    lines = calibrate([tmp_path]).splitlines()
    fitted = np.array(lines[0].split(": ")[1].split(), float)
    np.testing.assert_allclose(fitted, coefficients, atol=0.25)
    assert lines[1].startswith("20000 frames, 20000 images")
    known = np.log(np.column_stack((rows[:, 4] + 0.5, rows[:, 5], rows[:, 6] + 0.1)))
    is_likely = coefficients[0] + known @ coefficients[1:] > np.log(0.95 / 0.05)
    accepted = is_likely & (rows[:, 5] <= MAX_DEVIATION)
    assert accepted.sum() < 0.8 * is_likely.sum()
    (without_bound,) = [line for line in lines if line.startswith("deviations to inf")]
    assert int(without_bound.split("accepted")[1].split()[0]) == pytest.approx(is_likely.sum(), rel=0.05)
    (all_of,) = [line for line in lines if line.startswith("fitted to others, 0.95")]
    assert int(all_of.split("accepted")[1].split()[0]) == pytest.approx(accepted.sum(), rel=0.05)
    wrong = float(all_of.split(", ")[-1].split("%")[0])
    assert wrong == pytest.approx(100 * (accepted & ~is_right).sum() / accepted.sum(), abs=0.3)


def test_one_answer_of_each_picture_counts():
    pictures = np.array([[0, 1, 2], [0, 1, 3], [0, 1, 2], [0, 2, 2]])
    chosen = maps_acceptance._likeliest(pictures, np.array([0.1, 0.2, 0.3, 0.0]))
    assert chosen.tolist() == [False, True, True, True]


def test_evidence_of_a_room():
    """Its fields are those of the answers: undisturbed right and sure, with a wrong focal length off."""
    size = (160, 120)
    intrinsics, poses, room = (
        default_intrinsics(size),
        embedded_walk(20, 1, start_deg=0.0, step_deg=18),
        embedded_room(),
    )
    images = [render(room, intrinsics, pose, size)[0] for pose in poses]
    held = np.arange(20) == 7
    key = PosedFrames([images[row] for row in np.flatnonzero(~held)], np.repeat(intrinsics[None], 19, 0), poses[~held])
    localizer = MapLocalizer(build_map(key, MapSettings(20, 160), "room"))
    rows = np.array(maps_acceptance._answers(localizer, images[7], intrinsics, poses[7], np.random.default_rng(0)))
    of = dict(zip(FIELDS[2:], rows.T, strict=True))
    first = of["disturbance"] == 0
    assert of["off_m"][first][0] < 0.05
    assert of["cells"][first][0] > 6
    shorter = of["disturbance"] == len(maps_acceptance._NAMES) - 2
    assert of["off_m"][shorter].min() > of["off_m"][first][0]
    assert set(of["disturbance"]) >= {0, len(maps_acceptance._NAMES) - 1}


def test_a_folder_without_evidence_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"contains no evidence\.npz"):
        calibrate([tmp_path])
