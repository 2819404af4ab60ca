"""Slow tests run whenever the files of their kind changed."""

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SPEC = importlib.util.spec_from_file_location("slow", ROOT / ".ci" / "slow.py")
assert SPEC is not None
assert SPEC.loader is not None
slow = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(slow)


def test_every_slow_test_belongs_to_a_kind() -> None:
    files = [path for path in (ROOT / "tests").rglob("test_*.py") if path != Path(__file__)]
    marked = [path for path in files if re.search(r"\bmark\.slow\b", path.read_text("utf-8"))]
    kinds = [ROOT / paths[0] for paths in slow.KINDS.values()]
    assert len(marked) > 5
    assert [p for p in marked if not any(p.is_relative_to(kind) for kind in kinds)] == []
    for paths in slow.KINDS.values():
        assert all((ROOT / path).exists() for path in paths)
        assert any(path.is_relative_to(ROOT / paths[0]) for path in marked)


def test_changed_new_and_renamed_files_are_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(slow, "KINDS", {"one": ("tests/one", "page.md"), "two": ("tests/two",)})
    for name in ("one", "two"):
        (tmp_path / "tests" / name / "__pycache__").mkdir(parents=True)
        (tmp_path / "tests" / name / "test_a.py").write_text("")
    assert slow.changed({}, tmp_path) == ["one", "two"]
    stamp = {kind: slow.digest(paths, tmp_path) for kind, paths in slow.KINDS.items()}
    (tmp_path / "tests/one/__pycache__/test_a.pyc").touch()
    assert slow.changed(stamp, tmp_path) == []
    (tmp_path / "page.md").write_text("New.")
    assert slow.changed(stamp, tmp_path) == ["one"]
    (tmp_path / "tests/two/test_a.py").rename(tmp_path / "tests/two/test_b.py")
    assert slow.changed(stamp, tmp_path) == ["one", "two"]
