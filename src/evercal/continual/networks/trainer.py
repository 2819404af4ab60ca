"""The training loop of a head; a method takes part through hooks."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import torch
from torch import Generator, Tensor

from evercal.classes import frozen
from evercal.continual.networks.buffer import FeatureBuffer, Rows, diffused, join
from evercal.continual.networks.device import tf32
from evercal.continual.networks.head import Head
from evercal.continual.networks.hooks import ProposedStep, TrainingHooks
from evercal.continual.networks.loss import (
    LossOptions,
    clamp_px,
    reprojection_loss,
    surface_loss,
)
from evercal.continual.networks.precision import autocast
from evercal.continual.networks.shampoo import OneSidedShampoo
from evercal.errors import require_numbers

INLIER_PX = 5.0
"""Reprojection error below which a row of `Progress.inlier_share` is an inlier, pixels."""


@frozen
class FitOptions:
    """One stage of training."""

    iterations: int = 4000
    """Steps of the optimisers."""
    batch: int = 2048
    """Rows of the scenes being learned in a step."""
    replay_batch: int = 1024
    """Replayed rows in a step, the same number from every remembered scene."""
    peak_rate: float = 4e-3
    """Peak of AdamW's one-cycle learning rate (cosine up and down)."""
    matrix_rate: float = 0.02
    """Peak rate of one-sided Shampoo for the hidden matrices; with 0, AdamW trains them too."""
    warm_share: float = 0.05
    """Share of the steps during which the rate rises."""
    weight_decay: float = 0.01
    """Decoupled weight decay, relative to the rate; not applied to codes and logits."""
    diffusion: float = 0.1
    """Standard deviation of the noise on each row's descriptor (GLACE's feature diffusion)."""
    surface_weight: float = 0.0
    """Weight of the distance to points from depths; with 0, no depths are estimated."""
    loss: LossOptions = field(default_factory=LossOptions)
    """Reprojection loss of new rows."""

    def __post_init__(self) -> None:
        """Check the numbers."""
        require_numbers(self, vars(self).keys() - {"loss"}, 0)
        require_numbers(self, ("batch",), 1)


@dataclass
class Progress:
    """State of the training after a step."""

    step: int
    """Completed steps."""
    total: int
    """Steps of the whole training."""
    costs: Tensor
    """(n,) loss of each new row in the last step."""
    errors_px: Tensor
    """(n,) reprojection error of each new row in the last step, pixels."""
    rate: float
    """Learning rate of AdamW in the last step."""
    earlier_s: float = 0.0
    """Time of training before a stop, seconds."""

    # Properties, because reading a value synchronises with the GPU.
    @property
    def loss(self) -> float:
        """Mean loss of the new rows in the last step."""
        return float(self.costs.mean())

    @property
    def inlier_share(self) -> float:
        """Share of the new rows within 5 px in the last step."""
        return float((self.errors_px < INLIER_PX).float().mean())


