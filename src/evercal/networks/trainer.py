"""The loop: one head, rows of one or more scenes, optionally rows that are replayed."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.nn import functional as F

from evercal.features.precision import autocast
from evercal.networks.buffer import FeatureBuffer, Rows, join
from evercal.networks.distributed import average, own_share, processes
from evercal.networks.gradients import Combine, Gradients
from evercal.networks.head import Head, HeadOutput
from evercal.networks.loss import LossOptions, clamp_px, reprojection_loss

INLIER_PX = 5.0
# Newton-Schulz iterations of Muon. Three train as well as the usual five here, and cost less.
MUON_STEPS = 3
# While points are still far off, their errors say nothing about the lens.
CORRECTION_FROM_PX = 20.0
# How often it is chosen anew which views are replayed.
CHOICE_STEPS = 20


@dataclass(frozen=True)
class FitOptions:
    """One stage of training."""

    iterations: int = 4000
    """Optimiser steps."""
    batch: int = 2048
    """Rows of the scenes being learned in a step."""
    replay_batch: int = 1024
    """Replayed rows in a step, drawn evenly from up to two remembered scenes; see
    `replayed_rows` for more."""
    peak_rate: float = 4e-3
    """Peak of the one-cycle learning rate (cosine up and down) of AdamW."""
    muon_rate: float = 0.02
    """The same peak for the hidden matrices, which Muon trains (Jordan et al., 2024); 0 leaves them
    to AdamW."""
    warm_share: float = 0.05
    """Share of the steps in which the rate rises."""
    weight_decay: float = 0.01
    """Decoupled, relative to the rate; codes and logits have none."""
    diffusion: float = 0.1
    """Standard deviation of the noise on every row's descriptor (GLACE's feature diffusion)."""
    intrinsics_rate: float = 0.3
    """Learning rate of the camera correction (focal length, principal point, k1, k2) as a share of
    the head's; 0 trusts the given intrinsics. Cameras with known distortion stay as they are."""
    loss: LossOptions = field(default_factory=LossOptions)
    """Reprojection loss on the scenes being learned."""


@dataclass
class Progress:
    """Where training stands."""

    step: int
    """Steps done."""
    total: int
    """Steps of the stage."""
    loss: float
    """Mean loss of the rows being learned at the last step."""
    inlier_share: float
    """Share of the rows being learned within 5 px at the last step."""


ReplayLoss = Callable[[HeadOutput, Rows, float], Tensor]
"""What replay costs: (head output on replayed rows, those rows, progress in [0, 1]) -> scalar."""


Precondition = Callable[
    [Head, Sequence[FeatureBuffer], int], Callable[[], AbstractContextManager[None]]
]
"""(head before the stage, rows of remembered scenes, seed) -> what makes the context of a step."""

ChooseViews = Callable[[Head, Rows, FeatureBuffer, float, torch.Generator], Tensor]
"""(head, new rows, rows of a remembered scene, learning rate, generator) -> numbers of views."""


@dataclass
class Replay:
    """Rows of remembered scenes and what they cost."""

    buffers: Sequence[FeatureBuffer]
    """One per remembered scene."""
    penalty: ReplayLoss
    """Loss on a batch of their rows."""
    per_scene: bool = False
    """Whether the penalty is one scene's, and counts once for each."""
    precondition: Precondition | None = None
    """What every optimiser step is taken in; None takes it as it is."""
    combine: Combine | None = None
    """How the gradient of each scene's penalty joins that of the new rows; None adds them up."""
    references: Tensor | None = None
    """(scenes,) penalty of each scene when it was just learned, for `combine`."""
    choose_views: ChooseViews | None = None
    """Which views' rows are replayed; None draws from all."""


