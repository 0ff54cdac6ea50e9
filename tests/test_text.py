"""Texts against Python's own codecs, and names against the numbers in them."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mambaloc.text import decode_text, natural, open_text

LINES = st.lists(st.text("abcz019.-_ äßéЖ語", max_size=30), min_size=1, max_size=20)
MARKED = ("utf-8-sig", "utf-16", "utf-32")


@given(LINES, st.sampled_from(["utf-8", *MARKED]), st.sampled_from(["\n", "\r\n", "\r"]))
def test_any_text_is_read_as_it_was_written(lines, encoding, ending):
    assert decode_text(ending.join(lines).encode(encoding)) == "\n".join(lines)


@given(LINES, st.sampled_from(["le", "be"]))
def test_either_order_of_utf_16_is_read_by_its_mark(lines, order):
    text = "\n".join(lines)
    assert decode_text(("\ufeff" + text).encode(f"utf-16-{order}")) == text


@given(st.lists(st.floats(allow_nan=False), min_size=4, max_size=40), st.sampled_from(["utf-16-le", "utf-16-be"]))
def test_numbers_in_utf_16_need_no_mark(numbers, encoding):
    text = " ".join(map(repr, numbers))
    assert decode_text(text.encode(encoding)) == text


def test_what_is_not_unicode_is_of_windows():
    assert decode_text("Küche 1 • Straße".encode("cp1252")) == "Küche 1 • Straße"
    assert decode_text(b"\x81") == "\ufffd"  # which Windows-1252 has not


@pytest.mark.parametrize("encoding", ["utf-8", *MARKED])
def test_a_file_can_be_read_line_by_line(encoding, tmp_path):
    text = "ä" * 5000 + "\nb\n"  # the first bytes end within a character
    (tmp_path / "a.txt").write_bytes(text.encode(encoding))
    with open_text(tmp_path / "a.txt") as file:
        assert file.read() == text


@given(st.sets(st.integers(0, 10**20), min_size=2, max_size=30), st.sampled_from(["", "frame", "a 3 b-"]), st.randoms())
def test_numbers_sort_by_value_however_they_are_written(numbers, prefix, random):
    names = {f"{prefix}{number:0{random.randint(1, 25)}d}.jpg": number for number in numbers}
    shuffled = random.sample(sorted(names), len(names))
    assert [names[name] for name in sorted(shuffled, key=lambda name: natural(Path(name)))] == sorted(numbers)


@given(st.sets(st.decimals(10**6, 10**10, places=6), min_size=2, max_size=20))
def test_time_stamps_sort_by_value(stamps):
    names = {f"rgb/{stamp.normalize():f}": stamp for stamp in stamps}
    named = {name if "." in name.partition("/")[2] else f"{name}.0": stamp for name, stamp in names.items()}
    found = sorted((Path(f"{name}.png") for name in named), key=natural)
    assert [named[path.with_suffix("").as_posix()] for path in found] == sorted(stamps)


def test_a_name_has_one_place():
    """Names that are the same number are sorted, too, in whatever order a folder lists them."""
    assert len({natural(Path(name)) for name in ("1.jpg", "01.jpg", "001.jpg")}) == 3
