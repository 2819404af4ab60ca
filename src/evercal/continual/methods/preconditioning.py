"""Weight updates that leave alone what remembered scenes use."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from evercal.networks.buffer import FeatureBuffer
from evercal.networks.head import Head
from evercal.networks.trainer import Precondition

ROWS = 8192
"""Of every remembered scene."""


def preconditioner(strength: float) -> Precondition | None:
    """For `Replay.precondition`: steps that spare remembered scenes; None with strength 0."""
    if strength == 0:
        return None

    def precondition(head: Head, buffers: Sequence[FeatureBuffer], seed: int):
        return GradientPreconditioning(head, buffers, strength, seed).damped

    return precondition


class GradientPreconditioning:
    """Holds what a remembered scene owns, and damps updates of what it shares where it looks.

    What belongs to one remembered scene alone (its code, logits and offsets) does not move: trained
    on a few frames, it would fit those and lose the others. The matrices are shared. Replay holds a
    scene where its few frames look; a matrix drifts in every other direction that the scene's
    images use, too. With C_s the second moment of a layer's inputs over replayed rows of scene s
    and c_s the mean of its diagonal, an update D of the matrix W becomes
    D (I + strength sum_s C_s / c_s)^-1: what W says about inputs of remembered scenes hardly moves,
    and directions that they leave free stay free for the new scene. The sum lets every scene count
    alike however many there are, as precisions add up in sequential Laplace approximations. A soft
    form of orthogonal weight modification (Zeng et al., Nature Machine Intelligence 2019) and
    gradient projection memory (Saha et al., ICLR 2021); nothing is stored for it, as C_s comes from
    the remembered frames.

    Args:
        head: as it is before the stage.
        buffers: rows of remembered scenes, one buffer each.
        strength: of a scene; 0 protects nothing.
        seed: of the rows that are looked at.
    """

    def __init__(self, head: Head, buffers: Sequence[FeatureBuffer], strength: float, seed: int):
        used: dict[nn.Linear, Tensor] = {}

        def look(layer: nn.Module, inputs: tuple[Tensor, ...], _: Tensor) -> None:
            assert isinstance(layer, nn.Linear)
            x = inputs[0].double()
            moment = x.T @ x
            scaled = moment / (moment.trace() / len(moment)).clamp(min=1e-12)
            used[layer] = used[layer] + scaled if layer in used else scaled

        scenes = torch.tensor([buffer.scene for buffer in buffers])
        own = torch.isin(head.centre_scene, scenes)
        held = [(head.code, scenes)]
        if head.options.offsets == "per_centre":
            owned = (head.logit, head.logit_bias, head.offset, head.offset_bias)
            held += [(parameter, torch.nonzero(own)[:, 0]) for parameter in owned]
        self._held = [(parameter, where, parameter.detach()[where]) for parameter, where in held]
        layers = [module for module in head.modules() if isinstance(module, nn.Linear)]
        hooks = [layer.register_forward_hook(look) for layer in layers]
        generator = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            for buffer in buffers:
                rows = buffer.draw(ROWS, generator)
                head(rows.features.float(), rows.scene, rows.descriptor)
        for hook in hooks:
            hook.remove()
        self._damping: list[tuple[Tensor, Tensor]] = []
        for layer, scaled in used.items():
            damping = torch.linalg.inv(torch.eye(len(scaled)).double() + strength * scaled)
            self._damping.append((layer.weight, damping.float()))

    @contextmanager
    def damped(self) -> Iterator[None]:
        """Whatever the body changes in the shared matrices is damped, and undone where held."""
        before = [weight.detach().clone() for weight, _ in self._damping]
        yield
        with torch.no_grad():
            for parameter, where, value in self._held:
                parameter[where] = value
            for (weight, damping), old in zip(self._damping, before, strict=True):
                weight.copy_(old + (weight - old) @ damping)
