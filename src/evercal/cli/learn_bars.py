"""Progress bars of learning, for every verb that learns."""

from typing import TYPE_CHECKING, TextIO

from evercal.cli.console import progress_bar

if TYPE_CHECKING:
    from types import TracebackType

    from tqdm import tqdm

    from evercal.continual.learn import Encoding
    from evercal.mapping.store import Checkpoint
    from evercal.networks.trainer import Progress


class LearnBars:
    """Shows the events of learning as progress bars on stderr; a context that closes them.

    Args:
        start: a line to print before the first bar, once learning has really begun.
        stream: where to; stdout when None.
    """

    def __init__(self, start: str = "", stream: TextIO | None = None):
        self._start, self._stream = start, stream
        self._bar: tqdm | None = None
        self._training = False

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

    def __call__(self, event: "Encoding | Progress | Checkpoint") -> None:
        """Takes one event."""
        from evercal.continual.learn import Encoding
        from evercal.networks.trainer import Progress

        if self._start:
            print(self._start, file=self._stream, flush=True)
            self._start = ""
        if isinstance(event, Progress):
            bar = self._at(event.step, event.total, training=True)
            text = f"loss {event.loss:.1f}, {100 * event.inlier_share:.0f} % inliers"
            bar.set_postfix_str(text, refresh=event.step == event.total)
            if event.step == event.total:  # what follows takes a while and is not training
                self._close()
        elif isinstance(event, Encoding):
            self._at(event.done, event.total, training=False)

    def _at(self, done: int, total: int, training: bool) -> "tqdm":
        """The bar moved to `done`; a new one where another task begins."""
        bar = self._bar
        if bar is None or training != self._training or total != bar.total or done <= bar.n:
            self._close()
            what, unit = ("training", "step") if training else ("encoding", "image")
            # A resumed task begins where it stood; what was done before must not count as speed.
            first = done if done > (1 if training else 8) else 0
            self._training, self._bar = training, progress_bar(what, total, unit, first)
            bar = self._bar
        bar.update(done - bar.n)
        return bar

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None
