"""The loop that fits a head to rows of scenes; whatever else is wanted comes in as hooks."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from evercal.continual.networks.buffer import FeatureBuffer, Rows, diffused, join, own_share
from evercal.continual.networks.distributed import average, broadcast, processes
from evercal.continual.networks.head import Head
from evercal.continual.networks.hooks import ProposedStep, TrainingHooks
from evercal.continual.networks.loss import LossOptions, clamp_px, reprojection_loss
from evercal.continual.networks.muon import Muon
from evercal.features.device import allow_tf32
from evercal.features.precision import autocast

INLIER_PX = 5.0
# While points are still far off, their errors say nothing about the lens.
CORRECTION_FROM_PX = 20.0


@dataclass(frozen=True)
class FitOptions:
    """One stage of training."""

    iterations: int = 4000
    """Optimiser steps."""
    batch: int = 2048
    """Rows of the scenes being learned in a step."""
    replay_batch: int = 1024
    """Replayed rows in a step, drawn evenly from all remembered scenes."""
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

    def with_known_lens(self) -> "FitOptions":
        """The same for frames whose lens is known better than training could correct it."""
        return replace(self, intrinsics_rate=0.0)


@dataclass
class Progress:
    """Where training stands."""

    step: int
    """Steps done."""
    total: int
    """Steps of the stage."""
    costs: Tensor
    """(n,) loss of each row being learned at the last step."""
    errors_px: Tensor
    """(n,) reprojection error of each, pixels."""

    # Computed when asked for: a GPU would have to finish the step first.
    @property
    def loss(self) -> float:
        """Mean loss of the rows being learned at the last step."""
        return float(self.costs.mean())

    @property
    def inlier_share(self) -> float:
        """Share of the rows being learned within 5 px at the last step."""
        return float((self.errors_px < INLIER_PX).float().mean())


class HeadTrainer:
    """Trains `head` on `buffers`; can stop after any step and go on from `state()`.

    The rows of step k are a function of (seed, k), so a resumed run sees what an uninterrupted one
    would have seen.

    Args:
        head: trained in place, on the device where it lies and the buffers give their rows; all
            processes begin with the weights of the first.
        buffers: rows of the scenes being learned.
        options: how.
        seed: random seed.
        hooks: what a continual-learning method adds.
    """

    def __init__(
        self,
        head: Head,
        buffers: Sequence[FeatureBuffer],
        options: FitOptions,
        seed: int,
        hooks: TrainingHooks | None = None,
    ):
        self.head, self.buffers = head, buffers
        self.options, self.seed, self.step = options, seed, 0
        self.hooks = TrainingHooks() if hooks is None else hooks
        self.device = head.device
        allow_tf32(self.device)
        broadcast([*head.parameters(), *head.buffers()])
        self.correction = torch.nn.Parameter(torch.zeros(len(buffers), 5, device=self.device))
        correctable = [[float(buffer.correctable)] for buffer in buffers]
        self._correctable = torch.tensor(correctable, device=self.device)
        self._optimisers = _optimisers(head, self.correction, options)

    def run(self) -> Iterator[Progress]:
        """Trains to the end, yielding after every step."""
        self.head.train()
        while self.step < self.options.iterations:
            yield self._train_step()
        self.head.eval()

    def _train_step(self) -> Progress:
        options, rate = self.options, one_cycle(self.options, self.step)
        rows, fresh = self._rows(rate)
        for optimiser in self._optimisers:
            for group in optimiser.param_groups:
                group["lr"] = rate * group["share"]
            optimiser.zero_grad()
        # One scene for all rows is a plain bias, a scene per row another product in every layer.
        alone = len(self.buffers) == 1 and fresh == len(rows.scene)
        scene = self.buffers[0].scene if alone else rows.scene
        with autocast(self.device):
            output = self.head(rows.features.float(), scene, rows.descriptor)
        tau_px = clamp_px(options.loss, self.step / options.iterations)
        costs, errors = self._fresh_costs(output.points[:fresh], rows.part(slice(0, fresh)), tau_px)
        loss = costs.mean()
        held, remembered = output.part(slice(fresh, None)), rows.part(slice(fresh, None))
        more = [self.hooks.regularizer()]
        if fresh < len(rows.scene):
            more.append(self.hooks.cost(held, remembered, tau_px))
        for cost in more:
            loss = loss if cost is None else loss + cost
        losses = self.hooks.constraints(held, remembered)
        constraints = [self._gradients(one) for one in losses]
        loss.backward()
        every = [*self.head.parameters(), self.correction]
        average([parameter.grad for parameter in every if parameter.grad is not None])
        average([gradient for constraint in constraints for gradient in constraint.values()])
        self._take_step(losses, constraints, rate / options.peak_rate)
        self.step += 1
        return Progress(self.step, options.iterations, costs.detach(), errors)

    def _rows(self, rate: float) -> tuple[Rows, int]:
        """The rows of this step that this process trains on, and how many of them are new."""
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + self.step)
        share = self.options.batch // len(self.buffers)
        parts = [buffer.draw(share, generator) for buffer in self.buffers]
        fresh = len(parts)
        parts += self.hooks.replayed(join(parts), self.step, rate, generator)
        if self.head.options.condition == "descriptor":
            # Drawn where the rows lie, and for all processes' rows alike.
            seed = int(torch.randint(2**62, (), generator=generator, device="cpu"))
            noise = torch.Generator(self.device).manual_seed(seed)
            parts = [diffused(part, self.options.diffusion, noise) for part in parts]
        return join([own_share(part) for part in parts]), fresh * (share // processes())

    def _fresh_costs(self, points: Tensor, rows: Rows, tau_px: float) -> tuple[Tensor, Tensor]:
        """Loss and error in pixels of the rows being learned."""
        options = self.options
        correction = None
        if options.intrinsics_rate > 0 and tau_px < CORRECTION_FROM_PX:
            share = len(points) // len(self.buffers)
            correction = (self.correction * self._correctable).repeat_interleave(share, 0)
        return reprojection_loss(points, rows.target, tau_px, options.loss, correction)

    def _gradients(self, loss: Tensor) -> dict[str, Tensor]:
        """Gradient of a loss by every weight of the head; the graph stays."""
        named = dict(self.head.named_parameters())
        found = torch.autograd.grad(
            loss, list(named.values()), retain_graph=True, materialize_grads=True
        )
        return dict(zip(named, found, strict=True))

    def _take_step(
        self, losses: Sequence[Tensor], constraints: list[dict[str, Tensor]], schedule: float
    ) -> None:
        """Lets the optimisers step, and a hook change what they did."""
        named = dict(self.head.named_parameters())
        before = {}
        if self.hooks.edits_steps:
            before = {name: value.detach().clone() for name, value in named.items()}
        for optimiser in self._optimisers:
            optimiser.step()
        if not before:
            return
        with torch.no_grad():
            found = (
                torch.stack([loss.detach() for loss in losses])
                if losses
                else self.correction[:0, 0]
            )
            average([found])
            changes = {name: value - before[name] for name, value in named.items()}
            gradients = {
                k: torch.zeros_like(v) if v.grad is None else v.grad for k, v in named.items()
            }
            self.hooks.edit_step(
                ProposedStep(changes, gradients, found, constraints, self.step, schedule)
            )
            for name, value in named.items():
                value.copy_(before[name] + changes[name])

    def state(self) -> dict[str, Tensor]:
        """What `load` needs to go on from here, as named tensors."""
        state = {f"head.{k}": v for k, v in self.head.state_dict().items()}
        state["correction"] = self.correction.detach()
        state |= {f"hooks.{k}": v for k, v in self.hooks.state().items()}
        for which, optimiser in enumerate(self._optimisers):
            for i, slots in optimiser.state_dict()["state"].items():
                state |= {f"optimiser.{which}.{i}.{name}": v for name, v in slots.items()}
        # Copies: training goes on while someone may be writing them.
        copies = {k: v.detach().cpu().clone() for k, v in state.items()}
        return copies | {"step": torch.tensor(self.step, device="cpu")}

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Goes back to where `state()` was taken; the head must have the same shape."""
        self.step = int(state["step"])
        self.head.load_state_dict(_under("head.", state))
        self.correction.data.copy_(state["correction"])
        self.hooks.load(_under("hooks.", state))
        for which, optimiser in enumerate(self._optimisers):
            slots: dict[int, dict[str, Tensor]] = {}
            for key, value in _under(f"optimiser.{which}.", state).items():
                i, name = key.split(".")
                slots.setdefault(int(i), {})[name] = value
            groups = optimiser.state_dict()["param_groups"]
            optimiser.load_state_dict({"state": slots, "param_groups": groups})


def _under(prefix: str, state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors whose names begin with a prefix, without it."""
    return {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}


def _optimisers(
    head: Head, correction: torch.nn.Parameter, options: FitOptions
) -> list[torch.optim.Optimizer]:
    """AdamW, and Muon for the hidden matrices where it has a rate."""
    hidden, decay, plain = [], [], []
    for name, parameter in head.named_parameters():
        if name.startswith(("code", "logit")):
            plain.append(parameter)
        elif options.muon_rate > 0 and parameter.shape == (head.options.width,) * 2:
            hidden.append(parameter)
        else:
            decay.append(parameter)
    rate, weight_decay = options.peak_rate, options.weight_decay
    groups = [
        {"params": decay, "share": 1.0},
        {"params": plain, "share": 1.0, "weight_decay": 0.0},
        {"params": [correction], "share": options.intrinsics_rate, "weight_decay": 0.0},
    ]
    adamw = torch.optim.AdamW(groups, lr=rate, weight_decay=weight_decay, fused=True)
    if not hidden:
        return [adamw]
    matrices = [{"params": hidden, "share": options.muon_rate / rate}]
    return [adamw, Muon(matrices, rate, weight_decay)]


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
