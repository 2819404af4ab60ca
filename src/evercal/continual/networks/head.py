"""The scene-coordinate head: a feature vector in, a point of the scene out.

After GLACE (Wang et al., CVPR 2024): residual MLP, cluster centres chosen by a softmax, and an
offset in homogeneous form. Scenes may be told apart in two ways (`HeadOptions.condition`):

- `descriptor`: the image's global descriptor is part of the input, as in GLACE. Nothing but the
  image decides which centres answer.
- `code`: every layer gets a learned bias of the scene (its code), and only the scene's own centres
  answer. The caller says for which scene it asks; at test time that is a hypothesis drawn from the
  image's descriptor, and the hypothesis with most inliers wins.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, Self

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from evercal.errors import InputError

SCALE_MAX = 4.0
SCALE_MIN = 0.01
# Share of the way from plain features (0) to wholly decorrelated ones (1).
WHITENING = 0.5


@dataclass(frozen=True)
class HeadOptions:
    """Shape of a head."""

    width: int = 256
    """Channels of every hidden layer."""
    blocks: int = 1
    """Residual blocks of three layers after the first one."""
    condition: Literal["code", "descriptor"] = "code"
    """What tells scenes apart: a code per scene, or the image's global descriptor in the input."""
    offsets: Literal["shared", "per_centre"] = "per_centre"
    """One offset and scale for all centres (GLACE), or one for each centre (the paper)."""
    centres: Literal["grow", "fixed"] = "grow"
    """Where centres come from: each scene appends its own, or those of all scenes are there in
    advance (the paper; needs the future)."""
    centres_per_scene: int = 4
    """Cluster centres that a scene adds; of all scenes together where they are `fixed`."""
    whiten: bool = True
    """Features are centred, scaled and half decorrelated before the first layer. Without it they
    are scaled alone, and their few strong directions drown the many weak ones, which tell
    neighbouring points apart."""
    activation: Literal["gelu", "relu"] = "gelu"
    """Between layers; ACE and GLACE have `relu`."""


@dataclass
class HeadOutput:
    """What a head says about n rows, K centres (one scene's own where one was asked for)."""

    logits: Tensor
    """(n, K) fp32; -inf for centres that cannot answer."""
    offsets: Tensor
    """(n, K, 3) per centre or (n, 1, 3) shared, metres, already divided by the scale."""
    points: Tensor
    """(n, 3) fp32 scene coordinates in the atlas frame, metres."""
    hidden: Tensor
    """(n, width) fp32 activations of the last hidden layer."""

    def part(self, where: slice) -> "HeadOutput":
        """The rows of a slice."""
        parts = (self.logits, self.offsets, self.points, self.hidden)
        return HeadOutput(*(part[where] for part in parts))


