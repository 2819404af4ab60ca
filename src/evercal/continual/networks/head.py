"""The scene-coordinate head maps a feature vector to a point of the scene.

After GLACE (Wang et al., CVPR 2024): a residual MLP, cluster centres weighted by a softmax, and an
offset in homogeneous form. `HeadOptions.condition` selects how scenes are distinguished:

- `descriptor`: the image's global descriptor is part of the input, as in GLACE. Every centre can
  answer for every image.
- `code`: every layer has a learned bias per scene (its code), and only the scene's own centres
  answer. The caller names the scene; at test time that is a hypothesis from the image's descriptor,
  and the hypothesis with most inliers wins.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from evercal.classes import frozen
from evercal.errors import InputError, require_numbers

SCALE_MAX = 4.0
"""GLACE's s_max: the reciprocal of the smallest homogeneous coordinate (no unit)."""
SCALE_MIN = 0.01
"""GLACE's s_min: the reciprocal of the largest homogeneous coordinate (no unit)."""
WHITENING = 0.5
"""Strength of the input whitening, from 0 (none) to 1 (fully decorrelated)."""
NEW_LOGIT = -10.0
"""Logit of a centre that joins the softmax of earlier scenes, before it is trained, relative to the
mean bias of these. A softmax depends on differences only."""
OWNED = ("code", "logit", "logit_bias", "offset", "offset_bias")
"""Parameters whose number of rows depends on the scenes."""


@frozen
class HeadOptions:
    """Architecture of a head."""

    width: int = 256
    """Channels of every hidden layer."""
    blocks: int = 1
    """Residual blocks of three layers after the first one."""
    condition: Literal["code", "descriptor"] = "code"
    """What distinguishes scenes: a code per scene, or the image's global descriptor."""
    offsets: Literal["shared", "per_centre"] = "per_centre"
    """One offset and scale for all centres (GLACE), or one for each centre (the paper)."""
    centres: Literal["grow", "fixed"] = "grow"
    """Each scene appends its own centres, or those of all scenes are given (the paper)."""
    centres_per_scene: int = 4
    """Cluster centres added per scene. With `fixed` centres, their total number."""
    whiten: bool = True
    """Centre, scale and half decorrelate the features, so that weak directions count; or scale."""
    activation: Literal["gelu", "relu"] = "gelu"
    """Activation between layers; ACE and GLACE use `relu`."""

    def __post_init__(self) -> None:
        """Check the numbers."""
        require_numbers(self, ("width", "centres_per_scene"), 1)
        require_numbers(self, ("blocks",), 0)


@dataclass
class HeadOutput:
    """Output for n rows and K centres; with a single scene, K counts its own centres."""

    logits: Tensor
    """(n, K) fp32; -inf for centres of other scenes."""
    offsets: Tensor
    """(n, K, 3) per centre or (n, 1, 3) shared, metres, already divided by the scale."""
    points: Tensor
    """(n, 3) fp32 scene coordinates in the atlas frame, metres."""
    hidden: Tensor
    """(n, width) fp32 activations of the last hidden layer."""

    def part(self, where: slice) -> "HeadOutput":
        """Return the rows of a slice."""
        return HeadOutput(*(value[where] for value in vars(self).values()))


