"""One localizer of a network and a sparse map: which answers, and what becomes of a map that cannot be used.

The network knows another scene; for what is tested here it only has to answer.
"""

import runpy
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mambaloc.errors import InputError, InputWarning
from mambaloc.images import read_image
from mambaloc.runtime import Localizer
from mambaloc.runtime.maps import MapLocalizer, SparseMap

TOOL = Path(__file__).parents[2] / "tools" / "localize.py"
GREY = np.full((120, 160, 3), 128, np.uint8)


@pytest.fixture(scope="module")
def network(bundle_of_tensors):
    return bundle_of_tensors / "model.onnx"


@pytest.fixture
def both(network, map_of_den):
    return Localizer(network, 1, map_of_den)


@pytest.fixture(scope="module")
def frame(den):
    return den / "den/seq-02/frame-000002.color.png"


def truth(frame):
    return np.loadtxt(frame.with_name(frame.name.replace("color.png", "pose.txt")))


@pytest.fixture
def bundle(bundle_of_tensors, map_of_den, tmp_path):
    folder = tmp_path / "bundle"
    folder.mkdir()
    shutil.copy(bundle_of_tensors / "model.onnx", folder)
    shutil.copy(map_of_den, folder)
    return folder


def check_is_of_the_map(found, frame):
    turn = Rotation.from_matrix(truth(frame)[:3, :3]).inv() * Rotation.from_quat(found.quaternion, scalar_first=True)
    assert found.source == "map"
    assert np.linalg.norm(found.position_m - truth(frame)[:3, 3]) < 0.03
    assert np.degrees(turn.magnitude()) < 1


# --- which answers ----------------------------------------------------------------------------------------------------


def test_the_map_answers_where_it_is_sure(both, frame, map_of_den):
    found, alone = both.localize(frame), MapLocalizer(SparseMap.load(map_of_den)).localize(read_image(frame))
    check_is_of_the_map(found, frame)
    np.testing.assert_array_equal(found.position_m, alone.position_m)
    np.testing.assert_array_equal(found.covariance, alone.covariance)
    assert found.inliers == alone.inliers
    assert 0 < found.position_radius_m < 0.2
    assert 0 < found.rotation_radius_deg < 5


def test_a_folder_with_a_map_alone_is_localized_in(map_of_den, frame, tmp_path):
    (tmp_path / "map.safetensors").write_bytes(map_of_den.read_bytes())
    localizer = Localizer(tmp_path)
    assert localizer.contract is None
    check_is_of_the_map(localizer.localize(frame), frame)


def test_the_network_answers_where_the_map_does_not(both, network):
    found, alone = both.localize(GREY), Localizer(network, 1).localize(GREY)
    assert (found.source, found.inliers, found.covariance) == ("network", 0, None)
    np.testing.assert_array_equal(found.position_m, alone.position_m)
    np.testing.assert_array_equal(found.quaternion, alone.quaternion)
    assert (alone.source, alone.inliers) == ("network", None)


def test_the_networks_pose_is_what_the_map_searches_around(both, frame, monkeypatch):
    priors = []
    monkeypatch.setattr(MapLocalizer, "localize", lambda self, image, k, prior: priors.append(prior) or pytest.skip)
    with pytest.raises(AttributeError):  # what stands in for an answer is none
        both.localize(frame)
    monkeypatch.undo()
    alone = both._network.localize([read_image(frame)])[0]
    np.testing.assert_array_equal(priors[0].position_m, alone.position_m)
    expected = Rotation.from_quat(alone.quaternion, scalar_first=True).as_matrix()
    np.testing.assert_allclose(priors[0].rotation, expected, atol=1e-6)


def test_a_bundle_brings_its_map(bundle, frame, map_of_den):
    check_is_of_the_map(Localizer(bundle, 1).localize(frame), frame)
    assert Localizer(bundle, 1).scene == "7scenes/heads"
    assert Localizer(bundle, 1, sparse_map=False).localize(frame).source == "network"
    assert Localizer(bundle / "model.onnx", 1).sparse_map is None  # a model's file is that model alone
    loaded = SparseMap.load(map_of_den)
    assert Localizer(bundle / "model.onnx", 1, loaded).sparse_map is loaded


def test_a_map_localizes_without_a_network(map_of_den, frame):
    localizer = Localizer(map_of_den)
    assert (localizer.contract, localizer.scene) == (None, "den")
    check_is_of_the_map(localizer.localize(frame), frame)
    lost = localizer.localize(GREY)
    assert lost.source is None
    assert np.isnan(lost.position_m).all()
    with pytest.raises(InputError, match="its shape differs from the map's images of 160x120"):
        localizer.localize(np.zeros((72, 72, 3), np.uint8))


# --- other cameras ----------------------------------------------------------------------------------------------------


def test_a_picture_of_another_shape_needs_its_intrinsics(both, frame, map_of_den):
    """The frame without its lowest 20 rows: the same camera, whose centre is no longer the image's."""
    cut = read_image(frame)[:100]
    with pytest.warns(
        InputWarning, match=r"160x100: its shape differs .* The network answers without the map\."
    ) as said:
        answers = [both.localize(cut) for _ in range(3)]
    assert [each.source for each in answers] == ["network"] * 3
    assert "\n" not in str(said[0].message)
    check_is_of_the_map(both.localize(cut, SparseMap.load(map_of_den).intrinsics), frame)


def test_it_is_said_once(both):
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("default")
        for _ in range(3):
            both.localize(np.zeros((100, 160, 3), np.uint8))
    assert len(said) == 1


