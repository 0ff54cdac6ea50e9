"""A tiny teacher and its student, on rendered frames."""

from types import SimpleNamespace

import lightning as L
import pytest
import torch
import yaml

import mambaloc
from mambaloc.cli import main
from mambaloc.data import PoseDataModule
from mambaloc.distillation import LitDistillation, Teacher
from mambaloc.errors import InputError
from mambaloc.models.student import LitStudent
from mambaloc.models.weights import read_checkpoint
from mambaloc.types import PoseBatch

SMALL = {"backbone": "test_efficientnet", "width": 16, "image_size": 32}


@pytest.fixture(scope="module")
def teacher(tmp_path_factory):
    """A checkpoint of a system with its own position scale and pixel statistics."""
    torch.manual_seed(7)
    system = mambaloc.create_model(
        "mambaloc", backbone=SMALL["backbone"], image_size=32, dim=8, heads=2, encoder_layers=1, feedforward=8,
        head_hidden=8, pixel_mean=[0.1, 0.2, 0.3], pixel_std=[0.5, 0.6, 0.7],
    )  # fmt: skip
    system.network.head.position_scale.fit(torch.randn(20, 3) * 3 + 5)
    return saved(system, tmp_path_factory.mktemp("teacher") / "teacher.ckpt")


def saved(system, path):
    trainer = L.Trainer(default_root_dir=path.parent, accelerator="cpu", logger=False, enable_checkpointing=False)
    trainer.strategy.connect(system)
    trainer.save_checkpoint(path)
    return str(path)


def student_of(teacher: str, **kwargs) -> LitDistillation:
    torch.manual_seed(0)
    system = LitDistillation(teacher=teacher, **{**SMALL, **kwargs})
    system.setup("fit")
    return system


def data(scenes) -> PoseDataModule:
    return PoseDataModule("7scenes", str(scenes), "heads", image_size=32, short_side=36, batch_size=4)


def fit(system, scenes, tmp_path, epochs=1, **kwargs):
    trainer = L.Trainer(
        default_root_dir=tmp_path, accelerator="cpu", max_epochs=epochs, logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False, num_sanity_val_steps=0,
    )  # fmt: skip
    L.seed_everything(0, verbose=False)
    trainer.fit(system, datamodule=data(scenes), **kwargs)
    return trainer


def batch(count=3) -> PoseBatch:
    generator = torch.Generator().manual_seed(0)
    quaternion = torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4)
    image = torch.rand(count, 3, 32, 32, generator=generator)
    return PoseBatch(image, torch.randn(count, 3, generator=generator), quaternion, torch.arange(count))


# --- the teacher -----------------------------------------------------------------------------------------------------


@torch.no_grad()
def test_the_teacher_answers_as_it_does_by_itself(teacher):
    system, image = mambaloc.load(teacher), batch().image
    expected, features = system(image), system.network.features(system.network.backbone(image))
    answer = student_of(teacher).teacher(image)
    assert torch.equal(answer.position_m, expected.position_m)
    assert torch.equal(answer.quaternion, expected.quaternion)
    assert torch.equal(answer.feature, torch.cat(features, dim=-1))


def test_the_teacher_is_no_part_of_the_student(teacher):
    system = student_of(teacher)
    own = {id(p) for p in system.teacher.system.parameters()}
    assert own.isdisjoint(id(p) for p in system.parameters())
    system.train()
    assert not system.teacher.system.training
    assert not any("teacher" in name for name in system.state_dict())


def test_the_teacher_is_not_trained(teacher, scenes, tmp_path):
    system = student_of(teacher, lr=1e-2)
    before = {k: v.clone() for k, v in system.teacher.system.state_dict().items()}
    fit(system, scenes, tmp_path)
    assert all(torch.equal(v, before[k]) for k, v in system.teacher.system.state_dict().items())


# --- the three terms -------------------------------------------------------------------------------------------------


