"""Reports of a small fixed store, trial by trial."""

import csv
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from mambaloc.errors import InputError
from mambaloc.sweep import Store, Trial, report
from mambaloc.sweep.paper import paper_tables
from mambaloc.sweep.report import write_report
from mambaloc.sweep.summary import differences, rows_of

FRAMES = 60
SYSTEMS = {"a": "posenet", "b|<i>": "lstm_posenet"}


def result(system, gis, errors_m, retrieval_m=None, scene="redkitchen", official=False, keep_every=1, curve_m=()):
    references = (
        {} if retrieval_m is None else {"retrieval": {"position_error_m": retrieval_m, "rotation_error_deg": 9.0}}
    )
    data = {
        **{"dataset": "7scenes", "scene": scene, "official_split": official, "rendered": False},
        **{"image_size": [96, 128], "listed_frames": {"train": 800, "test": FRAMES}},
    }
    history = [{"step": 40 * (i + 1), "train_s": 4.0 * (i + 1), "position_error_m": m} for i, m in enumerate(curve_m)]
    medians = {"position_error_m": np.median(errors_m), "rotation_error_deg": 10 * np.median(errors_m)}
    return {
        "count": FRAMES,
        "data": data,
        "metrics": medians,
        "references": references,
        "selection": "last",
        "model": {"name": system, "hyperparameters": {"gis": gis, "backbone": "resnet10t"}},
        "training": {
            **{"wall_clock": {"train_s": 30.0 if gis == "none" else 60.0, "history": history}, "step": 120},
            **{"commit": "0123456789", "device": "a machine"},
            "data": {**data, "train_frames": 40, "keep_every": keep_every, "keep_count": None},
        },
        "frames": {
            "image": [f"seq-0{1 + i // 30}/frame-{i:06d}.color.png" for i in range(FRAMES)],
            "position_error_m": list(errors_m),
            "rotation_error_deg": [10 * e for e in errors_m],
        },
    }


def with_map(found, both_m, map_m=0.004, accepted=0.9):
    """The same result with a map beside the network."""
    both = np.array(both_m)
    shares = {"accepted": accepted, "accepted_and_wrong": 0.01, "query_cpu_ms": 16.4}
    of_both = {"metrics": {"position_error_worst_m": float(both.max()), **shares}}
    of_both["frames"] = {
        **found["frames"],
        "position_error_m": both.tolist(),
        "rotation_error_deg": (5 * both).tolist(),
    }
    of_map = {"metrics": {"position_error_m": map_m, "rotation_error_deg": 0.1}, "mib": 0.25, "key_frames": 80}
    return {**found, "map": {**of_map, "width": 240}, "network_and_map": of_both}


def stored(folder, told):
    """Keep results by their labels; None is a trial that failed."""
    with Store(folder) as store:
        for number, (place, found) in enumerate(told.items()):
            labels = dict(zip(("system", "gis", "seed"), place, strict=True))
            trial = Trial(labels, ("r.yaml",), str(number))
            store.write(trial, {"last": found} if found else {}, 1.0, None if found else "ValueError: <script>")
    return folder


@pytest.fixture
def store(tmp_path):
    hard = np.random.default_rng(0).gamma(4, 0.1, FRAMES)
    errors = {
        ("a", "none", "0"): hard + 0.2,
        ("a", "none", "1"): hard + 0.3,
        ("a", "gis", "1"): hard + 0.1,  # trials that run side by side end in any order
        ("a", "gis", "0"): hard,
        ("b|<i>", "none", "0"): hard,
        ("b|<i>", "gis", "0"): hard[::-1],
        ("b|<i>", "gis", "1"): None,
    }
    curves = {("a", "none"): (0.9, 0.8, 0.6), ("a", "gis"): (0.7, 0.45, 0.4)}
    told = {
        place: None
        if each is None
        else result(
            SYSTEMS[place[0]], place[1], each, 0.5 if place[0] == "a" else None, curve_m=curves.get(place[:2], ())
        )
        for place, each in errors.items()
    }
    return stored(tmp_path / "results", told), hard