class Head(nn.Module):
    """Residual MLP whose outputs grow with every scene.

    `features` and `descriptor` are the channels of the local feature and of the global descriptor,
    which is ignored with condition `code`.
    """

    centres: Tensor
    centre_scene: Tensor
    feature_mean: Tensor
    feature_map: Tensor

    def __init__(self, features: int, descriptor: int, options: HeadOptions):
        super().__init__()
        if options.condition == "code" and options.centres != "grow":
            raise InputError(
                f"centres {options.centres!r} belong to no scene, but condition 'code' needs"
                " centres of each scene; use condition 'descriptor' or centres 'grow'"
            )
        self.options = options
        width = options.width
        inputs = features
        if options.condition == "descriptor":
            inputs += descriptor
        self.first = nn.ModuleList([nn.Linear(inputs, width), *_linears(width, 2)])
        self.skip = nn.Identity()
        if inputs != width:
            self.skip = nn.Linear(inputs, width)
        self.blocks = nn.ModuleList(_linears(width, 3) for _ in range(options.blocks))
        self.last = _linears(width, 2)
        # One bias per layer and scene; `grow` appends rows.
        self.code = nn.Parameter(torch.zeros(0, self.layers, width))
        self.logit = nn.Parameter(torch.zeros(0, width))
        self.logit_bias = nn.Parameter(torch.zeros(0))
        shared = int(options.offsets == "shared")
        self.offset = nn.Parameter(torch.zeros(shared, 4, width))
        self.offset_bias = nn.Parameter(torch.zeros(shared, 4))
        if shared:
            nn.init.kaiming_uniform_(self.offset.data.view(4, width), a=math.sqrt(5))
        self.register_buffer("feature_mean", torch.zeros(features))
        self.register_buffer("feature_map", torch.eye(features))
        self.register_buffer("centres", torch.zeros(0, 3))
        self.register_buffer("centre_scene", torch.zeros(0, dtype=torch.long))
        # Scene s owns the centres from _owned[s] to _owned[s + 1]. Numbers, so that no step waits
        # for a GPU.
        self._owned = [0]

    @classmethod
    def from_state(
        cls,
        features: int,
        descriptor: int,
        options: HeadOptions,
        state: Mapping[str, Tensor],
    ) -> "Head":
        """Build a head from a `state_dict()` in half or single precision."""
        head = fresh_head(features, descriptor, options, seed=0)
        head.to(state["code"].device)
        for name in OWNED:
            setattr(head, name, nn.Parameter(state[name].float().clone()))
        head.centres = state["centres"].clone()
        head.centre_scene = state["centre_scene"].clone()
        head.load_state_dict(state)
        counts = torch.bincount(head.centre_scene, minlength=head.scenes)
        head._owned = [0, *counts.cumsum(0).tolist()]
        return head

    @property
    def features(self) -> int:
        """Channels of the local feature."""
        return len(self.feature_mean)

    @property
    def descriptor(self) -> int:
        """Channels of the global descriptor in the input; 0 with condition `code`."""
        return self.first[0].weight.shape[1] - self.features  # pyright: ignore

    @property
    def layers(self) -> int:
        """Hidden layers; a scene's code has one row for each."""
        return 3 + 3 * self.options.blocks + 2

    @property
    def device(self) -> torch.device:
        """Device of the weights."""
        return self.feature_mean.device

    @property
    def scenes(self) -> int:
        """Number of scenes."""
        return self.code.shape[0]

    def whiten(self, features: Tensor) -> None:
        """Fit the input whitening, which later scenes keep.

        With the covariance C = V diag(s^2) V', an input becomes a (x - mean) V diag(s^-1/2) V'. The
        factor a makes the variance over all rows and channels 1. The rows (n, features) are of the
        first scene; n must be well above the number of channels.
        """
        features = features.double()
        mean = features.mean(0)
        centred = features - mean
        covariance = centred.T @ centred / len(centred)
        variance, axes = torch.linalg.eigh(covariance)
        deviation = variance.clamp(min=0).sqrt()
        # The floor keeps constant directions from being amplified.
        floor = 1e-3 * deviation.max()
        gain = (deviation + floor + 1e-12) ** -WHITENING
        mapping = (axes * gain) @ axes.T
        mapping /= (centred @ mapping).std().clamp(min=1e-12)
        self.feature_mean.copy_(mean)
        self.feature_map.copy_(mapping)

    def grow(self, centres: Tensor, seed: int) -> None:
        """Add a scene with k >= 0 centres (k, 3) in the atlas, metres.

        Outputs for earlier scenes do not change: their softmax leaves new centres out (`code`), or
        gives them next to nothing (`descriptor`, see `NEW_LOGIT`). New rows are drawn on the CPU,
        so they are equal on every device.
        """
        generator = torch.Generator().manual_seed(seed)
        width = self.options.width
        count = len(centres)

        def draw(*shape: int, scale: float) -> Tensor:
            uniform = torch.rand(*shape, generator=generator, device="cpu")
            return (uniform * 2 - 1) * scale

        bound = 1 / math.sqrt(width)
        self.code = _append(self.code, draw(1, self.layers, width, scale=0.2))
        logit = draw(count, width, scale=bound)
        bias = torch.zeros(count)
        if self.options.condition == "descriptor" and len(self.centres):
            logit *= 0
            bias += self.logit_bias.detach().mean().cpu() + NEW_LOGIT
        self.logit = _append(self.logit, logit)
        self.logit_bias = _append(self.logit_bias, bias)
        if self.options.offsets == "per_centre":
            self.offset = _append(self.offset, draw(count, 4, width, scale=bound))
            self.offset_bias = _append(
                self.offset_bias, self.offset_bias.new_zeros(count, 4)
            )
        scene = torch.full((count,), self.scenes - 1, device=self.device)
        self.centres = torch.cat([self.centres, centres.to(self.centres)])
        self.centre_scene = torch.cat([self.centre_scene, scene])
        self._owned.append(len(self.centres))

    def forward(
        self, features: Tensor, scene: Tensor | int, descriptor: Tensor | None
    ) -> HeadOutput:
        """Predict the scene coordinates of feature rows (n, features), in fp32 under autocast, too.

        `scene` is the assumed one of all rows or (n,); condition `code` ignores the descriptors.
        """
        hidden = self.hidden(features, scene, descriptor)
        with torch.autocast(hidden.device.type, enabled=False):
            return self.decode(hidden.float(), scene)

    def hidden(
        self, features: Tensor, scene: Tensor | int, descriptor: Tensor | None
    ) -> Tensor:
        """Return the (n, width) activations of the last hidden layer; see `forward`."""
        if self.options.whiten:
            features = (features - self.feature_mean) @ self.feature_map
        else:
            # Features have unit length, but the initialisation assumes unit variance. Without
            # this factor biases dominate and training takes several times more steps.
            features = features * math.sqrt(self.features)
        if self.options.condition == "code":
            return self._trunk(features, self._add_code(scene))
        assert descriptor is not None, (
            "condition 'descriptor' needs the image descriptors"
        )
        x = torch.cat([descriptor.to(features.dtype), features], dim=-1)
        return self._trunk(x, lambda z, layer: z)

    def _add_code(self, scene: Tensor | int) -> Callable[[Tensor, int], Tensor]:
        """A function that adds the code of a layer to its output, in place."""
        if isinstance(scene, int):
            return lambda z, layer: z.add_(self.code[scene, layer].to(z.dtype))
        # A product with one-hot rows, because the gradient of indexing is slow.
        one_hot = F.one_hot(scene, self.scenes)

        def add(z: Tensor, layer: int) -> Tensor:
            codes = self.code[:, layer]
            return z.addmm_(one_hot.to(z.dtype), codes.to(z.dtype))

        return add

    def _trunk(self, x: Tensor, add_code: Callable[[Tensor, int], Tensor]) -> Tensor:
        number = iter(range(self.layers))
        activation = getattr(F, self.options.activation)

        def through(layers: nn.Module, y: Tensor) -> Tensor:
            for linear in layers.children():
                y = activation(add_code(linear(y), next(number)))
            return y

        hidden = self.skip(x) + through(self.first, x)
        for block in self.blocks:
            hidden = hidden + through(block, hidden)
        return through(self.last, hidden)

    def decode(self, hidden: Tensor, scene: Tensor | int) -> HeadOutput:
        """Compute the output from (n, width) activations of the last hidden layer, fp32."""
        all_rows = slice(None)
        rows = all_rows
        coded = self.options.condition == "code"
        if coded and isinstance(scene, int):
            # Shapes do not depend on later scenes, so the output stays equal to the last bit.
            rows = slice(*self._owned[scene : scene + 2])
        logits = F.linear(hidden, self.logit[rows], self.logit_bias[rows])
        if coded and not isinstance(scene, int):
            logits = logits.masked_fill(self.centre_scene != scene[:, None], -torch.inf)
        offset_rows = all_rows
        if self.options.offsets == "per_centre":
            offset_rows = rows
        weight = self.offset[offset_rows].flatten(0, 1)
        bias = self.offset_bias[offset_rows].flatten()
        homogeneous = F.linear(hidden, weight, bias).unflatten(-1, (-1, 4))
        scale = homogeneous_scale(homogeneous[..., 3:])
        offsets = homogeneous[..., :3] / scale
        candidates = self.centres[rows] + offsets
        share = logits.softmax(-1)
        points = (share.unsqueeze(-1) * candidates).sum(1)
        return HeadOutput(logits, offsets, points, hidden)


def fresh_head(features: int, descriptor: int, options: HeadOptions, seed: int) -> Head:
    """Create a head without scenes on the CPU; its weights depend only on the arguments.

    The state of torch's global generator is left unchanged.
    """
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        return Head(features, descriptor, options)


def homogeneous_scale(raw: Tensor) -> Tensor:
    """Compute the clamped softplus h of ACE and GLACE, in (1 / 4, 100], with h(0) = 1.

    h = min(softplus_b(raw) + 1 / s_max, 1 / s_min), softplus_b(z) = ln(1 + e^(b z)) / b,
    b = ln 2 / (1 - 1 / s_max).
    """
    lowest = 1.0 / SCALE_MAX
    beta = math.log(2.0) / (1.0 - lowest)
    scale = F.softplus(raw, beta=beta) + lowest
    return scale.clamp(max=1.0 / SCALE_MIN)


def _linears(width: int, count: int) -> nn.ModuleList:
    return nn.ModuleList(nn.Linear(width, width) for _ in range(count))


def _append(parameter: Tensor, rows: Tensor) -> nn.Parameter:
    return nn.Parameter(torch.cat([parameter.detach(), rows.to(parameter)]))
