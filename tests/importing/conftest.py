"""The recording that all formats are written from, and what being refused means."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings
from recorded import Recording, record

from mambaloc.errors import InputError
from mambaloc.importing.capture import Capture

settings.register_profile("thorough", max_examples=2_000)


@pytest.fixture(scope="session")
def recording() -> Recording:
    return record()


@pytest.fixture
def refused() -> Callable[..., str]:
    """Check that reading ends in one line that says all of some words; return it."""

    def refused(read: Callable[[Path], Capture], source: Path, *says: str) -> str:
        with pytest.raises(InputError) as caught:
            read(source)
        message = str(caught.value)
        assert "\n" not in message
        for words in says:
            assert words in message, message
        return message

    return refused
