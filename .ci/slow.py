"""Run the slow tests of every kind whose files changed since they last passed.

    python .ci/slow.py          # .ci/run does it
    python .ci/slow.py --all    # all kinds

`slow.json` beside this file holds a hash of each kind's files. A run that passes and skips nothing
renews it; commit it with the change.
"""

import hashlib
import json
import sys
from collections.abc import Iterable
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
STAMP = ROOT / ".ci" / "slow.json"
PACKAGE = "src/evercal"
PAGES = ("docs", "mkdocs.yml", "README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md")
KINDS = {
    "site": ("tests/test_site.py", *PAGES, f"{PACKAGE}/__init__.py", f"{PACKAGE}/cli/__init__.py"),
    "tutorials": ("tests/test_tutorials.py", "docs/tutorials", "docs/_site", "examples"),
    "training": ("tests/training", "training", "rooms"),
    **{
        name: (f"tests/{name}", f"{PACKAGE}/{name}")
        for name in ("calibration", "continual", "recordings", "reports", "service", "simulation")
    },
}
"""By kind: its tests, then the other files and folders that call for them."""


def digest(paths: Iterable[str], root: Path = ROOT) -> str:
    """A hash of the names and contents of files and of everything below folders."""
    found = hashlib.sha256()
    for path in map(root.joinpath, paths):
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            if file.is_file() and file.parent.name != "__pycache__":
                content = hashlib.sha256(file.read_bytes()).hexdigest()
                found.update(f"{file.relative_to(root).as_posix()} {content}\n".encode())
    return found.hexdigest()


def changed(stamp: dict[str, str], root: Path = ROOT) -> list[str]:
    """Kinds whose files are not those of the stamp."""
    return [kind for kind, paths in KINDS.items() if stamp.get(kind) != digest(paths, root)]


class Skipped:
    """Remembers the tests that were skipped."""

    def __init__(self) -> None:
        self.tests: set[str] = set()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Called by pytest."""
        if report.skipped:
            self.tests.add(report.nodeid)


def main() -> int:
    """Run what is due; return pytest's exit code."""
    stamp = json.loads(STAMP.read_text(encoding="utf-8"))
    due = list(KINDS) if "--all" in sys.argv else changed(stamp)
    print("slow tests:", ", ".join(due) or "nothing changed")
    if not due:
        return 0
    digests, skipped = {kind: digest(KINDS[kind]) for kind in due}, Skipped()
    words = ["-n", "auto", "--dist", "worksteal", "-rs", "-m", "slow and not gpu"]
    tests = [str(ROOT / KINDS[kind][0]) for kind in due]
    code = pytest.main([*words, "--rootdir", str(ROOT), *tests], plugins=[skipped])
    if code == 0:
        for kind in due:
            if not any(test.startswith(KINDS[kind][0]) for test in skipped.tests):
                stamp[kind] = digests[kind]
        STAMP.write_text(json.dumps(stamp, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    return int(code)


if __name__ == "__main__":
    sys.exit(main())