class HeadTrainer:
    """Trains a head on feature rows.

    The rows of a step depend only on the seed and the step number. The head is trained in place on
    its device, where the buffers must return their rows.
    """

    def __init__(
        self,
        head: Head,
        buffers: Sequence[FeatureBuffer],
        options: FitOptions,
        seed: int,
        hooks: TrainingHooks | None = None,
    ):
        self.head = head
        self.buffers = buffers
        self.options = options
        self.seed = seed
        self.step = 0
        self.earlier_s = 0.0
        """Time of training before a stop, seconds."""
        self._began = perf_counter()
        self.hooks = hooks or TrainingHooks()
        self._optimisers = _optimisers(head, options)

    def run(self) -> Iterator[Progress]:
        """Train to the end, yielding after every step."""
        self.head.train()
        while self.step < self.options.iterations:
            with tf32(self.head.device):
                progress = self._train_step()
            yield progress
        self.head.eval()

    def state_dict(self) -> dict[str, Any]:
        """Return what a trainer made in the same way needs to go on after the last step."""
        hooks = self.hooks
        return {
            "step": self.step,
            "seconds": self.earlier_s + perf_counter() - self._began,
            "head": self.head.state_dict(),
            "optimisers": [optimiser.state_dict() for optimiser in self._optimisers],
            "hooks": {name: getattr(hooks, name) for name in hooks.carried},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from the state of another trainer."""
        self.step = state["step"]
        self.earlier_s = state["seconds"]
        self.head.load_state_dict(state["head"])
        for optimiser, values in zip(
            self._optimisers, state["optimisers"], strict=True
        ):
            optimiser.load_state_dict(values)
        for name, value in state["hooks"].items():
            setattr(self.hooks, name, value)

    def _train_step(self) -> Progress:
        options = self.options
        rate = one_cycle(options, self.step)
        rows, fresh = self._rows(rate)
        for optimiser in self._optimisers:
            for group in optimiser.param_groups:
                group["lr"] = rate * group["share"]
            optimiser.zero_grad()
        replays = fresh < len(rows.scene)
        scene = rows.scene
        if len(self.buffers) == 1 and not replays:
            # A single scene is a plain bias; a scene per row costs a product in every layer.
            scene = self.buffers[0].scene
        with autocast(self.head.device):
            output = self.head(rows.features.float(), scene, rows.descriptor)
        tau_px = clamp_px(options.loss, self.step / options.iterations)
        new_rows = rows.part(slice(fresh))
        costs, errors = self._fresh_costs(output.points[:fresh], new_rows, tau_px)
        replayed = output.part(slice(fresh, None))
        remembered = rows.part(slice(fresh, None))
        loss = costs.mean()
        protection = self.hooks.cost(replayed, remembered, tau_px)
        if protection is not None:
            loss = loss + protection
        losses = self.hooks.constraints(replayed, remembered)
        constraints = list(map(self._gradients, losses))
        loss.backward()
        self._take_step(losses, constraints, rate / options.peak_rate)
        self.step += 1
        return Progress(
            step=self.step,
            total=options.iterations,
            costs=costs.detach(),
            errors_px=errors,
            rate=rate,
            earlier_s=self.earlier_s,
        )

    def _rows(self, rate: float) -> tuple[Rows, int]:
        generator = Generator().manual_seed(self.seed * 1_000_003 + self.step)
        share = self.options.batch // len(self.buffers)
        drawn = [buffer.draw(share, generator) for buffer in self.buffers]
        drawn += self.hooks.replayed(join(drawn), self.step, rate, generator)
        fresh = len(self.buffers) * share
        if self.head.options.condition != "descriptor":
            return join(drawn), fresh
        # Drawn on the device of the rows.
        seed = int(torch.randint(2**62, (), generator=generator, device="cpu"))
        noise = Generator(self.head.device).manual_seed(seed)
        diffusion = self.options.diffusion
        return join([diffused(rows, diffusion, noise) for rows in drawn]), fresh

    def _fresh_costs(
        self, points: Tensor, rows: Rows, tau_px: float
    ) -> tuple[Tensor, Tensor]:
        options = self.options
        costs, errors = reprojection_loss(points, rows.target, tau_px, options.loss)
        if options.surface_weight > 0:
            surface = surface_loss(points, rows.known, rows.target, tau_px)
            costs = costs + options.surface_weight * surface
        return costs, errors

    def _gradients(self, loss: Tensor) -> dict[str, Tensor]:
        names, values = zip(*self.head.named_parameters(), strict=True)
        gradients = torch.autograd.grad(
            loss, values, retain_graph=True, materialize_grads=True
        )
        return dict(zip(names, gradients, strict=True))

    def _take_step(
        self,
        losses: Sequence[Tensor],
        constraints: list[dict[str, Tensor]],
        schedule: float,
    ) -> None:
        if not self.hooks.edits_steps:
            self._step_optimisers()
            return
        parameters = dict(self.head.named_parameters())
        before = {name: value.detach().clone() for name, value in parameters.items()}
        self._step_optimisers()
        with torch.no_grad():
            values = torch.zeros(len(losses), device=self.head.device)
            for i, loss in enumerate(losses):
                values[i] = loss
            changes = {name: value - before[name] for name, value in parameters.items()}
            self.hooks.edit_step(
                ProposedStep(changes, values, constraints, self.step, schedule)
            )
            for name, value in parameters.items():
                value.copy_(before[name] + changes[name])

    def _step_optimisers(self) -> None:
        for optimiser in self._optimisers:
            optimiser.step()


def _optimisers(head: Head, options: FitOptions) -> list[torch.optim.Optimizer]:
    hidden = []
    decay = []
    plain = []
    for name, parameter in head.named_parameters():
        if name.startswith(("code", "logit")):
            plain.append(parameter)
        elif options.matrix_rate > 0 and parameter.shape == (head.options.width,) * 2:
            hidden.append(parameter)
        else:
            decay.append(parameter)
    rate = options.peak_rate
    weight_decay = options.weight_decay
    groups = [
        {"params": decay, "share": 1.0},
        {"params": plain, "share": 1.0, "weight_decay": 0.0},
    ]
    adamw = torch.optim.AdamW(groups, lr=rate, weight_decay=weight_decay, fused=True)
    if not hidden:
        return [adamw]
    matrices = [{"params": hidden, "share": options.matrix_rate / rate}]
    return [adamw, OneSidedShampoo(matrices, rate, weight_decay)]


def one_cycle(options: FitOptions, step: int) -> float:
    """Return the learning rate of a step: cosine from 1/25 of the peak up, then down to zero.

    The shape is that of torch's OneCycleLR, but without state to save.
    """
    rise = max(1.0, options.warm_share * options.iterations)
    high = options.peak_rate
    if step < rise:
        low = high / 25
        share = 1 - step / rise
    else:
        low = 0.0
        share = (step - rise) / max(1.0, options.iterations - rise)
    return low + (high - low) * 0.5 * (1 + math.cos(math.pi * share))
