"""Progress on stderr: one bar after the other."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TextIO

from evercal.errors import printable, with_options

if TYPE_CHECKING:
    from tqdm import tqdm

OnProgress = Callable[[str, int, int], object]
"""Called with the current step, how much of it is done, and its total."""
_INTERVALS_S = {True: 0.2, False: 10.0}
"""Least time between two updates of a bar, on a terminal and in a file."""
_RESUMED = 8
"""If more than this is done at the first report of a step, the step was resumed."""
_UNITS = {
    "depths": "frame",
    "encoding": "image",
    "locating": "image",
    "learning": "scene",
    "mapping": "keyframe",
    "matching": "pair",
    "adjusting": "round",
}
"""What a step of learning counts."""


def progress_bar(what: str, total: int, unit: str, done: int = 0) -> "tqdm":
    """A progress bar on stderr; occasional lines if stderr is a file, nothing for a single step."""
    from tqdm import tqdm

    return tqdm(
        desc=printable(what),
        total=total,
        unit=unit,
        initial=done,
        file=sys.stderr,
        disable=total == 1,
        mininterval=_INTERVALS_S[sys.stderr.isatty()],
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
        self._start = start
        self._stream = stream or sys.stdout
        self._bar: tqdm | None = None
        self._step = ""

    def __enter__(self) -> "Bars":
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def step(self, name: str, done: int, total: int) -> "tqdm":
        """Show that part of a step is done; a new step gets a new bar."""
        if self._start:
            print(printable(self._start), file=self._stream, flush=True)
            self._start = ""
        bar = self._bar
        if bar is None or name != self._step or total != bar.total or done < bar.n:
            self._close()
            # A resumed step starts where it stopped, so that its speed is measured from there.
            first = 0
            if done > _RESUMED:
                first = done
            self._step = name
            bar = progress_bar(name, total, _UNITS.get(name, "step"), first)
            self._bar = bar
        bar.update(done - bar.n)
        if done >= total:
            self._close()
        return bar

    def write(self, text: str) -> None:
        """Print lines above the bar; their sentences name options."""
        from tqdm import tqdm

        tqdm.write(printable(with_options(text)), file=self._stream)

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None


@contextmanager
def shown(on_progress: OnProgress | None) -> Iterator[OnProgress]:
    """A callback of the caller, or bars that end with the context."""
    if on_progress is not None:
        yield on_progress
        return
    with Bars() as bars:
        yield bars.step
