"""What all tests share: the real micrographs where they are at hand, and claims that do not depend on the clock."""

from __future__ import annotations

import os
from pathlib import Path

import hypothesis
import pytest

hypothesis.settings.register_profile("here", deadline=None)
hypothesis.settings.register_profile("ci", deadline=None, derandomize=True)
hypothesis.settings.load_profile("ci" if os.environ.get("CI") else "here")


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Return the folder of real micrographs that SEM_REAL_DATA names; skip, and say so, where there is none."""
    named = os.environ.get("SEM_REAL_DATA", "")
    if not named:
        pytest.skip("SEM_REAL_DATA names no folder of real micrographs")
    folder = Path(named)
    assert folder.is_dir(), f"SEM_REAL_DATA={named} is not a folder"
    return folder