class HeadTrainer:
    """Trains `head` on `buffers`; can stop after any step and go on from `state()`.

    The rows of step k are a function of (seed, k), so a resumed run sees what an uninterrupted one
    would have seen.

    Args:
        head: trained in place.
        buffers: rows of the scenes being learned.
        replay: rows of remembered scenes.
        options: how.
        seed: random seed.
        regularizer: what the weights themselves cost.
    """

    def __init__(
        self,
        head: Head,
        buffers: Sequence[FeatureBuffer],
        replay: Replay | None,
        options: FitOptions,
        seed: int,
        regularizer: Callable[[], Tensor] | None = None,
    ):
        self.head, self.buffers, self.replay = head, buffers, replay
        self.regularizer = regularizer
        self.options, self.seed, self.step = options, seed, 0
        hidden, decay, plain = [], [], []
        for name, parameter in head.named_parameters():
            if name.startswith(("code", "logit")):
                plain.append(parameter)
            elif options.muon_rate > 0 and parameter.shape == (head.options.width,) * 2:
                hidden.append(parameter)
            else:
                decay.append(parameter)
        self.correction = torch.nn.Parameter(torch.zeros(len(buffers), 5))
        self._correctable = torch.tensor([[buffer.correctable] for buffer in buffers]).float()
        groups = [
            {"params": decay, "share": 1.0},
            {"params": plain, "share": 1.0, "weight_decay": 0.0},
            {"params": [self.correction], "share": options.intrinsics_rate, "weight_decay": 0.0},
        ]
        rate, decay_rate = options.peak_rate, options.weight_decay
        self._optimisers: list[torch.optim.Optimizer] = [
            torch.optim.AdamW(groups, lr=rate, weight_decay=decay_rate, fused=True)
        ]
        if hidden:
            matrices = [{"params": hidden, "share": options.muon_rate / rate}]
            self._optimisers.append(
                torch.optim.Muon(matrices, weight_decay=decay_rate, ns_steps=MUON_STEPS)
            )

        self._replayed_views: list[Tensor] = []
        self._losses: Tensor | None = None  # of remembered scenes in the step before
        self._spare: Callable[[], AbstractContextManager[None]] = nullcontext
        if replay is not None and replay.precondition is not None:
            self._spare = replay.precondition(head, replay.buffers, seed)

    def run(self) -> Iterator[Progress]:
        """Trains to the end, yielding after every step."""
        self.head.train()
        while self.step < self.options.iterations:
            yield self._train_step()
        self.head.eval()

    def _train_step(self) -> Progress:
        options, replay = self.options, self.replay
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + self.step)
        share = options.batch // len(self.buffers)
        parts = [buffer.draw(share, generator) for buffer in self.buffers]
        if replay is not None:
            parts += self._replayed(parts, replay, generator)
        parts = [own_share(part) for part in parts]
        share //= processes()
        fresh = share * len(self.buffers)
        rows = join(parts)
        if self.head.options.condition == "descriptor":
            noise = torch.randn(rows.descriptor.shape, generator=generator)
            rows.descriptor = F.normalize(rows.descriptor + options.diffusion * noise, dim=-1)
        for optimiser in self._optimisers:
            for group in optimiser.param_groups:
                group["lr"] = one_cycle(options, self.step) * group["share"]
        # One scene for all rows is a plain bias, a scene per row another product in every layer.
        scene = rows.scene if len(parts) > 1 else self.buffers[0].scene
        with autocast():
            output = self.head(rows.features.float(), scene, rows.descriptor)
        progress = self.step / options.iterations
        new = rows.part(slice(0, fresh))
        tau = clamp_px(options.loss, progress)
        correction = None
        if options.intrinsics_rate > 0 and tau < CORRECTION_FROM_PX:
            correction = (self.correction * self._correctable).repeat_interleave(share, 0)
        points = output.points[:fresh]
        cost, error = reprojection_loss(points, new.target, tau, options.loss, correction)
        loss = cost.mean()
        if self.regularizer is not None:
            loss = loss + self.regularizer()
        for optimiser in self._optimisers:
            optimiser.zero_grad()
        self._backward(loss, output, rows, fresh)
        with self._spare():
            for optimiser in self._optimisers:
                optimiser.step()
        self.step += 1
        inliers = float((error < INLIER_PX).float().mean())
        return Progress(self.step, options.iterations, float(cost.mean().detach()), inliers)

    def _replayed(
        self, fresh: Sequence[Rows], replay: Replay, generator: torch.Generator
    ) -> list[Rows]:
        """The same number of rows of each remembered scene."""
        each = replayed_rows(self.options, len(replay.buffers)) // len(replay.buffers)
        if replay.choose_views is None:
            return [buffer.draw(each, generator) for buffer in replay.buffers]
        if self.step % CHOICE_STEPS == 0 or not self._replayed_views:
            rate = one_cycle(self.options, self.step)
            self._replayed_views = [
                replay.choose_views(self.head, join(fresh), buffer, rate, generator)
                for buffer in replay.buffers
            ]
        rows = []
        for buffer, views in zip(replay.buffers, self._replayed_views, strict=True):
            where = torch.nonzero(torch.isin(buffer.tensors["view"], views))[:, 0]
            drawn = torch.randint(len(where), (each,), generator=generator)
            rows.append(buffer.rows(where[drawn]))
        return rows

    def _backward(self, loss: Tensor, output: HeadOutput, rows: Rows, fresh: int) -> None:
        """Leaves in `.grad` the gradients of `loss`, on `fresh` rows, and of replaying the rest."""
        replay, progress = self.replay, self.step / self.options.iterations
        if replay is not None and replay.combine is not None:
            each = (len(rows.scene) - fresh) // len(replay.buffers)
            slices = [slice(i, i + each) for i in range(fresh, len(rows.scene), each)]
            old_costs = [replay.penalty(output.part(s), rows.part(s), progress) for s in slices]
            self._join_gradients(loss, old_costs, replay)
            return
        if replay is not None:
            old = slice(fresh, None)
            cost_of_old = replay.penalty(output.part(old), rows.part(old), progress)
            loss = loss + (len(replay.buffers) if replay.per_scene else 1) * cost_of_old
        loss.backward()
        every = [*self.head.parameters(), self.correction]
        average(parameter.grad for parameter in every if parameter.grad is not None)

    def _join_gradients(self, loss: Tensor, old: Sequence[Tensor], replay: Replay) -> None:
        """Leaves in `.grad` what the rule makes of the gradients of new and remembered rows."""
        assert replay.combine is not None
        parameters = list(self.head.parameters())

        def flat(cost: Tensor, more: Sequence[Tensor] = ()) -> tuple[Tensor, tuple[Tensor, ...]]:
            found = torch.autograd.grad(
                cost, [*parameters, *more], retain_graph=True, materialize_grads=True
            )
            own, rest = found[: len(parameters)], found[len(parameters) :]
            return torch.cat([part.flatten() for part in own]), rest

        new, (correction,) = flat(loss, [self.correction])
        memory = torch.stack([flat(cost)[0] for cost in old])
        losses = torch.stack([cost.detach() for cost in old])
        average([new, correction, memory, losses])  # before they join: rules are not linear
        references = torch.full_like(losses, torch.nan)
        if replay.references is not None:
            references = replay.references
        before = torch.full_like(losses, torch.nan) if self._losses is None else self._losses
        joined = replay.combine(Gradients(new, memory, losses, references, before, self.step))
        self._losses = losses
        self.correction.grad = correction
        start = 0
        for parameter in parameters:
            end = start + parameter.numel()
            parameter.grad = joined[start:end].view_as(parameter)
            start = end

    def state(self) -> dict[str, Tensor]:
        """What `load` needs to go on from here, as named tensors."""
        state = {f"head.{k}": v for k, v in self.head.state_dict().items()}
        state["correction"] = self.correction.detach()
        state |= {f"replayed_views.{i}": views for i, views in enumerate(self._replayed_views)}
        if self._losses is not None:
            state["losses"] = self._losses
        for which, optimiser in enumerate(self._optimisers):
            for i, slots in optimiser.state_dict()["state"].items():
                state |= {f"optimiser.{which}.{i}.{name}": v for name, v in slots.items()}
        # Copies: training goes on while someone may be writing them.
        return {k: v.clone() for k, v in state.items()} | {"step": torch.tensor(self.step)}

    def load(self, state: dict[str, Tensor]) -> None:
        """Goes back to where `state()` was taken; the head must have the same shape."""
        self.step = int(state["step"])
        head = {k.removeprefix("head."): v for k, v in state.items() if k.startswith("head.")}
        self.head.load_state_dict(head)
        self.correction.data.copy_(state["correction"])
        count = sum(key.startswith("replayed_views.") for key in state)
        self._replayed_views = [state[f"replayed_views.{i}"] for i in range(count)]
        self._losses = state.get("losses")
        for which, optimiser in enumerate(self._optimisers):
            slots: dict[int, dict[str, Tensor]] = {}
            prefix = f"optimiser.{which}."
            for key, value in state.items():
                if key.startswith(prefix):
                    i, name = key.removeprefix(prefix).split(".")
                    slots.setdefault(int(i), {})[name] = value
            groups = optimiser.state_dict()["param_groups"]
            optimiser.load_state_dict({"state": slots, "param_groups": groups})


def replayed_rows(options: FitOptions, scenes: int) -> int:
    """Rows that a step replays from all remembered scenes together, at least one of each.

    One or two scenes share `replay_batch` and each further one brings half as many, up to four
    times the batch.
    """
    shares = min(max(2, scenes), 8)
    return max(scenes, shares * options.replay_batch // 2)


def one_cycle(options: FitOptions, step: int) -> float:
    """Learning rate of a step: cosine from 1/25 of the peak to the peak, then cosine to zero.

    The shape of torch's OneCycleLR, as a function of the step alone so that nothing need be saved.
    """
    rise = max(1.0, options.warm_share * options.iterations)
    if step < rise:
        low, high, share = options.peak_rate / 25, options.peak_rate, 1 - step / rise
    else:
        low, high = 0.0, options.peak_rate
        share = (step - rise) / max(1.0, options.iterations - rise)
    return low + (high - low) * 0.5 * (1 + math.cos(math.pi * share))
