"""What GIS, a system and its exported forms cost: sizes are the paper's, times are taken in turns."""

from functools import partial

import pytest
import torch

from mambaloc.benchmark import Latency, forward_flops, latency, measure_deployment, measure_latency, size_of
from mambaloc.benchmark.deployment import speed_up
from mambaloc.benchmark.report import print_deployments, print_latencies, print_sizes
from mambaloc.benchmark.sizes import PROGRAMS, UNEXPLAINED
from mambaloc.data import PoseDataModule
from mambaloc.errors import InputError
from mambaloc.models import create_model
from mambaloc.models.weights import mib


def test_latency_is_timed_in_turns(monkeypatch):
    monkeypatch.setattr(latency, "create_model", partial(create_model, backbone="test_efficientnet", width=16))
    found = measure_latency(["student", "mapnet"], image_size=64, batches=(1, 2), repetitions=4)
    assert [(each.system, each.batch, each.what) for each in found] == [
        (system, batch, what)
        for system in ("student", "mapnet")
        for batch in (1, 2)
        for what in ("forward", "training step")
    ]
    assert all(len(each.without_s) == len(each.with_s) == 4 for each in found)
    assert all(min(each.without_s + each.with_s) > 0 for each in found)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"repetitions": 3}, "--repetitions 3"),
        ({"device": "cuda"}, "--device cuda: not available; choose one of cpu"),
        ({"device": "gpu"}, "gpu"),
    ],
)
def test_what_latency_cannot_measure(kwargs, message, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match=message):
        measure_latency(["student"], **kwargs)


def test_latency_by_hand():
    times = Latency("student", "forward", 1, without_s=[1.0, 2.0, 4.0], with_s=[1.5, 2.0, 8.0])
    assert times.ratio == 1
    assert times.spread == pytest.approx(1.0)  # of the ratios 1.5, 1, 2


def test_operations_of_gis_are_those_of_its_products():
    with_gis, without = (forward_flops("student", gis, 64) for gis in ("gis", "none"))
    assert 0 < with_gis - without < 2 * 2 * 1_694_720  # two operations a parameter and token, of two tokens


@pytest.mark.parametrize(("name", "gis", "published"), [
    ("posenet", "none", 22_349_639),
    ("posenet", "gis", 22_349_639 + 26_439_680),
    ("lstm_posenet", "none", 23_594_822),
    ("lstm_posenet", "gis", 23_594_822 + 6_666_240),
    ("atloc", "none", 24_447_558),
    ("atloc", "gis", 24_447_558 + 6_666_240),
    ("transposenet", "none", 10_635_371),
    ("transposenet", "gis", 11_073_131),
    ("mambaloc", "none", 10_635_371),
    ("mambaloc", "gis", 11_073_131),
    ("student", "none", 5_948_011),
])  # fmt: skip
def test_published_accounting_is_the_papers(name, gis, published):
    size = size_of(name, gis)
    assert size.published == published
    if size.paper_mib is not None and (name, gis) not in UNEXPLAINED:
        assert mib(published) == pytest.approx(size.paper_mib, abs=0.05)


@pytest.mark.parametrize(("name", "gis", "shipped"), [
    ("posenet_learned", "none", 22_349_639),
    ("posenet_geometric", "none", 22_349_639),
    ("mapnet", "none", 22_347_590),
    ("mapnet", "gis", 22_347_590 + 26_439_680),
    ("transbonet", "none", 29_730_359),
    ("transbonet", "gis", 29_730_359 + 26_439_680),
    ("transposenet", "none", 6_186_855),
    ("mambaloc", "gis", 6_624_615),
    ("student", "none", 4_667_011),
    ("student", "gis", 4_667_011 + 2 * 847_360),
])  # fmt: skip
def test_what_is_shipped(name, gis, shipped):
    assert size_of(name, gis).shipped == shipped


def test_published_programs_have_what_the_accounting_says():
    for (name, gis), counted in PROGRAMS.items():
        assert size_of(name, gis).program == size_of(name, gis).published == counted
    assert size_of("atloc", "none").shipped == 24_447_558
    assert size_of("atloc", "gis").program is None


def test_what_the_published_models_carry():
    assert size_of("mambaloc", "gis").replaced["never reaches an output"] == 4_436_740
    assert size_of("student", "none").replaced == {"unused classifier": 1_281_000}
    assert size_of("posenet", "none").replaced == {}


def test_the_one_unexplained_base_is_no_rounding():
    ((name, gis),) = UNEXPLAINED
    size = size_of(name, gis)
    assert mib(size.published) == pytest.approx(90.01, abs=0.005)
    assert abs(mib(size.published) - size.paper_mib) > 0.3


def test_tables_say_what_was_measured(capsys):
    print_sizes([size_of("lstm_posenet", "none"), size_of("student", "none"), size_of("transposenet", "none")])
    said = capsys.readouterr().out
    assert "6,186,855 23.60 10,635,371 40.57 40.57" in " ".join(said.split())
    assert "transposenet: counted in the published program itself: 10,635,371" in said
    assert "transposenet: never reaches an output +4,436,740" in said
    assert "23,594,822" in said
    assert "the paper's 89.60 is unexplained" in said
    assert "student: unused classifier +1,281,000" in said
    print_latencies([Latency("student", "forward", 8, [0.1] * 4, [0.103] * 4)], 64, "a machine")
    said = capsys.readouterr().out
    assert "student" in said
    assert "1.030" in said
    assert "a machine" in said


def test_deployment_measures_every_form(scenes, capsys):
    torch.manual_seed(0)
    data = PoseDataModule("7scenes", str(scenes), "heads", image_size=32, short_side=36)
    system = create_model("student", backbone="resnet10t", width=16, image_size=32)
    found = measure_deployment({"runs/b/checkpoints/last.ckpt": (system, data)}, 1, 5)
    assert [each.form.split()[0] for each in found] == ["PyTorch", "float32", "float16", "int8"]
    torch_, full, half, eight = (each.size for each in found)
    assert half < 0.6 * full < 0.7 * torch_
    assert eight < 0.4 * full
    assert all(len(each.latency_s) == 5 and min(each.latency_s) > 0 for each in found)
    assert found[1].position_error_m == pytest.approx(found[0].position_error_m, rel=1e-4)
    assert speed_up(found, found[0])[0] == 1
    print_deployments(found, 1, "this machine")
    said = capsys.readouterr().out
    assert "8 test frames" in said
    assert "\nb " in said
    with pytest.raises(InputError, match="--repetitions 3"):
        measure_deployment({"a": (system, data)}, repetitions=3)
