"""Disturbances by hand, the paired check, intervals against SciPy, and the whole on a rendered room."""

import json

import cv2
import maps_robustness
import numpy as np
import pytest
from maps_colmap import ColmapRoute, WrittenImages
from maps_disturbances import DISTURBANCES, exposure, motion_blur, occlusion, smaller
from maps_report import summarize, table, write_result
from maps_robustness import Answers, compare, measure, wilson_interval
from scipy.spatial.transform import Rotation
from scipy.stats import binomtest

from mambaloc.evaluation.intervals import block_resamples
from mambaloc.mapping import PosedFrames
from mambaloc.mapping.building import MapSettings, build_map
from mambaloc.rendering import default_intrinsics, embedded_room, embedded_walk, render
from mambaloc.runtime import Localization

SIZE = (160, 120)


class Direction:
    """A generator that draws one direction of blur."""

    def __init__(self, angle):
        self.angle = angle

    def uniform(self, low, high):
        return self.angle


def test_blur_makes_a_ramp_of_its_length_across_an_edge_and_leaves_it_along_the_edge():
    edge = np.zeros((60, 640, 3), np.uint8)
    edge[:, 320:] = 240
    across = motion_blur(edge, Direction(0), length_px=15)[30, :, 0].astype(float)
    assert across[:312].max() == 0
    assert across[328:].min() == 240
    np.testing.assert_allclose(np.diff(across[313:327]), 240 / 15, atol=2.5)
    np.testing.assert_array_equal(motion_blur(edge, Direction(np.pi / 2), length_px=15), edge)


def test_blur_is_as_long_as_the_picture_is_wide():
    edge = np.zeros((60, 160, 3), np.uint8)
    edge[:, 80:] = 240
    assert np.ptp(np.flatnonzero(np.diff(motion_blur(edge, Direction(0), length_px=60)[30, :, 0]))) in (14, 15, 16)


@pytest.mark.parametrize("length_px", [15, 31, 61])
def test_blur_conserves_the_mean(length_px):
    image = np.full((480, 640, 3), 100, np.uint8)
    image[150:330, 200:440] = np.random.default_rng(0).integers(0, 256, (180, 240, 3))
    for seed in range(3):
        blurred = motion_blur(image, np.random.default_rng(seed), length_px=length_px)
        assert blurred.mean() == pytest.approx(image.mean(), abs=0.05)
        assert blurred[150:330, 200:440].std() < 0.5 * image[150:330, 200:440].std()


@pytest.mark.parametrize("share", [0.3, 0.6])
def test_exactly_so_much_is_covered_by_grey_and_texture(share):
    """What is covered does not depend on what was there, and the rest is as it was."""
    for seed in range(3):
        dark, light = (
            occlusion(np.full((97, 131, 3), value, np.uint8), np.random.default_rng(seed), share) for value in (0, 255)
        )
        same = (dark == light).all(axis=-1)
        assert same.sum() == round(share * 97 * 131)
        assert (dark[~same] == 0).all()
        assert (light[~same] == 255).all()
        colors = np.unique(dark[same], axis=0)
        assert (colors.min(axis=1) == colors.max(axis=1)).any()  # grey
        assert len(colors) > 10  # and texture


@pytest.mark.parametrize("gain", [0.3, 0.1])
def test_exposure_scales_and_adds_noise(gain):
    image = np.full((240, 320, 3), 200, np.uint8)
    dark = exposure(image, np.random.default_rng(0), gain=gain).astype(float)
    assert dark.mean() == pytest.approx(200 * gain, abs=0.1)
    assert dark.std() == pytest.approx(3, abs=0.1)


