"""Reports of a small fixed store, cell by cell."""

import csv
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from mambaloc.errors import InputError
from mambaloc.matrix import Cell, Store, write_report
from mambaloc.matrix.summary import differences, rows_of

FRAMES = 60


def result(errors_m, retrieval_m=None):
    references = {} if retrieval_m is None else {"retrieval": {"position_error_m": retrieval_m}}
    return {
        "count": FRAMES,
        "data": {"dataset": "7scenes", "scene": "room", "official_split": False},
        "references": references,
        "selection": "last",
        "training": {"wall_clock": {"train_s": 10.0 * errors_m[0]}, "data": {"train_frames": 40}},
        "frames": {
            "image": [f"seq-0{1 + i // 30}/frame-{i:06d}.color.png" for i in range(FRAMES)],
            "position_error_m": list(errors_m),
            "rotation_error_deg": [10 * e for e in errors_m],
        },
    }


@pytest.fixture
def store(tmp_path):
    rng = np.random.default_rng(0)
    hard = rng.gamma(4, 0.1, FRAMES)
    told = {
        ("a", "none", "0"): result(hard + 0.2, retrieval_m=0.5),
        ("a", "none", "1"): result(hard + 0.3, retrieval_m=0.5),
        ("a", "gis", "0"): result(hard, retrieval_m=0.5),
        ("a", "gis", "1"): result(hard + 0.1, retrieval_m=0.5),
        ("b|<i>", "none", "0"): result(hard),
        ("b|<i>", "gis", "0"): result(hard[::-1]),
        ("b|<i>", "gis", "1"): None,
    }
    with Store(tmp_path / "results") as store:
        for number, (place, found) in enumerate(told.items()):
            labels = dict(zip(("system", "gis", "seed"), place, strict=True))
            cell = Cell(labels, ("r.yaml",), str(number))
            store.write(cell, {"last": found} if found else {}, 1.0, None if found else "ValueError: <script>")
    return tmp_path / "results", hard


def test_rows_are_means_over_seeds_of_medians(store):
    folder, hard = store
    rows = {tuple(row.labels.values()): row for row in rows_of(Store.ended(folder).values())}
    assert set(rows) == {("a", "none"), ("a", "gis"), ("b|<i>", "none"), ("b|<i>", "gis")}
    row, median = rows["a", "none"], np.median(hard)
    assert row.seeds == ("0", "1")
    assert row.errors["position_error_m"].mean == pytest.approx(median + 0.25)
    assert row.errors["rotation_error_deg"].mean == pytest.approx(10 * (median + 0.25))
    assert row.errors["position_error_m"].low < median + 0.25 < row.errors["position_error_m"].high
    assert row.train_s == pytest.approx(10 * (hard[0] + 0.25))
    assert (row.train_frames, row.test_frames) == (40, FRAMES)
    assert row.beats_retrieval is bool(median + 0.25 < 0.5)
    assert rows["b|<i>", "none"].beats_retrieval is None
    assert rows["b|<i>", "gis"].seeds == ("0",)  # the other one failed
    assert not rows_of(Store.ended(folder).values(), "best")


def test_differences_are_paired_by_seed_and_frame(store):
    folder, _ = store
    found = {
        each.labels["system"]: each.errors for each in differences(Store.ended(folder).values(), "gis", "none", "gis")
    }
    same = found["a"]["position_error_m"]  # each frame 0.2 m better, for each seed: no doubt at all
    assert (same.mean, same.low, same.high) == pytest.approx((-0.2, -0.2, -0.2))
    assert same.is_sure
    other = found["b|<i>"]["position_error_m"]  # the same errors on other frames: no difference, and no certainty
    assert other.mean == pytest.approx(0)
    assert not other.is_sure
    with pytest.raises(InputError, match="no cell that ended has classical there"):
        differences(Store.ended(folder).values(), "gis", "none", "classical")


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
    with (tmp_path / "report/rows.csv").open(newline="") as file:
        table = list(csv.reader(file))
    assert table[0][:4] == ["system", "gis", "seeds", "median position (m)"]
    places = [" ".join(line[:3]) for line in table[1:]]
    assert places == ["a none 0 1", "a gis 0 1", "b|<i> none 0", "b|<i> gis 0"]
    assert float(table[1][3]) == pytest.approx(np.median(hard) + 0.25)
    assert table[1][-2:] == ["7scenes/room, no official split", "last"]

    page = (tmp_path / "report/report.html").read_text()
    shown, compared = Tables(page).tables
    assert shown[0] == table[0]
    assert shown[3][:3] == ["b|<i>", "none", "0"]
    assert shown[1][3] == f"{np.median(hard) + 0.25:.3f}"
    assert compared[1] == ["a", "-0.200 (-0.200 to -0.200)", "-2.000 (-2.000 to -2.000)"]
    assert compared[2][1].endswith(", may be none)")
    assert "b|&lt;i&gt; gis 1: ValueError: &lt;script&gt;" in page
    assert not re.search(r'(src|href)="?https?:', page)  # nothing is fetched

    text = (tmp_path / "report/report.md").read_text()
    assert "| b\\|<i> | none | 0 |" in text
    assert "- b|<i> gis 1: ValueError: <script>" in text
    assert "not other scenes" in text


def test_what_cannot_be_reported(store, tmp_path):
    folder, _ = store
    with pytest.raises(InputError, match="holds no result of the last epoch"):
        write_report(tmp_path / "nothing", tmp_path / "report")
    with pytest.raises(InputError, match="holds no result of the best epoch"):
        write_report(folder, tmp_path / "report", epoch="best")
    with pytest.raises(InputError, match="is there already"):
        write_report(folder, folder)
    assert not (tmp_path / "nothing").exists()
