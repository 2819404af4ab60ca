"""Options of the training of networks, which `learn` and `bench` share, and its progress bars."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from evercal.choices import Preset
from evercal.cli import args
from evercal.errors import InputError
from evercal.progress import Bars

if TYPE_CHECKING:
    from evercal.continual.learning.stage import StageOptions
    from evercal.continual.strategies import Strategy

LEAST_BATCH = 64
"""Smallest number of rows in a step that learns anything."""
MOST_REPLAY = 100
"""Maximum number of replayed rows of a step for each new one."""


@dataclass(frozen=True, kw_only=True)
class Training:
    """How a network is trained on a scene."""

    preset: Preset = "fast"
    """Amount of training: fast takes minutes on two cores, paper needs a GPU."""
    backbone: Literal["evercal", "paper", "paper_head"] = "evercal"
    """Network: ours, or the paper's, trained by its optimiser and loss (paper) or by ours
    (paper_head)."""
    offsets: Literal["per_centre", "shared"] = "per_centre"
    """One offset and scale per centre (the paper), or one for all centres (GLACE)."""
    centres: Annotated[int | None, args.shown("M")] = None
    """Cluster centres that a scene adds to the network, or of all scenes where they are given in
    advance. Default: those of the preset."""
    steps: args.Count = None
    """Optimiser steps of a scene. Default: those of the preset."""
    batch: args.Count = None
    """Rows of the new scene in a step. Default: those of the preset."""
    replay: Annotated[float | None, args.shown("SHARE")] = None
    """Replayed rows of a step, as a share of the new ones. Default: that of the preset."""
    device: args.Device = "auto"
    plugin: Annotated[Path | None, args.shown("FILE.py")] = None
    """Python file of your own strategies (see examples/my_strategy.py)."""

    def load_plugin(self) -> None:
        """Add the strategies of the plugin, if there is one."""
        if self.plugin:
            from evercal.continual.strategies import load_plugin

            load_plugin(self.plugin)

    def strategy(self, name: str) -> "Strategy":
        """A strategy with the weight that was tuned on the network."""
        from evercal.continual.strategies import strategy_named

        ours = self.backbone == "evercal" and self.preset != "paper"
        return strategy_named(name, paper_head=not ours)

    def stage(
        self, seed: int, memory: str | None, centres: Literal["grow", "fixed"] = "grow"
    ) -> "StageOptions":
        """Options of a scene; `fixed` centres are those of all scenes, for the paper's network."""
        from evercal.continual.learning.presets import BACKBONES, preset

        for name, least in (("centres", 1), ("steps", 1), ("batch", LEAST_BATCH)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise InputError(f"--{name} {value}: give a number >= {least}")
        try:
            stage = preset(self.preset, seed).with_memory(memory)
        except InputError as error:
            raise InputError(f"--{error}") from None
        backbone = self.backbone
        if self.preset == "paper":
            if backbone == "paper_head":
                raise InputError(
                    "--backbone paper_head: preset paper has the paper's training; omit the option"
                )
            backbone = "paper"
        stage = BACKBONES[backbone](stage)
        fit = stage.fit
        batch = self.batch or fit.batch
        replay = self.replay
        if replay is None:
            replay = fit.replay_batch / fit.batch
        if not 0 < replay <= MOST_REPLAY:
            raise InputError(f"--replay {replay:g}: give a share up to {MOST_REPLAY}")
        fit = dataclasses.replace(
            fit,
            iterations=self.steps or fit.iterations,
            batch=batch,
            replay_batch=round(replay * batch),
        )
        head = dataclasses.replace(
            stage.head,
            offsets=self.offsets,
            centres_per_scene=self.centres or stage.head.centres_per_scene,
        )
        if head.centres == "fixed":
            head = dataclasses.replace(head, centres=centres)
        return dataclasses.replace(stage, head=head, fit=fit)


def observer(bars: Bars) -> Callable[[Any], None]:
    """Shows events of a training as bars, with its loss and inliers."""
    from evercal.continual.networks.trainer import Progress

    def show(event: Any) -> None:
        if isinstance(event, Progress):
            bar = bars.step("training", event.step, event.total)
            text = f"loss {event.loss:.1f}, {100 * event.inlier_share:.0f} % inliers"
            bar.set_postfix_str(text, refresh=event.step == event.total)
        else:
            bars.step(event.name, event.done, event.total)

    return show
