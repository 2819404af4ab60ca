"""Slow tests run when the folders that they name have changed since they passed.

`pytest --due` runs those alone and notes their state in `slow.json`, which is committed. Until
then every run of the folder includes them.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NOTES = Path(__file__).with_name("slow.json")
_states = pytest.StashKey[dict[str, str]]()


def state_of(paths: Iterable[str]) -> str:
    """Checksum of the files below some paths that git does not ignore."""
    command = ["git", "ls-files", "-co", "--exclude-standard", "--", *paths]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    checksum = hashlib.sha256()
    for name in sorted(set(listed.splitlines())):
        if (file := ROOT / name).is_file():
            checksum.update(name.encode() + b"\0" + file.read_bytes())
    return checksum.hexdigest()[:16]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--due", action="store_true", help="only the slow tests of changed folders")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out slow tests that are not due, unless `-m` speaks of them."""
    if "slow" in config.option.markexpr:
        return
    named = defaultdict[str, set[str]](set)
    for item in items:
        for mark in item.iter_markers("slow"):
            assert mark.args, f"{item.nodeid}: name the folders whose changes it tests"
            file = item.path.relative_to(ROOT).as_posix()
            named[file] |= {file, *mark.args}
    states = {file: state_of(sorted(paths)) for file, paths in named.items()}
    passed = json.loads(NOTES.read_text("utf-8")) if NOTES.exists() else {}
    due = {ROOT / file for file, state in states.items() if passed.get(file) != state}
    kept, left = list[pytest.Item](), list[pytest.Item]()
    for item in items:
        is_slow = item.get_closest_marker("slow") is not None
        wanted = item.path in due if is_slow else not config.option.due
        (kept if wanted else left).append(item)
    config.hook.pytest_deselected(items=left)
    items[:] = kept
    config.stash[_states] = passed | states


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    options, states = session.config.option, session.config.stash.get(_states, None)
    if options.due and not options.collectonly and states is not None and exitstatus in (0, 5):
        NOTES.write_text(json.dumps(states, indent=1, sort_keys=True) + "\n", "utf-8")