def test_rows_are_means_over_seeds_of_medians(store):
    folder, hard = store
    rows = {tuple(row.labels.values()): row for row in rows_of(Store.ended(folder).values())}
    assert list(rows) == [("a", "none"), ("a", "gis"), ("b|<i>", "none"), ("b|<i>", "gis")]
    row, median = rows["a", "none"], np.median(hard)
    assert row.seeds == ("0", "1")
    assert row.errors["position_error_m"].mean == pytest.approx(median + 0.25)
    assert row.errors["rotation_error_deg"].mean == pytest.approx(10 * (median + 0.25))
    assert row.errors["position_error_m"].low < median + 0.25 < row.errors["position_error_m"].high
    assert (row.train_s, row.steps) == ((30.0, 30.0), (120, 120))
    assert (row.train_frames, row.test_frames) == (40, FRAMES)
    assert row.beats_retrieval is bool(median + 0.25 < 0.5)
    assert rows["b|<i>", "none"].beats_retrieval is None
    assert rows["b|<i>", "gis"].seeds == ("0",)  # the other one failed
    assert rows["a", "gis"].reached_s(0.5) == (8.0, 8.0)
    assert rows["a", "none"].reached_s(0.5) == (None, None)
    assert not rows_of(Store.ended(folder).values(), "best")


def test_differences_are_paired_by_seed_and_frame(store):
    folder, _ = store
    found = {
        each.labels["system"]: each.errors for each in differences(Store.ended(folder).values(), "gis", "none", "gis")
    }
    same = found["a"]["position_error_m"]  # each frame 0.2 m better, for each seed: no doubt at all
    assert (same.mean, same.low, same.high) == pytest.approx((-0.2, -0.2, -0.2))
    assert same.is_sure
    pair = next(each for each in differences(Store.ended(folder).values(), "gis", "none", "gis"))
    assert pair.step_ratio == (2.0, 2.0)
    assert pair.reach_ratio == (40 * 2 / 120, 40 * 2 / 120)  # to 0.6 m, the last error without: at step 80 against 120
    assert found["all"]["position_error_m"].mean == pytest.approx(2 * -0.2 / 3)  # b's medians are the same
    other = found["b|<i>"]["position_error_m"]  # the same errors on other frames: no difference, and no certainty
    assert other.mean == pytest.approx(0)
    assert not other.is_sure
    with pytest.raises(InputError, match="no trial that ended has classical there"):
        differences(Store.ended(folder).values(), "gis", "none", "classical")


def test_differences_over_scenes_resample_each_by_itself(tmp_path):
    hard = np.random.default_rng(0).gamma(4, 0.1, FRAMES)
    told = {}
    for scene, count, gain_m in (("heads", FRAMES, 0.2), ("stairs", 25, 0.1)):
        for gis, errors in (("none", hard[:count] + gain_m), ("gis", hard[:count])):
            told[scene, gis, "0"] = result("posenet", gis, errors, scene=scene)
            told[scene, gis, "0"]["frames"]["image"] = told[scene, gis, "0"]["frames"]["image"][:count]
    found = differences(Store.ended(stored(tmp_path / "results", told)).values(), "gis", "none", "gis")
    assert [each.labels["system"] for each in found] == ["heads", "stairs", "all"]
    overall = found[-1].errors["position_error_m"]
    assert (overall.mean, overall.low, overall.high) == pytest.approx((-0.15, -0.15, -0.15))


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        (None, r"redkitchen: a result has no errors of single frames"),
        ([], r"redkitchen: a result has no errors of single frames"),
        (
            [f"seq-09/frame-{i:06d}.png" for i in range(FRAMES)],
            r"--compare gis: none and gis were measured on different",
        ),
    ],
)
def test_results_of_other_frames_or_none_are_not_compared(tmp_path, frames, message):
    told = {("a", gis, "0"): result("posenet", gis, [0.5] * FRAMES) for gis in ("none", "gis")}
    if frames is None:
        del told["a", "gis", "0"]["frames"]
    else:
        told["a", "gis", "0"]["frames"]["image"] = frames
    folder = stored(tmp_path / "results", told)
    with pytest.raises(InputError, match=message):
        write_report(folder, tmp_path / "report", [("gis", "none", "gis")])
    assert not (tmp_path / "report").exists()


class Tables(HTMLParser):
    """Text of every table's cells."""

    def __init__(self, text):
        super().__init__()
        self.tables, self.inside = [], False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.inside = True
            self.tables[-1][-1].append("")

    def handle_endtag(self, tag):
        self.inside = self.inside and tag not in ("td", "th")

    def handle_data(self, data):
        if self.inside:
            self.tables[-1][-1][-1] += data


