"""Output that all verbs share: JSON, tables, the next command, output paths."""

import json
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TextIO

from evercal.errors import InputError, printable, with_options
from evercal.processes import command_line


def say(text: str, file: TextIO | None = None) -> None:
    """Print text, to stdout by default, with options and escaped control characters."""
    print(printable(with_options(text)), file=file, flush=True)


def say_notes(notes: Iterable[str]) -> None:
    """Print what a reader chose and left out to stderr."""
    for note in notes:
        say(f"note: {note}", sys.stderr)


def print_json(record: object) -> None:
    """Print one JSON object on one line of stdout; its sentences name options."""
    print(with_options(json.dumps(record, allow_nan=False)), flush=True)


def print_next(*words: object) -> None:
    """Print the command to run next; words in capitals are placeholders."""
    say("next: " + command_line(map(str, words)))


def table(rows: Sequence[Mapping[str, object]]) -> list[str]:
    """Rows under the names of their columns; nothing without a row."""
    from tabulate import tabulate

    if not rows:
        return []
    align = ("left", *["right"] * (len(rows[0]) - 1))
    return [tabulate(list(rows), headers="keys", colalign=align, disable_numparse=True)]


def motion(mm: float | None, deg: float | None, between: str = ", ") -> str:
    """A length and an angle; the angle alone where the unit of length is unknown."""
    angle = f"{deg:.3f} deg"
    if mm is None:
        return angle
    return f"{mm:.2f} mm{between}{angle}"


def numbers(values: "Iterable[float]", form: str) -> str:
    """Numbers of one format, separated by spaces."""
    return " ".join(map(f"{{:{form}}}".format, values))


def size(count: float) -> str:
    """Format bytes: 1.2 MB."""
    if count < 1000:
        return f"{count:.0f} B"
    for unit in ("kB", "MB"):
        count /= 1000
        if count < 1000:
            return f"{count:.1f} {unit}"
    return f"{count / 1000:.1f} GB"


def require_writable(path: Path | None, option: str) -> None:
    """Refuse an output file that cannot be written, before any work is done."""
    if not path:
        return
    folder = path.resolve().parent
    if path.is_dir():
        raise InputError(f"{option} {path}: is a folder; give a file name")
    if not folder.is_dir():
        raise InputError(
            f"{option} {path}: folder {folder} does not exist; create it first"
        )
    if not os.access(folder, os.W_OK):
        raise InputError(f"{option} {path}: folder {folder} is not writable")


def require_folder(path: Path | None, option: str) -> None:
    """Create an output folder, before any work is done."""
    if not path:
        return
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{option} {path}: cannot be created ({error.strerror})"
        ) from None
    if not os.access(path, os.W_OK):
        raise InputError(f"{option} {path}: is not writable")
