"""Slow tests run while a folder that they name has changed since they passed."""

from __future__ import annotations

import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from . import slow


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
    for name in ("code.py", "other.py", "test_code.py"):
        (tmp_path / name).write_text("1\n")
    (tmp_path / ".gitignore").write_text("*.log\n")
    monkeypatch.setattr(slow, "ROOT", tmp_path)
    monkeypatch.setattr(slow, "NOTES", tmp_path / "slow.json")
    return tmp_path


def collected(project: Path, due: bool = False) -> list[str]:
    """Names of the tests that a run keeps; with `due`, it passes."""
    option = SimpleNamespace(markexpr="not gpu", due=due, collectonly=False)
    hook = SimpleNamespace(pytest_deselected=lambda items: None)
    config: Any = SimpleNamespace(option=option, hook=hook, stash=pytest.Stash())
    marks = {"fast": [], "slow": [pytest.mark.slow("code.py").mark]}
    items: Any = [
        SimpleNamespace(
            name=name,
            nodeid=name,
            path=project / "test_code.py",
            iter_markers=lambda _, marks=own: marks,
            get_closest_marker=lambda _, marks=own: marks[0] if marks else None,
        )
        for name, own in marks.items()
    ]
    slow.pytest_collection_modifyitems(config, items)
    session: Any = SimpleNamespace(config=config)
    slow.pytest_sessionfinish(session, 0)
    return [item.name for item in items]


def test_slow_tests_run_until_they_have_passed(project: Path) -> None:
    assert collected(project) == collected(project) == ["fast", "slow"]
    assert collected(project, due=True) == ["slow"]
    assert collected(project) == ["fast"]
    (project / "other.py").write_text("2\n")
    (project / "code.log").write_text("ignored\n")
    assert collected(project) == ["fast"]
    (project / "code.py").write_text("2\n")
    assert collected(project) == ["fast", "slow"]
    assert collected(project, due=True) == ["slow"]
    assert collected(project, due=True) == []
    (project / "test_code.py").write_text("2\n")
    assert collected(project) == ["fast", "slow"]