def test_the_files_say_the_same(store, tmp_path):
    folder, hard = store
    rows, failed = write_report(folder, tmp_path / "report", [("gis", "none", "gis")])
    assert (len(rows), len(failed)) == (4, 1)
    with (tmp_path / "report/tables/results.csv").open(newline="") as file:
        table = list(csv.reader(file))
    assert table[0][:4] == ["system", "gis", "seeds", "median position (m)"]
    places = [" ".join(line[:3]) for line in table[1:]]
    assert places == ["a none 0 1", "a gis 0 1", "b|<i> none 0", "b|<i> gis 0"]
    assert float(table[1][3]) == pytest.approx(np.median(hard) + 0.25, abs=5e-4)
    data = f"7scenes/redkitchen, no official split (800 training and {FRAMES} test frames)"
    assert [line[-2:] for line in table[1:]] == [[data, "last"]] * 4
    assert [line[-3] for line in table[1:]] == ["no" if np.median(hard) + 0.25 > 0.5 else "yes", "yes"] + 2 * [
        "not measured"
    ]

    page = (tmp_path / "report/report.html").read_text()
    shown, compared, times, references, *_, failures = Tables(page).tables
    assert shown == table
    assert compared[1][:2] == ["a", "-0.200 (-0.200 to -0.200)"]
    assert compared[1][-2:] == ["2.00 (2.00 to 2.00)", "0.67 (0.67 to 0.67)"]
    assert compared[2][1].endswith(", may be 0)")
    assert [line[0] for line in compared[1:]] == ["a", "b|<i>", "all"]
    assert times[1:3] == [
        ["a", "none", "30.0 ± 0.0", "120", "250 ± 0", "never"],
        ["a", "gis", "60.0 ± 0.0", "120", "500 ± 0", "8.0 ± 0.0"],
    ]
    assert references[1:] == [[data, "40", "retrieval", "0.500", "9.000"]]
    assert failures[1:] == [["b|<i>", "gis", "1", "ValueError: <script>"]]
    assert not re.search(r'(src|href)="?https?:', page)  # nothing is fetched
    assert page.count("<svg") == len(list((tmp_path / "report/plots").iterdir())) == 2  # no curve of b's was kept

    text = (tmp_path / "report/report.md").read_text()
    assert "| b\\|<i> | none | 0 |" in text
    assert "| b\\|<i> | gis | 1 | ValueError: <script> |" in text
    assert "not other scenes" in text
    assert {path.stem for path in tmp_path.glob("report/tables/*.tex")} == {
        path.stem for path in tmp_path.glob("report/tables/*.csv")
    }
    assert r"b|<i> & none & 0 & " in (tmp_path / "report/tables/results.tex").read_text()


def test_a_map_beside_the_networks_is_reported_once_and_both_with_every_seed(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "plots_of", lambda *_: [])
    monkeypatch.setattr(report, "paper_tables", lambda *_: [])
    hard = np.random.default_rng(0).gamma(4, 0.1, FRAMES)
    told = {
        ("a", "none", "0"): with_map(result("posenet", "none", hard), hard / 10, accepted=0.9),
        ("a", "none", "1"): with_map(result("posenet", "none", hard + 0.1), hard / 10 + 0.02, accepted=0.8),
        ("b", "none", "0"): with_map(result("posenet", "none", hard), hard),
        ("b", "none", "1"): result("posenet", "none", hard),  # without a map: no row of both
    }
    write_report(stored(tmp_path / "results", told), tmp_path / "report")
    tables = {}
    for name in ("network_and_map", "references", "results"):
        with (tmp_path / f"report/tables/{name}.csv").open(newline="") as file:
            tables[name] = list(csv.reader(file))
    header, line = tables["network_and_map"]
    row = dict(zip(header, line, strict=True))
    median = np.median(hard)
    assert (row["system"], row["seeds"]) == ("a", "0 1")
    assert float(row["network alone, median position (m)"]) == pytest.approx(median + 0.05, abs=6e-4)
    assert float(row["network and map, median position (m)"]) == pytest.approx(median / 10 + 0.01, abs=6e-4)
    assert float(row["network and map, median rotation (°)"]) == pytest.approx(median / 2 + 0.05, abs=6e-4)
    assert float(row["from"]) < float(row["network and map, median rotation (°)"]) < float(row["to"])
    assert float(row["worst (m)"]) == pytest.approx(hard.max() / 10 + 0.02, abs=6e-3)
    assert (row["answered by the map"], row["of these wrong"]) == ("85.0%", "1.0%")
    assert (row["CPU ms an image"], row["map (MiB)"]) == ("16", "0.25")
    answers = [line[2:] for line in tables["references"][1:]]
    assert answers == [["map of 80 key frames, 240 px", "0.004", "0.100"]]  # once, whatever the network
    assert [line[0] for line in tables["results"][1:]] == ["a", "b"]


def test_a_map_that_found_no_pose_is_reported_as_infinite(tmp_path):
    hard = np.random.default_rng(0).gamma(4, 0.1, FRAMES)
    told = {("a", "none", "0"): with_map(result("posenet", "none", hard), hard, map_m=None)}
    (row,) = rows_of(Store.ended(stored(tmp_path / "results", told)).values())
    assert row.references["map of 80 key frames, 240 px"] == {"position_error_m": np.inf, "rotation_error_deg": 0.1}
    assert row.both["position_error_m"].mean == pytest.approx(row.errors["position_error_m"].mean)


