"""The paper's figures as transcribed: well formed, and as consistent as the paper itself."""

import itertools
from decimal import Decimal
from pathlib import Path
from statistics import mean

import pytest

import mambaloc
from mambaloc.data.datasets import cambridge, seven_scenes
from mambaloc.files import read_yaml

TABLES = read_yaml(Path(mambaloc.__file__).parent / "sweep/paper.yaml", "install it again", "repair it")
SCENES = {"7scenes": seven_scenes.OFFICIAL_COUNTS, "cambridge": cambridge.OFFICIAL_COUNTS}
ROWS = [pytest.param(name, row, id=f"{name}-{row['name']}") for name, table in TABLES.items() for row in table["rows"]]
UNITS_OF_INFERENCE = ("0.167e-3", "0.191e-3", "0.197e-6")  # min per frame: contradict the other table's ms

# What the paper prints as an average that no scenes of these medians have: (table, row, metre or degree), and the mean.
NOT_THE_MEAN = {
    ("seven_scenes", "TransPoseNet (2024)", 1): ("7.78", "7.81"),
    ("cambridge", "TransPoseNet (2024)", 0): ("0.91", "0.92"),
    ("ablation", "w.o. Mamba", 1): ("7.78", "7.81"),
}


def figures(name):
    """Each printed figure of a table: row, its place (gis, scene, sparsity), what it is, and the figure."""
    for row in TABLES[name]["rows"]:
        for column, printed in zip(TABLES[name]["columns"], row["printed"], strict=True):
            said = {"what": "error", "sparsity": "1", **row, **column}
            yield row["name"], (said.get("gis"), said.get("scene"), said["sparsity"]), said["what"], printed


def parts(printed):
    return [Decimal(part) for part in str(printed).split("/")]


def half_unit(figure):
    return Decimal(1).scaleb(figure.as_tuple().exponent) / 2


def means(name):
    """Each printed average, over scenes or sparsities, and the row's figures that it is the average of."""
    for row in TABLES[name]["rows"]:
        told = [each for each in figures(name) if each[0] == row["name"]]
        for (_, place, what, average), axis in itertools.product(told, (1, 2)):
            alike = [each for each in told if (each[1][0], each[2]) == (place[0], what)]
            others = [printed for _, its_place, _, printed in alike if its_place[axis] != "all"]
            if place[axis] == "all" and others:
                yield row["name"], average, others


def test_there_are_the_papers_tables_in_its_order():
    assert {name: (len(table["columns"]), len(table["rows"])) for name, table in TABLES.items()} == {
        "seven_scenes": (9, 9),
        "cambridge": (6, 7),
        "training_time_seven_scenes": (8, 1),
        "training_time_cambridge": (5, 1),
        "gis_generalisation": (6, 3),
        "model_size": (2, 4),
        "gis_sparsity": (8, 3),
        "sparsity": (6, 3),
        "distillation": (9, 2),
        "ablation": (10, 3),
    }


@pytest.mark.parametrize("name", TABLES)
def test_tables_say_what_their_figures_are(name):
    table = TABLES[name]
    assert table.keys() == {"title", "dataset", "columns", "rows", "footnotes"}
    assert isinstance(table["title"], str)
    assert len({column["name"] for column in table["columns"]}) == len(table["columns"])
    assert len({row["name"] for row in table["rows"]}) == len(table["rows"])
    for column in table["columns"]:
        assert column.keys() <= {"name", "scene", "sparsity", "gis", "what"}
        assert column.get("what", "error") in ("error", "train_min", "inference_ms", "mib")
    for row in table["rows"]:
        assert row.keys() <= {"name", "systems", "scene", "sparsity", "gis", "distilled", "printed"}
        assert row["systems"]
        assert set(row["systems"]) <= set(mambaloc.list_models())
    for _, (gis, scene, sparsity), what, _ in figures(name):
        assert gis in ("none", "classical", "gis")
        assert sparsity in ("1", "1/2", "1/3", "1/10", "1/20", "all")
        assert scene in (*SCENES[table["dataset"]], "all") if what != "mib" else scene is None
    for footnote in table["footnotes"]:
        assert isinstance(footnote, str)
        assert len(footnote.split()) <= 30
        assert footnote.endswith(".")