def test_each_term_can_be_switched_off(teacher, monkeypatch):
    names = ("hard", "soft", "feature")

    def loss(**weights):
        system = student_of(teacher, dropout=0.0, **{f"{name}_weight": weights.get(name, 0.0) for name in names})
        monkeypatch.setattr(system, "log", lambda *args, **kwargs: None)
        value = system.train().training_step(batch(), 0)
        value.backward()
        return value.item(), {n for n, p in system.named_parameters() if p.grad is not None}

    (hard, by_hard), (soft, by_soft) = loss(hard=1), loss(soft=1)
    everything, by_all = loss(hard=1, soft=2, feature=3)
    both, by_both = loss(hard=1, feature=3)
    assert everything == pytest.approx(both + 2 * soft, rel=1e-5)
    assert 0 < (both - hard) / 3 < 2  # a cosine distance
    assert {n for n in by_all if not n.startswith(("loss", "distillation"))} >= by_hard & by_soft
    assert not any(n.startswith("distillation") for n in by_hard)
    assert not any(n.startswith("loss") for n in by_soft)
    assert not any(n.startswith("distillation.soft") for n in by_both)


def test_the_soft_loss_compares_positions_in_the_scenes_scale(teacher):
    system = student_of(teacher)
    system.network.head.position_scale.fit(torch.tensor([[2.0, 0, 0], [4.0, 0, 0]]))
    normalized = system._normalized(mambaloc.types.PosePrediction(torch.tensor([[5.0, 1.0, 0]]), torch.ones(1, 4)))
    assert normalized.position_m.tolist() == [[2.0, 1.0, 0.0]]


def test_the_latent_feature_is_projected_while_training_only(teacher, tmp_path):
    system = student_of(teacher, width=12)
    assert system.distillation.projection.weight.shape == (16, 12)
    assert not any("projection" in n for n in read_checkpoint(saved(system, tmp_path / "a.ckpt"))["state_dict"])


# --- answers that are kept -------------------------------------------------------------------------------------------


def test_kept_answers_are_those_of_the_center_crops(teacher, scenes, tmp_path, monkeypatch):
    system, asked = student_of(teacher, cache_teacher=True), []
    answer = Teacher.__call__
    monkeypatch.setattr(Teacher, "__call__", lambda self, image: asked.append(len(image)) or answer(self, image))
    trainer = fit(system, scenes, tmp_path, epochs=3)
    frames = trainer.datamodule.frames("train")
    assert sum(asked[1:]) == len(system.answers.position_m) == len(frames)  # the first asks for its width
    expected = torch.cat([answer(system.teacher, batch.image).feature for batch in trainer.datamodule.batches("train")])
    assert torch.equal(system.answers.feature, expected)
    assert torch.equal(system.answers.of(torch.tensor([3, 1])).feature, expected[[3, 1]])


def test_kept_answers_and_views_exclude_each_other(teacher):
    system = student_of(teacher, cache_teacher=True)
    system.trainer = SimpleNamespace(datamodule=SimpleNamespace(hparams={"views": 4}))
    with pytest.raises(InputError, match=r"model.cache_teacher: works with real frames alone"):
        system.on_fit_start()


# --- checkpoints -----------------------------------------------------------------------------------------------------


def test_its_checkpoint_is_a_students(teacher, scenes, tmp_path):
    system = student_of(teacher, width=12)
    trainer = fit(system, scenes, tmp_path)
    trainer.save_checkpoint(tmp_path / "last.ckpt")
    loaded = mambaloc.load(tmp_path / "last.ckpt")
    assert type(loaded) is LitStudent
    with torch.no_grad():
        assert torch.equal(loaded(batch().image).position_m, system.eval()(batch().image).position_m)
    taught = loaded.provenance["distilled"]
    assert (taught["teacher"], taught["soft"], taught["taught_by"]["model"]) == (teacher, "kl", "mambaloc")