def test_training_time_to_an_error_that_is_asked_for(store, tmp_path, monkeypatch):
    monkeypatch.setattr(report, "plots_of", lambda *_: [])  # drawn by the test above
    monkeypatch.setattr(report, "paper_tables", lambda *_: [])
    write_report(store[0], tmp_path / "report", reach_m=0.85)
    with (tmp_path / "report/tables/training_time.csv").open(newline="") as file:
        header, *lines = csv.reader(file)
    assert header[-1] == "seconds to 0.85 m"
    assert [line[-1] for line in lines] == ["8.0 ± 0.0", "4.0 ± 0.0", "", ""]


def test_what_cannot_be_reported(store, tmp_path):
    folder, _ = store
    with pytest.raises(InputError, match="contains no result of the last epoch"):
        write_report(tmp_path / "nothing", tmp_path / "report")
    with pytest.raises(InputError, match="contains no result of the best epoch"):
        write_report(folder, tmp_path / "report", epoch="best")
    with pytest.raises(InputError, match="already exists"):
        write_report(folder, folder)
    assert not (tmp_path / "nothing").exists()


SCENES = ("heads", "fire", "redkitchen", "chess", "office", "pumpkin", "stairs")


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """What the paper's tables say of two seeds of all seven scenes, and one of blocks of a sequence."""

    def errors(median_m):
        return np.full(FRAMES, median_m)

    told = {
        ("posenet", scene, seed): result(
            "posenet", "none", errors(0.1 * (i + 1) + 0.02 * int(seed)), scene=scene, official=True
        )
        for i, scene in enumerate(SCENES)
        for seed in "01"
    }
    del told["posenet", "stairs", "1"]
    told["posenet", "stairs", "0"] = result("posenet", "none", errors(0.7), scene="stairs", official=True)
    told |= {
        ("mambaloc", f"blocks 1/{k}", "0"): result("transposenet", "gis", errors(0.3 * k), keep_every=k)
        for k in (1, 10, 20)
    }
    trials = Store.ended(stored(tmp_path_factory.mktemp("paper") / "results", told)).values()
    return {table.name: table for table in paper_tables(trials)}


def test_papers_tables_hold_ours_beside_its_figures(tables):
    header, *lines = tables["seven_scenes"].lines
    by_name = {line[0]: dict(zip(header, line, strict=True)) for line in lines}
    assert by_name["PoseNet (2015), paper"]["Average"] == "0.44/10.4"
    ours = by_name["PoseNet (2015), ours [a]"]
    assert (ours["Heads"], ours["Fire"]) == ("0.11±0.01/1.10±0.14", "0.21±0.01/2.10±0.14")
    assert ours["Stairs"] == "0.70/7.00"  # one seed has no spread
    assert ours["Average"] == "0.40/4.00"  # of the one seed that has all scenes
    blocks = by_name["MambaLoc (ours), ours [b]"]
    assert (blocks["Kitchen"], blocks["Heads"]) == ("0.30/3.00", "")
    assert (blocks["Average"], blocks["Training (min)"]) == ("0.30/3.00", "1.00")
    notes = tables["seven_scenes"].footnotes
    assert notes[0].startswith("[a] official split. Scenes: chess, fire, heads")
    assert notes[1].startswith(
        f"[b] redkitchen with a split of its own, 800 training and {FRAMES} test frames: not the"
    )
    assert "TransPoseNet (2024), ours [a]" not in by_name  # never filled from the paper, nor from another system
    assert not tables["cambridge"].measured


def test_papers_sparsity_takes_what_was_run_and_no_more(tables):
    header, *lines = tables["sparsity"].lines
    ours = next(line for line in lines if line[0].startswith("MambaLoc, ours"))
    assert dict(zip(header, ours, strict=True)) == {
        **{"Method": "MambaLoc, ours [b]", "1": "0.30/3.00", "1/2": "", "1/3": "", "1/10": "3.00/30.00"},
        **{"1/20": "6.00/60.00", "Average": ""},
    }


def test_papers_sizes_are_counted_not_copied(tables):
    _, *lines = tables["model_size"].lines
    ours = {line[0]: line[1:] for line in lines if ", ours" in line[0]}
    assert ours["PoseNet, ours"] == ["85.26", "186.12"]
    assert ours["LSTM PN, ours"] == ["90.01", "115.44"]  # not the paper's 89.6
    assert ours["TransPoseNet, ours"] == ["40.57", "42.24"]
