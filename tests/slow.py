"""Slow tests run when the folders that they name have changed since they passed.

`pytest --due` runs those alone and notes their state in `slow.json`, which is committed. Until
then every run of the folder includes them.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NOTES = Path(__file__).with_name("slow.json")
_states = pytest.StashKey[dict[str, str]]()


def state_of(path: str) -> str:
    """Checksum of the files below a path that git does not ignore."""
    command = ["git", "ls-files", "-co", "--exclude-standard", "--", path]
    listed = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    checksum = hashlib.sha256()
    for name in sorted(set(listed.splitlines())):
        if (file := ROOT / name).is_file():
            checksum.update(name.encode() + b"\0" + file.read_bytes())
    return checksum.hexdigest()[:12]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--due", action="store_true", help="only the slow tests of changed folders"
    )


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(
    config: pytest.Config, items: list[pytest.Item]
) -> None:
    """Leave out slow tests that are not due, unless `-m` speaks of them."""
    if "slow" in config.option.markexpr:
        return
    groups = [_group(item) for item in items]
    state = {
        path: state_of(path) for path in {p for group in groups if group for p in group}
    }
    states = {
        " ".join(g): " ".join(state[path] for path in g) for g in set(groups) if g
    }
    passed = json.loads(NOTES.read_text("utf-8")) if NOTES.exists() else {}
    kept = list[pytest.Item]()
    left = list[pytest.Item]()
    for item, group in zip(items, groups, strict=True):
        key = " ".join(group)
        wanted = passed.get(key) != states[key] if group else not config.option.due
        (kept if wanted else left).append(item)
    config.hook.pytest_deselected(items=left)
    items[:] = kept
    config.stash[_states] = passed | states


def _group(item: pytest.Item) -> tuple[str, ...]:
    """The paths that a slow test depends on, with its own file; empty for other tests."""
    paths = {path for mark in item.iter_markers("slow") for path in mark.args}
    if item.get_closest_marker("slow") is None:
        return ()
    assert paths, f"{item.nodeid}: name the folders whose changes it tests"
    file = item.path.relative_to(ROOT)
    inside = any(file.is_relative_to(path) for path in paths)
    return tuple(sorted(paths if inside else {*paths, file.as_posix()}))


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    options = session.config.option
    states = session.config.stash.get(_states, None)
    if (
        options.due
        and not options.collectonly
        and states is not None
        and exitstatus in (0, 5)
    ):
        NOTES.write_text(json.dumps(states, indent=1, sort_keys=True) + "\n", "utf-8")