@pytest.mark.slow
def test_distillation_resumes_exactly(teacher, scenes, tmp_path):
    kwargs = {"width": 12, "lr": 1e-2}
    fit(student_of(teacher, **kwargs), scenes, tmp_path, epochs=1).save_checkpoint(tmp_path / "first.ckpt")
    resumed, whole = student_of(teacher, **kwargs), student_of(teacher, **kwargs)
    fit(resumed, scenes, tmp_path, epochs=2, ckpt_path=tmp_path / "first.ckpt", weights_only=True)
    fit(whole, scenes, tmp_path, epochs=2)
    state = whole.state_dict()
    assert any(name.startswith("distillation.projection") for name in state)
    assert all(torch.equal(value, state[name]) for name, value in resumed.state_dict().items())


@pytest.fixture(scope="module")
def distilled(teacher, scenes, tmp_path_factory):
    """A recipe, and the folder of its run of two epochs."""
    folder = tmp_path_factory.mktemp("distilled")
    arguments = {"teacher": teacher, "backbone": SMALL["backbone"], "width": SMALL["width"]}
    content = {
        "model": {"class_path": "LitDistillation", "init_args": arguments},
        "data": {"root": str(scenes), "scene": "heads", "image_size": 32, "short_side": 36, "validation": "sequences"},
        "trainer": {"max_epochs": 2, "accelerator": "cpu"},
    }
    recipe = folder / "distil.yaml"
    recipe.write_text(yaml.safe_dump(content))
    main([str(recipe), "--trainer.default_root_dir", str(folder / "run")])
    return recipe, folder / "run"


@pytest.mark.slow
def test_a_recipe_distils_and_evaluates(distilled):
    _, run = distilled
    assert type(mambaloc.load(run / "checkpoints/last.ckpt")) is LitStudent
    assert (run / "evaluation/best/metrics.json").is_file()
    assert (run / "model.onnx").is_file()


@pytest.mark.slow
def test_a_recipe_resumes_the_distillation(teacher, distilled, tmp_path):
    recipe, run = distilled
    words = [str(recipe), "--onnx_export.enabled", "false", "--best_checkpoint.save_top_k", "0"]
    main([*words, "--trainer.default_root_dir", str(tmp_path), "--trainer.max_epochs", "1"])
    main([*words, "--ckpt_path", str(tmp_path / "checkpoints/last.ckpt")])
    whole, resumed = (read_checkpoint(folder / "checkpoints/last.ckpt") for folder in (run, tmp_path))
    assert resumed["mambaloc"]["distilled"]["teacher"] == teacher
    torch.testing.assert_close(resumed["state_dict"], whole["state_dict"], rtol=0, atol=0)
    torch.testing.assert_close(resumed["distillation"], whole["distillation"], rtol=0, atol=0)


def test_a_plain_students_checkpoint_resumes_no_distillation(teacher, scenes, tmp_path):
    path = saved(LitStudent(**SMALL), tmp_path / "student.ckpt")
    with pytest.raises(InputError, match=r"model\.warm_start"):
        fit(student_of(teacher), scenes, tmp_path, ckpt_path=path, weights_only=True)


# --- mistakes --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"teacher": None}, r"model\.teacher: distillation needs one"),
        ({"teacher": "nothing.ckpt"}, "nothing.ckpt: no such checkpoint"),
        ({"image_size": 48}, "32x32 and 48x48 pixels; set data.image_size"),
        ({"hard_weight": 0, "soft_weight": 0}, "one of the first two must be positive"),
        ({"feature_weight": -1}, "none may be negative"),
        ({"compile_mode": "default"}, r"model\.compile_mode: steps with a teacher"),
        ({"soft_args": {"temprature": 3}}, "soft_args"),
        ({"soft": "mse"}, "'kl' or 'l2'"),
    ],
)
def test_mistakes_are_named(kwargs, message, teacher):
    with pytest.raises(InputError, match=message):
        student_of(**{"teacher": teacher, **kwargs})
