"""Progress bars of learning, for every verb that learns."""

from typing import TYPE_CHECKING, TextIO

from evercal.cli.console import progress_bar

if TYPE_CHECKING:
    from types import TracebackType

    from tqdm import tqdm

    from evercal.continual.networks.trainer import Progress
    from evercal.continual.stage import Encoding
    from evercal.mapping.build import Mapping
    from evercal.mapping.store import Checkpoint


_UNITS = {
    "encoding": "image",
    "mapping": "keyframe",
    "matching": "pair",
    "choosing keyframes": "try",
    "adjusting": "round",
    "training": "step",
}
_FRESH = {"encoding": 8}


class LearnBars:
    """Shows the events of learning as progress bars on stderr; a context that closes them.

    Args:
        start: a line to print before the first bar, once learning has really begun.
        stream: where to; stdout when None.
    """

    def __init__(self, start: str = "", stream: TextIO | None = None):
        self._start, self._stream = start, stream
        self._bar: tqdm | None = None
        self._what = ""

    def __enter__(self) -> "LearnBars":
        """Nothing is shown yet: bad input is to be told without anything before it."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: "TracebackType | None",
    ) -> None:
        """Ends the last bar's line."""
        self._close()

    def __call__(self, event: "Encoding | Mapping | Progress | Checkpoint") -> None:
        """Takes one event."""
        from evercal.continual.networks.trainer import Progress
        from evercal.continual.stage import Encoding
        from evercal.mapping.build import Mapping

        if self._start:
            print(self._start, file=self._stream, flush=True)
            self._start = ""
        if isinstance(event, Progress):
            bar = self._at("training", event.step, event.total)
            text = f"loss {event.loss:.1f}, {100 * event.inlier_share:.0f} % inliers"
            bar.set_postfix_str(text, refresh=event.step == event.total)
        elif isinstance(event, Encoding):
            bar = self._at("encoding", event.done, event.total)
        elif isinstance(event, Mapping):
            bar = self._at(event.what, event.done, event.total)
        else:
            return
        if bar.n >= event.total and not isinstance(event, Encoding):
            self._close()  # what follows may take a while and is another task

    def _at(self, what: str, done: int, total: int) -> "tqdm":
        """The bar moved to `done`; a new one where another task begins."""
        bar = self._bar
        if bar is None or what != self._what or total != bar.total or done < bar.n:
            self._close()
            # A resumed task begins where it stood; what was done before must not count as speed.
            first = done if done > _FRESH.get(what, 1) else 0
            self._what, self._bar = what, progress_bar(what, total, _UNITS[what], first)
            bar = self._bar
        bar.update(done - bar.n)
        return bar

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None
