"""Two processes make the same thing: one stops before a step until the other has ended, or gets no further."""

from functools import partial
from pathlib import Path

import pytest
from attacked import SERVER, Attacked, assert_one_line, audited, leave_alone, outcome_of, spread
from subjects import SUBJECTS

pytestmark = pytest.mark.slow

PATIENCE_S = 5  # with another that waits for a lock


def wait_before(step: int, arrived, other_ended, below: Path) -> None:
    def wait(at: int) -> None:
        if at == step:
            arrived.set()
            other_ended.wait(PATIENCE_S)

    audited(below, wait)


@pytest.mark.parametrize("name", SUBJECTS)
def test_two_at_once(name, inputs, undisturbed, tmp_path, tries, tally):
    subject = SUBJECTS[name]
    for step in spread(undisturbed(name).steps, tries):
        out, arrived, other_ended = tmp_path / f"step {step}", SERVER.Event(), SERVER.Event()
        first = Attacked(subject, inputs, out, partial(wait_before, step, arrived, other_ended))
        assert arrived.wait(300)
        outcomes = [outcome_of(subject, inputs, out, leave_alone)]
        other_ended.set()
        outcomes.append(first.outcome())
        refused = [stderr for code, stderr, _ in outcomes if code != 0]
        assert [code for code, _, _ in outcomes if code != 0] in ([], [2])
        for stderr in refused:
            assert_one_line(stderr)
        assert subject.check(out)
        tally(f"{name}: two at once", "one finishes, one line for the other" if refused else "both finish")
