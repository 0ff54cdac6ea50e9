import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from mambaloc.errors import InputError
from mambaloc.losses import Reprojection
from mambaloc.types import PoseBatch, PosePrediction

SIZE = (48, 64)  # height, width
K = np.array([[60.0, 0, 31.5], [0, 55.0, 23.5], [0, 0, 1]])


def rotations(count: int, seed: int) -> Rotation:
    return Rotation.from_rotvec(np.random.default_rng(seed).normal(size=(count, 3)))


def wxyz(rotation: Rotation) -> Tensor:
    return torch.from_numpy(rotation.as_quat()[:, [3, 0, 1, 2]])


def scene(count: int = 3, points: int = 40, seed: int = 0) -> tuple[PoseBatch, Rotation]:
    """Cameras anywhere, each with points around the middle of what it sees; some fall outside of its image."""
    rng = np.random.default_rng(seed)
    turned, position_m = rotations(count, seed), rng.normal(size=(count, 3))
    cam_m = rng.normal(size=(count, points, 3)) * (1.0, 1.0, 0.5) + (0, 0, 3.0)
    points_m = np.stack([r.apply(p) + t for r, p, t in zip(turned, cam_m, position_m, strict=True)])
    frames = PoseBatch(
        torch.zeros(count, 3, *SIZE),
        torch.from_numpy(position_m),
        wxyz(turned),
        torch.arange(count),
        points_m=torch.from_numpy(points_m),
        intrinsics=torch.from_numpy(K).expand(count, 3, 3),
    )
    return frames, turned


def seen_by_opencv(points_m: np.ndarray, world_from_cam: Rotation, position_m: np.ndarray) -> np.ndarray:
    cam_from_world = world_from_cam.inv()
    translation = -cam_from_world.apply(position_m)
    return cv2.projectPoints(points_m, cam_from_world.as_rotvec(), translation, K, None)[0][:, 0]


@pytest.mark.parametrize("clip_px", [1e6, 12.0])
def test_equals_opencv(clip_px):
    frames, turned = scene()
    rng = np.random.default_rng(1)
    said_m = frames.position_m.numpy() + rng.normal(size=(3, 3)) * 0.05
    said = turned * Rotation.from_rotvec(rng.normal(size=(3, 3)) * 0.05)

    errors_px = []
    for i in range(3):
        points_m = frames.points_m[i].numpy()
        true_px = seen_by_opencv(points_m, turned[i], frames.position_m[i].numpy())
        said_px = seen_by_opencv(points_m, said[i], said_m[i])
        height, width = SIZE
        inside = ((true_px > -0.5) & (true_px < (width - 0.5, height - 0.5))).all(axis=1)
        assert 0 < inside.sum() < len(inside)  # both kinds occur
        errors_px.append(np.minimum(np.abs(said_px - true_px).sum(axis=1), clip_px)[inside].mean())

    loss = Reprojection(clip_px)(PosePrediction(torch.from_numpy(said_m), wxyz(said)), frames)
    assert loss.item() == pytest.approx(np.mean(errors_px), rel=1e-9)


def test_the_true_pose_of_either_sign_and_any_length_has_no_error():
    frames, _ = scene()
    for scale in (1.0, -1.0, 3.0):
        said = PosePrediction(frames.position_m, frames.quaternion * scale)
        assert Reprojection()(said, frames).item() == pytest.approx(0, abs=1e-9)


def test_missing_points_and_frames_without_any_count_nothing():
    frames, _ = scene(count=2)
    said = PosePrediction((frames.position_m + 0.1).requires_grad_(), frames.quaternion)
    alone = PoseBatch(*(getattr(frames, n)[:1] for n in ("image", "position_m", "quaternion", "index")),
                      points_m=frames.points_m[:1], intrinsics=frames.intrinsics[:1])  # fmt: skip
    first = Reprojection()(PosePrediction(said.position_m[:1], said.quaternion[:1]), alone)
    frames.points_m[1] = torch.nan
    both = Reprojection()(said, frames)
    both.backward()
    assert both.item() == pytest.approx(first.item())
    assert said.position_m.grad.isfinite().all()
    assert said.position_m.grad[0].any()
    assert not said.position_m.grad[1].any()


def test_no_point_at_all_is_no_error():
    frames, _ = scene()
    frames.points_m.fill_(torch.nan)
    assert Reprojection()(PosePrediction(frames.position_m + 1, frames.quaternion), frames).item() == 0


def test_points_behind_the_predicted_camera_are_clipped():
    frames, turned = scene()
    about = turned * Rotation.from_rotvec([0, np.pi, 0])
    loss = Reprojection(clip_px=50.0)(PosePrediction(frames.position_m, wxyz(about)), frames)
    assert 0 < loss.item() <= 50


def test_gradient_is_exact():
    frames, turned = scene(count=2)
    position_m = (frames.position_m + 0.02).requires_grad_()
    quaternion = wxyz(turned * Rotation.from_rotvec([0.02, 0.01, -0.02])).requires_grad_()
    loss = Reprojection(1e6)
    assert torch.autograd.gradcheck(lambda p, q: loss(PosePrediction(p, q), frames), (position_m, quaternion))


def test_batches_without_points_are_told_what_to_set():
    frames, _ = scene()
    frames.points_m = None
    with pytest.raises(InputError, match=r"data.points_per_frame"):
        Reprojection()(PosePrediction(frames.position_m, frames.quaternion), frames)


def test_a_clip_is_positive():
    with pytest.raises(ValueError, match="clip_px"):
        Reprojection(0.0)