def test_a_quarter_of_the_width_averages_squares():
    image = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    means = image.reshape(12, 4, 16, 4, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(smaller(image, np.random.default_rng(0), 4), means, atol=0.51)


def test_disturbances_are_the_same_again():
    image = np.random.default_rng(0).integers(0, 256, (60, 80, 3), dtype=np.uint8)
    for disturb in DISTURBANCES.values():
        first, second, other = (disturb(image, np.random.default_rng(seed)) for seed in (5, 5, 6))
        np.testing.assert_array_equal(first, second)
        assert (
            disturb in (DISTURBANCES["undisturbed"], DISTURBANCES["a quarter of the width"]) or (first != other).any()
        )


@pytest.mark.parametrize(("hits", "trials"), [(0, 200), (1, 190), (3, 17), (5, 5)])
def test_intervals_against_scipy(hits, trials):
    expected = binomtest(hits, trials).proportion_ci(method="wilson")
    assert wilson_interval(hits, trials) == pytest.approx((expected.low, expected.high), abs=1e-6)


def test_nothing_accepted_says_nothing():
    assert wilson_interval(0, 0) == (0, 1)


def answers(position_m, rotation_deg=1.0, is_accepted=True):
    position_m = np.atleast_2d(np.asarray(position_m, float))
    full = np.ones(position_m.shape)
    return Answers(position_m, rotation_deg * full, full.astype(bool) & is_accepted, 0.01 * full)


RESAMPLES = block_resamples(["a"] * 100 + ["b"] * 100)


def test_a_constant_loss_is_found_exactly():
    alone = np.random.default_rng(0).uniform(0.02, 0.1, 200)
    found = compare(answers(alone + 0.05), answers(alone), RESAMPLES)
    assert found["position_error_m"] == pytest.approx((0.05, 0.05, 0.05))
    assert found["rotation_error_deg"] == (0, 0, 0)
    assert found["wrong"] == (0, 0, 0)


def test_noise_is_not_taken_for_a_loss():
    rng = np.random.default_rng(1)
    one, other = rng.uniform(0.02, 0.1, (2, 200))
    _, low, high = compare(answers(one), answers(other), RESAMPLES)["position_error_m"]
    assert low < 0 < high


def test_frames_without_a_pose_count_as_infinitely_wrong():
    alone = np.where(np.arange(200) % 2 == 0, np.inf, 0.03)
    found = compare(answers(np.full(200, 0.03)), answers(alone), RESAMPLES)
    assert found["wrong"][0] == pytest.approx(-0.5)
    assert found["position_error_m"][2] <= 0


def test_seeds_are_resampled_with_their_frames():
    """Two seeds of the same errors change nothing."""
    alone = np.random.default_rng(0).uniform(0.02, 0.1, 200)
    worse = alone + np.random.default_rng(2).normal(0.01, 0.01, 200)
    once = compare(answers(worse), answers(alone), RESAMPLES)["position_error_m"]
    twice = compare(answers([worse, worse]), answers([alone, alone]), RESAMPLES)["position_error_m"]
    assert once == pytest.approx(twice)


def test_table_says_where_both_are_worse_and_how_many_accepted_poses_are_wrong():
    good, bad = np.full(200, 0.03), np.full(200, 0.25)
    rule = np.arange(200) < 100
    found = {
        "undisturbed": {"network": answers(bad, is_accepted=False), "map": answers(good), "both": answers(good)},
        "dark": {
            "network": answers(bad, is_accepted=False),
            "map": answers(good, is_accepted=rule),
            "both": answers(bad, is_accepted=rule),
        },
    }
    result = summarize(found, ["a"] * 200, {"label": "room", "unit": "m"})
    lines = table(result).splitlines()
    assert lines[4].endswith("| not worse |")
    assert "worse than map: +0.22 (0.22 to 0.22) m median; worse than map: +100 (100 to 100) % wrong |" in lines[7]
    assert "| 50.0 % | 100.0 % (96.3 to 100.0) |" in lines[7]  # of 100 accepted
    assert lines[-1].startswith("Accepted and wrong over all rows: 33.3 %")


@pytest.fixture(scope="module")
def room():
    """24 key frames around a rendered room, and 4 queries among them."""
    intrinsics, poses = default_intrinsics(SIZE), embedded_walk(28, 1, start_deg=0.0, step_deg=360 / 28)
    room = embedded_room()
    images = [render(room, intrinsics, pose, SIZE)[0] for pose in poses]
    frames = PosedFrames(images, np.repeat(intrinsics[None], 28, axis=0), poses)
    is_query = np.arange(28) % 7 == 3
    return frames.select(np.flatnonzero(~is_query)), frames.select(np.flatnonzero(is_query))


class Stuck:
    """A network that always answers the first query's place."""

    def __init__(self, world_from_cam):
        quaternion = Rotation.from_matrix(world_from_cam[:3, :3]).as_quat()[[3, 0, 1, 2]]
        self.answer = Localization(world_from_cam[:3, 3], quaternion, 0.0)

    def localize(self, image):
        return self.answer


def test_network_map_and_both_under_every_disturbance(room):
    key, queries = room
    sparse_map = build_map(key, MapSettings(key_frames=24, width=160), "room")
    found = measure(sparse_map, Stuck(queries.world_from_cam[0]), queries, [0, 1])
    assert list(found) == list(DISTURBANCES)
    moved_m = np.linalg.norm(queries.world_from_cam[:, :3, 3] - queries.world_from_cam[0, :3, 3], axis=1)
    for ways in found.values():
        assert list(ways) == ["network", "map", "both"]
        assert ways["both"].position_m.shape == (2, 4)
        np.testing.assert_allclose(ways["network"].position_m, moved_m[None], atol=1e-9)
        of_map = np.isfinite(ways["map"].position_m) & np.isclose(ways["both"].position_m, ways["map"].position_m)
        of_network = np.isclose(ways["both"].position_m, moved_m, atol=1e-9)
        assert (of_network | of_map | ~ways["map"].is_accepted).all()
    seen = found["undisturbed"]
    assert seen["map"].is_accepted.any()
    np.testing.assert_array_equal(
        seen["both"].position_m[seen["map"].is_accepted], seen["map"].position_m[seen["map"].is_accepted]
    )
    assert np.median(seen["map"].position_m) < 0.05
    assert not found["exposure x 0.1"]["map"].is_accepted.all()


def test_a_map_alone_is_measured(room):
    key, queries = room
    sparse_map = build_map(key, MapSettings(key_frames=24, width=160), "room")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(maps_robustness, "DISTURBANCES", {"undisturbed": DISTURBANCES["undisturbed"]})
        found = measure(sparse_map, None, queries, [0])
    assert list(found["undisturbed"]) == ["map"]
    assert "| undisturbed | map |" in table(summarize(found, ["walk"] * 4, {"label": "room", "unit": "m"}))


def test_colmap_localizes_in_the_same_room(room, tmp_path):
    """Its pose within 5 cm shows that pixels, cameras and poses are handed over in COLMAP's conventions."""
    key, queries = room
    shown, asked = (
        WrittenImages.write(each, SIZE[0], tmp_path / name) for each, name in ((key, "key"), (queries, "query"))
    )
    (tmp_path / "work").mkdir()
    route = ColmapRoute(shown, tmp_path / "work")
    route.build()
    poses = route.localize(asked)
    off_m = [
        np.inf if pose is None else np.linalg.norm(pose[:3, 3] - truth[:3, 3])
        for pose, truth in zip(poses, queries.world_from_cam, strict=True)
    ]
    assert np.median(off_m) < 0.05
    assert cv2.imread(str(tmp_path / "query" / asked.names[0])).shape == (SIZE[1], SIZE[0], 3)
    assert route.bytes() > 100_000


def test_report_of_several_scenes_from_a_shell(tmp_path, tool, capsys):
    rng = np.random.default_rng(0)
    for name in ("one", "two"):
        found = {
            each: {
                "network": answers(rng.uniform(0.1, 0.4, 40), is_accepted=False),
                "map": answers(np.where(rng.random(40) < 0.6, np.inf, 0.03)),
                "both": answers(rng.uniform(0.02, 0.1, 40)),
            }
            for each in DISTURBANCES
        }
        about = {"label": name, "unit": "m"}
        about["network"] = {"bytes": 10 * 2**20, "preparation_cpu_s": 100.0 if name == "one" else None}
        about["map"] = {"bytes": 2**20, "preparation_cpu_s": 2.5}
        write_result(summarize(found, ["a"] * 40, about), found, tmp_path / name)
    read = json.loads((tmp_path / "one/robustness.json").read_text())
    assert read["disturbances"]["undisturbed"]["ways"]["map"]["position_error_m"] is None  # JSON has no infinity
    assert np.load(tmp_path / "one/answers.npz")["undisturbed/both/position_m"].shape == (1, 40)
    tool("benchmarks/maps", "report", tmp_path / "one", tmp_path / "two", "--out", tmp_path / "figure.png")
    said = capsys.readouterr().out
    assert "| 10 ms | 11.00 MiB | 102 core-s |" in said  # both of one
    assert "| 10 ms | 11.00 MiB |  |" in said
    assert said.count("| exposure x 0.1 |") == 2
    assert "no pose; " in said
    assert cv2.imread(str(tmp_path / "figure.png")).shape[1] > 600
    with pytest.raises(SystemExit):
        tool("benchmarks/maps", "report", tmp_path / "none", "--out", tmp_path / "figure.png")
    assert "measure it with maps.py robustness" in capsys.readouterr().err