@pytest.mark.parametrize(("name", "row"), ROWS)
def test_rows_have_a_figure_a_column(name, row):
    columns = TABLES[name]["columns"]
    assert len(row["printed"]) == len(columns)
    for column, printed in zip(columns, row["printed"], strict=True):
        what = column.get("what", "error")
        if what == "error":
            metres, degrees = parts(printed)
            assert 0 < metres < 4
            assert 0.4 < degrees < 15
        elif name == "ablation" and what == "inference_ms":
            assert printed in UNITS_OF_INFERENCE
        elif what == "train_min":
            assert printed is None or (isinstance(printed, int) and 0 < printed < 200)
        else:
            assert 0 < printed < 200


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("seven_scenes", 9),  # the averages that have something to be the mean of
        ("cambridge", 7),
        ("training_time_seven_scenes", 1),
        ("training_time_cambridge", 1),
        ("gis_sparsity", 6),
        ("sparsity", 3),
        ("distillation", 2),
        ("ablation", 3),
    ],
)
def test_averages_are_means_within_rounding(name, count):
    found = list(means(name))
    assert len(found) == count
    wrong = {}
    for row, average, others in found:
        for index, printed in enumerate(parts(average)):
            each = [parts(other)[index] for other in others]
            if abs(mean(each) - printed) > half_unit(printed) + mean(map(half_unit, each)):
                wrong[name, row, index] = (str(printed), f"{mean(each):.2f}")
    assert wrong == {place: said for place, said in NOT_THE_MEAN.items() if place[0] == name}
    for printed, right in wrong.values():
        assert any(printed in footnote and right in footnote for footnote in TABLES[name]["footnotes"])


def row_of(name, row):
    return next(each for each in TABLES[name]["rows"] if each["name"] == row)["printed"]


def cells(name, row):
    """A row's figures by column, their digits apart (12.7 is 12.70)."""
    names = (column["name"] for column in TABLES[name]["columns"])
    return {at: None if cell is None else parts(cell) for at, cell in zip(names, row_of(name, row), strict=True)}


def test_what_two_tables_print_is_the_same():
    main, sparse = cells("seven_scenes", "MambaLoc (ours)"), cells("sparsity", "MambaLoc")
    before, ours = cells("distillation", "Before Distillation"), cells("ablation", "w. GIS (ours)")
    assert {at: ours[at] for at in main} == main
    assert {at: before[at] for at in main if at in before} == {at: main[at] for at in main if at != "Training (min)"}
    assert before["Model Size (Mb)"] == cells("model_size", "TransPoseNet")["Benchmark w. GIS Model Size (Mb)"]
    host, without = cells("seven_scenes", "TransPoseNet (2024)"), cells("ablation", "w.o. Mamba")
    assert {at: without[at] for at in host} == host
    times = cells("training_time_seven_scenes", "MambaLoc")
    assert times["Average"] == main["Training (min)"]
    assert (
        cells("training_time_cambridge", "MambaLoc")["Average"]
        == cells("cambridge", "MambaLoc (ours)")["Training (min)"]
    )
    assert sparse["1"] == main["Average"]


@pytest.mark.parametrize(
    ("row", "published"),
    [("PoseNet", "PoseNet (2015)"), ("LSTM PN", "LSTM PN (2017)"), ("TransPoseNet", "TransPoseNet (2024)")],
)
def test_hosts_of_gis_have_the_main_tables_figures(row, published):
    main, general, by_sparsity = (
        cells("seven_scenes", published),
        cells("gis_generalisation", row),
        cells("gis_sparsity", row),
    )
    assert general["Pose Error, Benchmark"] == by_sparsity["100% Train Set, Benchmark"] == main["Average"]
    assert general["Training (min), Benchmark"] == main["Training (min)"]
    assert general["Pose Error, Benchmark w. GIS"] == by_sparsity["100% Train Set, Benchmark w. GIS"]


@pytest.mark.parametrize(
    ("row", "gis", "other"),
    [
        ("PoseNet", "Benchmark", "PoseNet"),
        ("TransPoseNet", "Benchmark", "TransPoseNet"),
        ("TransPoseNet", "Benchmark w. GIS", "MambaLoc"),
    ],
)
def test_both_tables_of_sparsities_agree(row, gis, other):
    with_hosts, alone = cells("gis_sparsity", row), cells("sparsity", other)
    percents = {"100%": "1", "10%": "1/10", "5%": "1/20"}
    assert [with_hosts[f"{percent} Train Set, {gis}"] for percent in percents] == [
        alone[part] for part in percents.values()
    ]


def test_transposenet_with_gis_is_mambaloc():
    main, general = cells("seven_scenes", "MambaLoc (ours)"), cells("gis_generalisation", "TransPoseNet")
    assert general["Pose Error, Benchmark w. GIS"] == main["Average"]
    assert general["Training (min), Benchmark w. GIS"] == main["Training (min)"]
