"""What the benchmarks share: one folder of surfaces a session."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder where rendered surfaces are kept."""
    return tmp_path_factory.mktemp("cache")