@pytest.mark.parametrize("intrinsics", [np.eye(3), np.zeros(3), np.full((3, 3), np.nan)])
def test_a_camera_that_cannot_be_leaves_the_network(both, frame, intrinsics, map_of_den):
    with pytest.warns(InputWarning, match=r"intrinsics .*: cannot be the camera .* without the map\."):
        assert both.localize(frame, intrinsics).source == "network"
    with pytest.raises(InputError, match="cannot be the camera"):
        Localizer(map_of_den).localize(frame, intrinsics)


def test_a_wrong_camera_is_not_accepted(both, frame):
    """Twice the focal length: matches agree with no pose of such a camera."""
    wrong = np.array([[288.0, 0, 79.5], [0, 288, 59.5], [0, 0, 1]])
    assert both.localize(frame, wrong).source == "network"


@pytest.mark.parametrize(("scale", "said"), [(1 / 1.1, "10 % too short"), (1.1, "10 % too long")])
def test_a_focal_length_that_is_a_tenth_off_is_said(scale, said, map_of_den, frame):
    """A tenth moves the pose by decimetres, which nothing else shows."""
    wrong = np.array([[144.0 * scale, 0, 79.5], [0, 144 * scale, 59.5], [0, 0, 1]])
    with pytest.warns(InputWarning, match=f"the focal length is about {said}"):
        found = Localizer(map_of_den).localize(frame, wrong)
    assert (found.source, found.covariance) == (None, None)
    assert found.focal_scale == pytest.approx(1 / scale, abs=0.05)


# --- bad maps ---------------------------------------------------------------------------------------------------------


def damage(path, how):
    content = bytearray(path.read_bytes())
    if how == "newer":
        content = content.replace(b'\\"version\\": 1', b'\\"version\\": 9')
    elif how == "cut":
        del content[len(content) // 2 :]
    else:
        content[-1] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("how", "message"), [("newer", "Update mambaloc"), ("cut", "is damaged"), ("flipped", "checksum differs")]
)
def test_a_bad_map_in_a_bundle_leaves_the_network(how, message, bundle, frame):
    damage(bundle / "map.safetensors", how)
    with pytest.warns(InputWarning, match=rf"map\.safetensors: .*{message}.*The network answers") as said:
        localizer = Localizer(bundle, 1)
    assert "\n" not in str(said[0].message)
    assert localizer.localize(frame).source == "network"
    with pytest.raises(InputError, match=message):  # named, it is a mistake
        Localizer(bundle / "model.onnx", 1, bundle / "map.safetensors")
    with pytest.raises(InputError, match=message):
        Localizer(bundle / "map.safetensors")


def test_a_map_that_is_not_there_is_refused(network, tmp_path):
    with pytest.raises(InputError, match=r"none\.safetensors: cannot be read"):
        Localizer(network, 1, tmp_path / "none.safetensors")


# --- the tool ---------------------------------------------------------------------------------------------------------


def tool(*words):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["localize", *map(str, words)])
        runpy.run_path(str(TOOL), run_name="__main__")


@pytest.fixture
def pictures(den, tmp_path):
    """Two frames, and between them a grey one."""
    folder = tmp_path / "pictures"
    folder.mkdir()
    for name, number in (("a.png", 1), ("c.png", 4)):
        shutil.copy(den / f"den/seq-02/frame-{number:06d}.color.png", folder / name)
    cv2.imwrite(str(folder / "b.png"), GREY)
    return folder


def test_the_tool_counts_what_answered(bundle, map_of_den, pictures, den, tmp_path, capsys):
    out = tmp_path / "poses.tum"
    tool(bundle, pictures, "--out", out)
    assert "3 poses (2 from the map, 1 from the network) in 7scenes/heads, median" in capsys.readouterr().out
    tool(bundle / "model.onnx", pictures, "--map", map_of_den, "--filter", "smooth", "--out", out)
    assert "outliers, 2 from the map, 1 from the network)" in capsys.readouterr().out
    tool(bundle, pictures, "--no-map", "--out", out)
    assert "3 poses in 7scenes/heads, median" in capsys.readouterr().out
    tool(map_of_den, pictures, "--out", out, "--intrinsics", "144,144,79.5,59.5")
    assert "2 poses (1 frames without a pose) in den, median" in capsys.readouterr().out
    written = np.loadtxt(out)
    np.testing.assert_allclose(written[:, 0], [0, 2 / 30], atol=1e-8)  # the grey one is left out
    expected = [truth(den / f"den/seq-02/frame-{n:06d}.color.png")[:3, 3] for n in (1, 4)]
    np.testing.assert_allclose(written[:, 1:4], expected, atol=0.03)


def test_the_tool_says_in_a_line_what_keeps_the_map_from_being_used(bundle, pictures, tmp_path):
    damage(bundle / "map.safetensors", "cut")
    words = [sys.executable, TOOL, bundle, pictures, "--out", tmp_path / "poses.tum"]
    result = subprocess.run(list(map(str, words)), capture_output=True, text=True, check=True)
    (said,) = [line for line in result.stderr.splitlines() if "map.safetensors" in line]
    assert said.startswith("warning: ")


def test_the_tool_refuses_in_a_line(map_of_den, pictures, tmp_path, capsys):
    for words, message in (
        ((map_of_den, pictures, "--intrinsics", "1,2"), "1,2: give FX,FY,CX,CY in pixels"),
        ((map_of_den, pictures / "b.png"), "none of its 1 frames was localized"),
        ((tmp_path / "map.safetensors", pictures), "cannot be read"),
    ):
        with pytest.raises(SystemExit) as ended:
            tool(*words, "--out", tmp_path / "poses.tum")
        assert ended.value.code == 2
        assert message in capsys.readouterr().err
