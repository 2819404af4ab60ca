"""Output that all verbs share: JSON, tables, the next command, progress bars, output paths."""

import json
import os
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from evercal.errors import InputError

if TYPE_CHECKING:
    from tqdm import tqdm


def print_json(record: object) -> None:
    """Print one JSON object on one line of stdout."""
    print(json.dumps(record, allow_nan=False), flush=True)


def print_next(*words: object) -> None:
    """Print the command to run next; words in capitals are placeholders."""
    print("next: " + shlex.join(str(word) for word in words))


def progress_bar(what: str, total: int, unit: str, done: int = 0) -> "tqdm":
    """A progress bar on stderr; occasional lines if stderr is a file, nothing for a single step."""
    from tqdm import tqdm

    return tqdm(
        desc=what,
        total=total,
        unit=unit,
        initial=done,
        file=sys.stderr,
        disable=total == 1,
        mininterval=0.2 if sys.stderr.isatty() else 10.0,
        dynamic_ncols=True,
    )


def following(bar: "tqdm") -> Callable[[int, int], None]:
    """A callback (done, total) that a bar follows."""

    def show(done: int, total: int) -> None:
        bar.total = total
        bar.update(done - bar.n)

    return show


class Bars:
    """Progress bars of learning on stderr, one after the other; a context that closes the last.

    The line `start` is printed to `stream` before the first bar.
    """

    def __init__(self, stream: TextIO | None = None, start: str = ""):
        self._start, self._stream = start, stream or sys.stdout
        self._bar: tqdm | None = None
        self._step = ""

    def __enter__(self) -> "Bars":
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def step(self, name: str, done: int, total: int) -> "tqdm":
        """Show that part of a step is done; a new step gets a new bar."""
        if self._start:
            print(self._start, file=self._stream, flush=True)
            self._start = ""
        bar = self._bar
        if bar is None or name != self._step or total != bar.total or done < bar.n:
            self._close()
            # A resumed step starts where it stopped, so that its speed is measured from there.
            first = done if done > 8 else 0
            self._step, bar = name, progress_bar(name, total, _UNITS.get(name, "step"), first)
            self._bar = bar
        bar.update(done - bar.n)
        if done >= total:
            self._close()
        return bar

    def write(self, text: str) -> None:
        """Print lines above the bar."""
        from tqdm import tqdm

        tqdm.write(text, file=self._stream)

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None


_UNITS = {
    "encoding": "image",
    "learning": "scene",
    "mapping": "keyframe",
    "matching": "pair",
    "adjusting": "round",
}


def table(rows: Sequence[Mapping[str, object]]) -> list[str]:
    """Rows under the names of their columns; nothing without a row."""
    from tabulate import tabulate

    if not rows:
        return []
    align = ("left", *("right" for _ in list(rows[0])[1:]))
    return [tabulate(list(rows), headers="keys", colalign=align, disable_numparse=True)]


def size(count: float) -> str:
    """Format bytes: 1.2 MB."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.0f} B" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} GB"


def require_writable(path: Path | None, option: str) -> None:
    """Refuse an output file that cannot be written, before any work is done."""
    if path is None:
        return
    folder = path.resolve().parent
    if path.is_dir():
        raise InputError(f"{option} {path}: is a folder; give a file name")
    if not folder.is_dir():
        raise InputError(f"{option} {path}: folder {folder} does not exist; create it first")
    if not os.access(folder, os.W_OK):
        raise InputError(f"{option} {path}: folder {folder} is not writable")


def require_folder(path: Path | None, option: str) -> None:
    """Create an output folder, before any work is done."""
    if path is None:
        return
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{option} {path}: cannot be created ({error.strerror})") from None
    if not os.access(path, os.W_OK):
        raise InputError(f"{option} {path}: is not writable")
