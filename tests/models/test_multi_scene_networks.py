"""Networks that know several scenes: each has outputs of its own, beside which the others change nothing."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from mambaloc.errors import InputError
from mambaloc.models import Checkpoint, create_model, list_models
from mambaloc.models.registry import model_class
from mambaloc.nn import PositionScale
from mambaloc.types import PoseBatch

SIZE = (32, 48)
SMALL = {
    "backbone": "test_efficientnet",
    "image_size": SIZE,
    "dim": 16,
    "heads": 2,
    "encoder_layers": 1,
    "feedforward": 16,
}
SYSTEMS = {
    "denseloc": {"position": "points"},
    "multi_scene_transposenet": {"decoder_layers": 1, "head_hidden": 16, "dropout": 0.0},
}
SCENES = ["office", "lab", "hall"]


def build(name, scenes=None, seed=0, **changed):
    torch.manual_seed(seed)
    system = create_model(name, **{**SMALL, **SYSTEMS[name], "scenes": scenes, **changed})
    for module in system.network.modules():
        if isinstance(module, PositionScale) and scenes and "warm_start" not in changed:
            module.mean_m.copy_(torch.randn(len(scenes), 3))
            module.scale_m.copy_(torch.rand(len(scenes)) + 0.5)
    return system


def batch_of(scene, seed=0):
    generator = torch.Generator().manual_seed(seed)
    count = len(scene)
    image = torch.rand(count, 3, *SIZE, generator=generator)
    intrinsics = torch.tensor([[40.0, 0, 23.5], [0, 40, 15.5], [0, 0, 1]]).expand(count, 3, 3)
    position_m = torch.randn(count, 3, generator=generator)
    quaternion = torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=-1)
    return PoseBatch(
        image, position_m, quaternion, torch.arange(count), intrinsics=intrinsics, scene=torch.tensor(scene)
    )


@pytest.fixture(params=SYSTEMS)
def name(request):
    return request.param


def test_the_others_know_one_scene_and_say_so():
    others = [each for each in list_models() if each not in SYSTEMS]
    assert [each for each in others if model_class(each).takes_scenes] == []
    with pytest.raises(InputError, match=r"posenet learns one scene\. For data\.scenes choose denseloc or"):
        create_model("posenet", backbone="test_efficientnet", scenes=SCENES)
    with pytest.raises(InputError, match=r"learns one scene\. For data\.scenes choose dense"):
        build("denseloc", SCENES, head="token")


@pytest.mark.parametrize("index", range(3))
def test_in_a_scene_a_dense_head_answers_as_a_network_of_that_scene_alone(index):
    """Oracle: a network of one scene that has those rows of the tables, and all other weights."""
    several, alone = build("denseloc", SCENES).eval(), build("denseloc", seed=1).eval()
    tables, own = several.network.scene_tables, alone.network.state_dict()
    state = several.network.state_dict()
    for key in own:
        if key.startswith(tables):
            own[key] = state[key].reshape(len(SCENES), -1)[index].view_as(own[key])
        else:
            own[key] = state[key]
    alone.network.load_state_dict(own)
    batch = batch_of([index] * 4)
    with torch.inference_mode():
        told, expected = several(batch.image, batch.intrinsics, batch.scene), alone(batch.image, batch.intrinsics)
    torch.testing.assert_close(told.position_m, expected.position_m)
    torch.testing.assert_close(told.quaternion, expected.quaternion)


def test_features_are_kept_of_one_scene_alone():
    with pytest.raises(InputError, match=r"model\.feature_cache_gib: keeps features of one scene"):
        build("denseloc", SCENES, feature_cache_gib=0.1)


def test_a_loss_of_nan_is_not_left_out_of_the_mean_over_scenes(name):
    system, batch = build(name, SCENES).eval(), batch_of([0, 1])
    bad = replace(batch, position_m=batch.position_m * torch.nan)
    for each in (batch, bad):
        system.validation_step(each, 0)
    assert system.val_loss.compute().isnan()


def test_without_a_scene_the_pose_is_the_likeliest_ones(name):
    system, batch = build(name, SCENES).eval(), batch_of([0] * 5)
    with torch.inference_mode():
        free = system(batch.image, batch.intrinsics)
        asked = system(batch.image, batch.intrinsics, free.scene_logits.argmax(dim=-1))
    torch.testing.assert_close(free.position_m, asked.position_m, rtol=0, atol=0)
    assert free.scene_logits.shape == (5, 3)


def test_a_pose_in_another_scenes_frame_is_no_pose(name):
    system, batch = build(name, SCENES).eval(), batch_of([0, 1, 2, 0])
    with torch.inference_mode():
        prediction = system(batch.image, batch.intrinsics)
    system.val_errors.update(prediction, batch)
    is_right = prediction.scene_logits.argmax(dim=-1) == batch.scene
    table = system.val_errors.table()
    assert (table.position_error_m.isfinite() == is_right).all()
    assert (table.rotation_error_deg.isfinite() == is_right).all()
    assert (table.predicted_position_m.isfinite().all(dim=1) == is_right).all()
    assert (table.predicted_quaternion.isfinite().all(dim=1) == is_right).all()


def test_frames_of_one_scene_teach_the_outputs_of_no_other(name):
    system = build(name, SCENES).train()
    batch = batch_of([1, 1])
    loss = system.loss(system(batch.image, batch.intrinsics, batch.scene), batch)
    loss.backward()
    for key, parameter in system.network.named_parameters():
        if key.startswith(system.network.scene_tables) and parameter.grad is not None:
            rows = parameter.grad.reshape(len(SCENES), -1).abs().sum(dim=1)
            if key.startswith("scene_head"):
                continue
            if "decoder.queries" in key:  # queries attend to one another
                assert rows[1] > 0
            else:
                assert (rows > 0).tolist() == [False, True, False], key


def checkpoint_of(system, path):
    stored = {
        "state_dict": system.state_dict(),
        "hyper_parameters": dict(system.hparams),
        "mambaloc": {"model": system.registry_name},
        "datamodule_hyper_parameters": {"scene": "lab"},
    }
    torch.save(stored, path)
    return str(path)


@pytest.mark.parametrize("known", [["hall", "office"], None])
def test_known_scenes_keep_their_outputs_among_new_ones(known, tmp_path):
    before = build("denseloc", known, seed=2).eval()
    path = checkpoint_of(before, tmp_path / "before.ckpt")
    after = build("denseloc", SCENES, seed=3, warm_start=path).eval()
    batch = batch_of([0] * 3)
    for old, scene in enumerate(known or ["lab"]):
        asked = torch.full((3,), old) if known else None
        with torch.inference_mode():
            expected = before(batch.image, batch.intrinsics, asked)
            told = after(batch.image, batch.intrinsics, torch.full((3,), SCENES.index(scene)))
        torch.testing.assert_close(told.position_m, expected.position_m)
        torch.testing.assert_close(told.quaternion, expected.quaternion)


def test_with_new_scenes_only_the_others_do_not_change(tmp_path):
    path = checkpoint_of(build("denseloc", ["hall", "office"], seed=2), tmp_path / "before.ckpt")
    system = build("denseloc", SCENES, seed=3, warm_start=path, new_scenes_only=True).train()
    batch, before = batch_of([0, 1, 2]), {key: value.clone() for key, value in system.state_dict().items()}
    optimizer = system.configure_optimizers()["optimizer"]
    for _ in range(3):
        prediction = system(batch.image, batch.intrinsics, batch.scene)
        loss = system.loss(prediction, batch) + torch.nn.functional.cross_entropy(prediction.scene_logits, batch.scene)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    is_changed = {
        key: (value.reshape(len(SCENES), -1) != before[key].reshape(len(SCENES), -1)).any(dim=1).tolist()
        if key.removeprefix("network.").startswith(system.network.scene_tables)
        else [bool((value != before[key]).any())]
        for key, value in system.state_dict().items()
        if key.startswith("network.")
    }
    lab = [False, True, False]
    assert {key for key, changed in is_changed.items() if any(changed)} == {
        f"network.{head}.{kind}"
        for head in ("head.rotation.0", "head.position.0", "head.points.0", "scene_head")
        for kind in ("weight", "bias")
    }
    assert all(changed in (lab, [False], [False] * 3) for changed in is_changed.values())


def test_what_learned_new_scenes_alone_is_loaded_without_its_start(tmp_path):
    path = checkpoint_of(build("denseloc", ["hall", "office"], seed=2), tmp_path / "before.ckpt")
    system = build("denseloc", SCENES, seed=3, warm_start=path, new_scenes_only=True).eval()
    after = checkpoint_of(system, tmp_path / "after.ckpt")
    Path(path).unlink()
    batch = batch_of([0, 1, 2])
    with torch.inference_mode():
        expected, told = (
            each(batch.image, batch.intrinsics, batch.scene) for each in (system, Checkpoint.read(after).system())
        )
    torch.testing.assert_close(told.position_m, expected.position_m, rtol=0, atol=0)


def test_new_scenes_alone_need_a_checkpoint_and_a_new_scene(tmp_path):
    with pytest.raises(InputError, match=r"needs model\.warm_start"):
        build("denseloc", SCENES, new_scenes_only=True)
    path = checkpoint_of(build("denseloc", SCENES), tmp_path / "all.ckpt")
    with pytest.raises(InputError, match="knows all scenes"):
        build("denseloc", SCENES, warm_start=path, new_scenes_only=True)
