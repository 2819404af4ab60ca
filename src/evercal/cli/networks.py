"""`evercal learn --strategy NAME`: strategies that train a network."""

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Annotated, Literal

from evercal.cli import args
from evercal.errors import InputError

if TYPE_CHECKING:
    from evercal.cli.console import Bars
    from evercal.cli.learn import Learn
    from evercal.learning.scene import LearnReport
    from evercal.recordings import Recording


@dataclass(frozen=True)
class NetworkOptions:
    """Options of strategies that train a network; a map refuses them."""

    preset: Literal["fast", "demo", "bench", "converged", "paper"] = "fast"
    """Amount of training: fast takes minutes on two cores, paper needs a GPU."""
    centres: Annotated[int | None, args.shown("M")] = None
    """Cluster centres that a scene adds to the network. Default: those of the preset."""
    seed: int = 0
    """Random seed."""

    def refuse(self) -> None:
        """Refuse options that a map does not have."""
        for field in fields(self):
            if (value := getattr(self, field.name)) != field.default:
                raise InputError(
                    f"{args.option(field.name)} {value}: a map is not trained; omit the option, or"
                    " choose a network with --strategy"
                )


def learn_into_networks(
    given: "Learn", strategy: str, recording: "Recording", bars: "Bars"
) -> "LearnReport":
    """Train a network on a recording."""
    from evercal.continual.learning.learn_networks import NetworkLearnOptions, learn_networks
    from evercal.continual.learning.stage import Encoding
    from evercal.continual.networks.trainer import Progress

    wanted = given.networks
    if wanted.centres is not None and wanted.centres < 1:
        raise InputError(f"--centres {wanted.centres}: give a number >= 1")
    if wanted.seed < 0:
        raise InputError(f"--seed {wanted.seed}: give a number >= 0")

    def show(event: object) -> None:
        if isinstance(event, Progress):
            bar = bars.step("training", event.step, event.total)
            text = f"loss {event.loss:.1f}, {100 * event.inlier_share:.0f} % inliers"
            bar.set_postfix_str(text, refresh=event.step == event.total)
        elif isinstance(event, Encoding):
            bars.step("encoding", event.done, event.total)

    options = NetworkLearnOptions(
        strategy=strategy,
        preset=wanted.preset,
        memory=given.memory or "10%",
        centres=wanted.centres,
        encoder=given.encoder,
        device=given.device,
        seed=wanted.seed,
    )
    return learn_networks(given.store, recording, options, show)
