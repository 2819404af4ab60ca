"""The refusals of some folders, each with an example that a test has caused.

As a plugin of pytest it notes where every `InputError` of a test was made, in the folder that
EVERCAL_REFUSALS names.
"""

import ast
import json
import os
import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from evercal import errors

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "evercal"
FOLDERS = ("recordings", "calibration")
NOTES = "EVERCAL_REFUSALS"
"""Environment variable with the folder that the examples are noted in."""
_TEMPORARY = re.compile(r"/[^\s:,;]*/pytest-\d+/(popen-gw\d+/)?[^\s/:,;]+/")
"""A folder of one test."""
_NAMES = re.compile(r"'[^']*'|`[^`]*`|[^\s:]+\.\w+:|[\d.]+")
"""Names and numbers in a message."""
_ALIKE = 50
"""Messages that begin with so many equal characters, without names and numbers, are alike."""
Place = tuple[str, int]
"""A file of the source, and a line."""


def pytest_configure() -> None:
    """Note every refusal from here on, where the environment names a folder for it."""
    if NOTES in os.environ:
        folder = Path(os.environ[NOTES])
        folder.mkdir(parents=True, exist_ok=True)
        _note(folder / f"{os.getpid()}.jsonl")


def _note(path: Path) -> None:
    made = errors.InputError.__init__

    def noted(self: errors.InputError, message: str = "") -> None:
        made(self, message)
        frame = sys._getframe(1)
        while frame and not _in_folders(frame.f_code.co_filename):
            frame = frame.f_back
        if frame:
            row = [frame.f_code.co_filename, frame.f_lineno, str(self)]
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")

    errors.InputError.__init__ = noted


def _in_folders(name: str) -> bool:
    """Whether a file of the source is in one of the folders."""
    return any(SOURCE / folder in Path(name).parents for folder in FOLDERS)


def refusals() -> Iterator[tuple[str, int, int]]:
    """Each call of `InputError` in the folders: file, first line and last line."""
    for folder in FOLDERS:
        for path in sorted((SOURCE / folder).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Call) and _is_refusal(node.func):
                    name = path.relative_to(SOURCE).as_posix()
                    yield name, node.lineno, node.end_lineno or node.lineno


def _is_refusal(function: Any) -> bool:
    return isinstance(function, ast.Name) and function.id == "InputError"


def examples(folder: Path) -> dict[Place, dict[str, str]]:
    """Refusals of every line, the shortest of those that differ in names and numbers only."""
    found = defaultdict[Place, dict[str, str]](dict)
    for path in sorted(folder.glob("*.jsonl")):
        for line in path.read_text(encoding="utf-8").splitlines():
            name, number, message = json.loads(line)
            message = _TEMPORARY.sub("", message)
            place = Path(name).relative_to(SOURCE).as_posix(), number
            kind = _NAMES.sub("", message)[:_ALIKE]
            before = found[place].get(kind, message)
            found[place][kind] = min(before, message, key=len)
    return found


def page(folder: Path) -> str:
    """The refusals as a table in Markdown, those without an example at the end."""
    shown = examples(folder)
    rows = ["| file | example |", "|---|---|"]
    for (name, _), messages in sorted(shown.items()):
        for message in sorted(messages.values()):
            escaped = message.replace("|", "\\|")
            rows.append(f"| `{name}` | {escaped} |")
    without = []
    for name, first, last in refusals():
        if not any((name, i) in shown for i in range(first, last + 1)):
            without.append(f"`{name}:{first}`")
    end = f"{len(without)} have no example in these tests: {', '.join(without)}."
    return "\n".join([*rows, "", end, ""])


def run(
    notes: Path = Path("runs/refusals"), out: Path = Path("runs/refusals.md")
) -> None:
    """Write the refusals of `recordings` and `calibration`, with examples of their tests.

    Before it: EVERCAL_REFUSALS=runs/refusals python -m pytest -p benchmarks.refusals
    tests/recordings tests/calibration

    Args:
        notes: Folder of the examples, which the tests have written.
        out: Page to write.
    """
    if not notes.is_dir():
        raise errors.InputError(f"{notes}: missing; run the tests with {NOTES}={notes}")
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(page(notes), encoding="utf-8")
    print(f"wrote {out}")
