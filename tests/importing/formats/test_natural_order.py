from pathlib import Path

from mambaloc.text import natural


def test_numbers_in_names_sort_by_their_value_however_long():
    long = "9" * 5000  # Python makes no int of it
    names = ["a/2.jpg", "a/010.jpg", "a/11.jpg", "a/100.jpg", f"a/{long}.jpg", f"a/1{long}.jpg", "b/1.jpg"]
    shuffled = [names[row] for row in (3, 6, 0, 5, 1, 4, 2)]
    assert sorted(shuffled, key=lambda name: natural(Path(name))) == names
