"""What imports cost: captures of the benchmark are read as they were drawn, and costs are those of processes."""

from __future__ import annotations

import import_cost
import numpy as np
import pytest
from import_cost import write_nerfstudio, write_seven_scenes

from mambaloc.errors import InputError
from mambaloc.importing.registry import read_capture


@pytest.mark.parametrize(("write", "kind"), [(write_nerfstudio, "nerfstudio"), (write_seven_scenes, "7scenes")])
def test_both_layouts_hold_the_same_walk(tmp_path, write, kind):
    write(tmp_path / "capture", 24)
    write_nerfstudio(tmp_path / "other", 24)
    capture, other = (read_capture(tmp_path / name) for name in ("capture", "other"))
    assert (capture.kind, len(capture.images)) == (kind, 24)
    np.testing.assert_allclose(capture.world_from_cam, other.world_from_cam, atol=1e-5)


def test_costs_are_medians_and_shares(tmp_path, capsys):
    costs = {
        tmp_path / "a": [(1.0, 2.0, 100.0), (3.0, 4.0, 100.0), (9.0, 9.0, 90.0)],
        tmp_path / "b": [(6.0, 8.0, 50.0)],
    }
    import_cost.print_costs("nerfstudio", costs)
    first, second = capsys.readouterr().out.splitlines()
    assert "3.0 s computed (1.0, 3.0, 9.0), 4.0 s passed, 100 MiB; this one's share 1.00, 1.00, 1.00" in first
    assert "6.0 s computed (6.0), 8.0 s passed, 50 MiB; this one's share 0.50, 0.50, 2.00" in second


def test_an_import_that_fails_is_named(tmp_path):
    (tmp_path / "tools").mkdir()
    (tmp_path / "tools/import_scene.py").write_text("raise SystemExit(3)")
    with pytest.raises(InputError, match=r"its import of capture ended with code 3"):
        import_cost.measure([tmp_path], tmp_path / "capture", turns=1)
