"""`evercal learn --strategy NAME`: options and progress bars of strategies that train a network."""

import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TextIO

from tyro.conf import arg

from evercal.cli.console import progress_bar
from evercal.errors import InputError

if TYPE_CHECKING:
    from tqdm import tqdm

    from evercal.learning.scene import LearnReport
    from evercal.recordings import Recording


@dataclass(frozen=True)
class NetworkOptions:
    """Options of strategies that train a network; a map refuses them."""

    preset: Literal["fast", "demo", "bench", "converged", "paper"] = "fast"
    """Amount of training: fast takes minutes on two cores, paper needs a GPU."""
    centres: Annotated[int | None, arg(metavar="M", help_behavior_hint="")] = None
    """Cluster centres that a scene adds to the network. Default: those of the preset."""
    seed: int = 0
    """Random seed."""

    def refuse(self) -> None:
        """Refuse options that a map does not have.

        Raises:
            InputError: An option was given.
        """
        for field in fields(self):
            if (value := getattr(self, field.name)) != field.default:
                raise InputError(
                    f"--{field.name} {value}: a map is not trained; omit the option, or choose a"
                    " network with --strategy"
                )


@dataclass(frozen=True)
class LearnRequest:
    """What `evercal learn` passes on."""

    store: Path
    strategy: str
    memory: str
    encoder: Path | None
    device: str
    options: NetworkOptions


def learn_into_networks(
    request: LearnRequest, recording: "Recording", start: str, stream: TextIO
) -> "LearnReport":
    """Train a network on a recording, with progress bars.

    Args:
        request: store and options.
        recording: to learn.
        start: a line to print when learning begins.
        stream: where the line goes.
    """
    from evercal.continual.learning.learn_networks import NetworkLearnOptions, learn_networks

    given = request.options
    if given.centres is not None and given.centres < 1:
        raise InputError(f"--centres {given.centres}: give a number >= 1")
    if given.seed < 0:
        raise InputError(f"--seed {given.seed}: give a number >= 0")
    options = NetworkLearnOptions(
        strategy=request.strategy,
        preset=given.preset,
        memory=request.memory,
        centres=given.centres,
        encoder=request.encoder,
        device=request.device,
        seed=given.seed,
    )
    with Bars(start, stream) as bars:
        return learn_networks(request.store, recording, options, bars.event)


class Bars:
    """Progress bars of learning on stderr, one after the other; a context that closes the last.

    Args:
        start: a line to print before the first bar.
        stream: where the line goes; stdout by default.
    """

    def __init__(self, start: str = "", stream: TextIO | None = None):
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

    def event(self, event: object) -> None:
        """Show an event of network training."""
        from evercal.continual.learning.stage import Encoding
        from evercal.continual.networks.trainer import Progress

        if isinstance(event, Progress):
            bar = self.step("training", event.step, event.total)
            text = f"loss {event.loss:.1f}, {100 * event.inlier_share:.0f} % inliers"
            bar.set_postfix_str(text, refresh=event.step == event.total)
        elif isinstance(event, Encoding):
            self.step("encoding", event.done, event.total)

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
