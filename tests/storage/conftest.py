"""A store that several files of tests change."""

from pathlib import Path

import pytest

from .stores import add, opened


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A store of two stages."""
    add(opened(tmp_path / "store"), "kitchen")
    add(opened(tmp_path / "store"), "hall")
    return tmp_path / "store"