class Head(nn.Module):
    """Residual MLP with growing outputs.

    Args:
        features: channels of the local feature.
        descriptor: channels of the global descriptor (used with condition `descriptor`).
        options: shape.

    Raises:
        InputError: condition `code` with centres that no scene owns.
    """

    centres: Tensor
    centre_scene: Tensor
    feature_mean: Tensor
    feature_map: Tensor

    def __init__(self, features: int, descriptor: int, options: HeadOptions):
        super().__init__()
        if options.condition == "code" and options.centres != "grow":
            raise InputError(
                f"centres {options.centres!r} belong to no scene, so condition 'code' has none to"
                " answer with; take condition 'descriptor' or centres 'grow'"
            )
        self.features, self.descriptor, self.options = features, descriptor, options
        width = options.width
        inputs = features + (descriptor if options.condition == "descriptor" else 0)
        self.first = nn.ModuleList([nn.Linear(inputs, width), *_linears(width, 2)])
        self.skip = nn.Identity() if inputs == width else nn.Linear(inputs, width)
        self.blocks = nn.ModuleList(_linears(width, 3) for _ in range(options.blocks))
        self.last = _linears(width, 2)
        # One bias per layer and scene; rows are appended by `grow`.
        self.code = nn.Parameter(torch.zeros(0, self.layers, width))
        self.logit = nn.Parameter(torch.zeros(0, width))
        self.logit_bias = nn.Parameter(torch.zeros(0))
        offsets = 0 if options.offsets == "per_centre" else 1
        self.offset = nn.Parameter(torch.zeros(offsets, 4, width))
        self.offset_bias = nn.Parameter(torch.zeros(offsets, 4))
        if offsets:
            nn.init.kaiming_uniform_(self.offset.data.view(4, width), a=math.sqrt(5))
        self.register_buffer("feature_mean", torch.zeros(features))
        self.register_buffer("feature_map", torch.eye(features))
        self.register_buffer("centres", torch.zeros(0, 3))
        self.register_buffer("centre_scene", torch.zeros(0, dtype=torch.long))

    @classmethod
    def from_state(
        cls, features: int, descriptor: int, options: HeadOptions, state: Mapping[str, Tensor]
    ) -> Self:
        """A head with the weights of another one's `state_dict()`, half floats or single."""
        head = cls(features, descriptor, options).to(state["code"].device)
        state = {name: v.float() if v.dtype == torch.half else v for name, v in state.items()}
        # These grow with every scene; whatever their shape is in the state, it is theirs.
        head.code = nn.Parameter(state["code"].clone())
        head.logit = nn.Parameter(state["logit"].clone())
        head.logit_bias = nn.Parameter(state["logit_bias"].clone())
        head.offset = nn.Parameter(state["offset"].clone())
        head.offset_bias = nn.Parameter(state["offset_bias"].clone())
        head.centres, head.centre_scene = state["centres"].clone(), state["centre_scene"].clone()
        head.load_state_dict(state)
        return head

    def without_scenes(self) -> "Head":
        """A copy of what scenes share, which knows none; centres that belong to none stay."""
        state = dict(self.state_dict())
        state["code"] = state["code"][:0]
        if self.options.centres == "grow":
            owned = ["logit", "logit_bias", "centres", "centre_scene"]
            owned += ["offset", "offset_bias"] if self.options.offsets == "per_centre" else []
            state |= {name: state[name][:0] for name in owned}
        return Head.from_state(self.features, self.descriptor, self.options, state)

    @property
    def layers(self) -> int:
        """Hidden layers, each with a row in a scene's code."""
        return 3 + 3 * self.options.blocks + 2

    @property
    def device(self) -> torch.device:
        """Where the weights lie."""
        return self.feature_mean.device

    @property
    def scenes(self) -> int:
        """How many scenes this head knows."""
        return self.code.shape[0]

    def whiten(self, features: Tensor) -> None:
        """Fits the input whitening; it stays as it is from then on, also for later scenes.

        With C = V diag(s^2) V' the covariance, an input becomes a (x - mean) V diag(s^-1/2) V',
        a such that the variance over all rows and channels is 1.

        Args:
            features: (n, features) rows of the first scene, n well above the number of channels;
                on any device.
        """
        features = features.double()
        mean = features.mean(0)
        centred = features - mean
        variance, axes = torch.linalg.eigh(centred.T @ centred / len(centred))
        spread = variance.clamp(min=0).sqrt()
        # Directions in which nothing varies must not be blown up.
        gain = (spread + 1e-3 * spread.max() + 1e-12) ** -WHITENING
        mapping = (axes * gain) @ axes.T
        mapping /= (centred @ mapping).std().clamp(min=1e-12)
        self.feature_mean.copy_(mean)
        self.feature_map.copy_(mapping)

    def grow(self, centres: Tensor, seed: int) -> None:
        """Makes room for one more scene; what the head says about others does not change.

        The new rows are drawn on the CPU, so that they are the same on every device.

        Args:
            centres: (k, 3) atlas coordinates of the new scene's centres, metres; k may be 0.
            seed: of the new rows.
        """
        generator = torch.Generator().manual_seed(seed)
        width, count = self.options.width, len(centres)

        def draw(*shape: int, scale: float) -> Tensor:
            return (torch.rand(*shape, generator=generator, device="cpu") * 2 - 1) * scale

        bound = 1 / math.sqrt(width)
        self.code = _append(self.code, draw(1, self.layers, width, scale=0.2))
        self.logit = _append(self.logit, draw(count, width, scale=bound))
        self.logit_bias = _append(self.logit_bias, self.logit_bias.new_zeros(count))
        if self.options.offsets == "per_centre":
            self.offset = _append(self.offset, draw(count, 4, width, scale=bound))
            self.offset_bias = _append(self.offset_bias, self.offset_bias.new_zeros(count, 4))
        scene = torch.full((count,), self.scenes - 1, device=self.device)
        self.centres = torch.cat([self.centres, centres.to(self.centres)])
        self.centre_scene = torch.cat([self.centre_scene, scene])

    def forward(
        self, features: Tensor, scene: Tensor | int, descriptor: Tensor | None
    ) -> HeadOutput:
        """Scene coordinates of feature rows.

        Args:
            features: (n, features).
            scene: (n,) index of the scene that each row is taken to show, or one for all.
            descriptor: (n, descriptor), or None with condition `code`.

        Returns:
            What the head says, in fp32, whatever autocast does inside.
        """
        hidden = self.hidden(features, scene, descriptor)
        with torch.autocast(hidden.device.type, enabled=False):
            return self.decode(hidden.float(), scene)

    def hidden(self, features: Tensor, scene: Tensor | int, descriptor: Tensor | None) -> Tensor:
        """Activations (n, width) of the last hidden layer; arguments as of `forward`."""
        if self.options.whiten:
            features = (features - self.feature_mean) @ self.feature_map
        else:
            # They have unit length, and layers are initialised for unit variance: left as they
            # are, biases drown them and the network takes several times as many steps.
            features = features * math.sqrt(self.features)
        if self.options.condition == "code":
            return self._trunk(features, self._codes(scene))
        assert descriptor is not None, "condition 'descriptor' needs the image descriptors"
        x = torch.cat([descriptor.to(features.dtype), features], dim=-1)
        return self._trunk(x, None)

    def _codes(self, scene: Tensor | int) -> Callable[[int], Tensor]:
        """The bias of a layer: (width,) for one scene, (n, width) for a scene per row."""
        if isinstance(scene, int):
            return lambda layer: self.code[scene, layer]
        # A product with one-hot rows instead of indexing: its gradient is a product too.
        one_hot = F.one_hot(scene, self.scenes).to(self.code.dtype)
        return lambda layer: one_hot @ self.code[:, layer]

    def _trunk(self, x: Tensor, code: Callable[[int], Tensor] | None) -> Tensor:
        number = iter(range(self.layers))
        activation = F.gelu if self.options.activation == "gelu" else F.relu

        def layer(linear: nn.Module, y: Tensor) -> Tensor:
            z, i = linear(y), next(number)
            return activation(z if code is None else z + code(i).to(z.dtype))

        y = x
        for linear in self.first:
            y = layer(linear, y)
        hidden = self.skip(x) + y
        for block in self.blocks:
            y = hidden
            for linear in block:  # pyright: ignore[reportGeneralTypeIssues]
                y = layer(linear, y)
            hidden = hidden + y
        for linear in self.last:
            hidden = layer(linear, hidden)
        return hidden

    def decode(self, hidden: Tensor, scene: Tensor | int) -> HeadOutput:
        """What the head says with these activations (n, width) of its last hidden layer, fp32."""
        coded = self.options.condition == "code"
        rows: slice | Tensor = slice(None)
        if coded and isinstance(scene, int):
            # Same shapes however many scenes follow, so not a bit of the answer changes with them.
            rows = torch.nonzero(self.centre_scene == scene)[:, 0]
        logits = F.linear(hidden, self.logit[rows], self.logit_bias[rows])
        if coded and not isinstance(scene, int):
            logits = logits.masked_fill(self.centre_scene != scene[:, None], -torch.inf)
        which = rows if self.options.offsets == "per_centre" else slice(None)
        offset, bias = self.offset[which].flatten(0, 1), self.offset_bias[which].flatten()
        raw = F.linear(hidden, offset, bias).unflatten(-1, (-1, 4))
        offsets = raw[..., :3] / homogeneous_scale(raw[..., 3:])
        share = logits.softmax(-1)
        points = (share.unsqueeze(-1) * (self.centres[rows] + offsets)).sum(1)
        return HeadOutput(logits, offsets, points, hidden)


def homogeneous_scale(raw: Tensor) -> Tensor:
    """The clamped softplus h of ACE and GLACE: raw 0 gives 1, the range is (1 / 4, 100].

    h = min(softplus_b(raw) + 1 / s_max, 1 / s_min), softplus_b(z) = ln(1 + e^(b z)) / b,
    b = ln 2 / (1 - 1 / s_max); so an offset is divided by at least 1/4 and at most 100.
    """
    beta = math.log(2.0) / (1.0 - 1.0 / SCALE_MAX)
    return (F.softplus(raw, beta=beta) + 1.0 / SCALE_MAX).clamp(max=1.0 / SCALE_MIN)


def _linears(width: int, count: int) -> nn.ModuleList:
    return nn.ModuleList(nn.Linear(width, width) for _ in range(count))


def _append(parameter: Tensor, rows: Tensor) -> nn.Parameter:
    return nn.Parameter(torch.cat([parameter.detach(), rows.to(parameter)]))
