"""Attacks are counted: ``pytest tests/attacks --tries 100`` prints what was tried, how often, and what happened."""

from collections import Counter

import pytest

TALLY = pytest.StashKey[dict]()


def pytest_addoption(parser):
    parser.addoption("--tries", type=int, help="how often each attack is tried, and a table of them")


@pytest.fixture(scope="session")
def tries(request):
    """How often each attack is tried; once unless asked for."""
    return request.config.getoption("--tries", None) or 1


@pytest.fixture
def tally(request):
    """Count what happened: ``tally(attack, outcome)``."""
    table = request.config.stash.setdefault(TALLY, {})
    return lambda attack, outcome, count=1: table.setdefault(attack, Counter()).update({outcome: count})


def pytest_terminal_summary(terminalreporter, config):
    if not config.getoption("--tries", None):
        return
    terminalreporter.section("attacks")
    for attack, outcomes in config.stash.get(TALLY, {}).items():
        told = ", ".join(f"{outcome}: {count}" for outcome, count in sorted(outcomes.items()))
        terminalreporter.line(f"| {attack} | {sum(outcomes.values())} | {told} |")
