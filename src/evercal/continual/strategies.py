"""Strategies: small records of functions, and the literal dict that names them all."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from torch import Tensor

from evercal.continual.frame_statistics import FrameStatistics
from evercal.continual.method_state import (
    FinishedScene,
    MethodState,
    after_scene_fisher,
    after_scene_fisher_online,
    after_scene_points,
    after_scene_reference,
    ewc_online_penalty,
    ewc_penalty,
)
from evercal.continual.methods.gradient_constraints import (
    averaged_constraint,
    episodic_barrier,
    gem,
    moving_barrier,
)
from evercal.continual.methods.penalties import (
    Penalty,
    anchored_reprojection,
    bounded_by_teacher,
    fixed_clamp_reprojection,
    old_output,
    relations,
    reprojection,
    spdd,
    stored_output,
)
from evercal.continual.selection_by_features import (
    select_coverage,
    select_gradients,
    select_herding,
    select_hybrid,
    select_leverage,
    select_reservoir,
)
from evercal.errors import InputError
from evercal.mapping.selection import SarsOptions, select_sars
from evercal.networks.gradients import Combine
from evercal.networks.head import Head

Select = Callable[[FrameStatistics, int], np.ndarray]
"""Which frames stay: (frames of a finished scene, capacity) -> indices in recorded order."""


@dataclass(frozen=True)
class Strategy:
    """How scenes that come one after another share a network."""

    source: str
    """Where the rule comes from."""
    select: Select | None = None
    """Which frames of a finished scene are remembered; None keeps none."""
    penalty: Penalty | None = None
    """What replayed rows cost."""
    strength: float = 1.0
    """What `penalty` and `regularizer` are multiplied by."""
    penalty_per_scene: bool = False
    """Whether every remembered scene costs that much, or (the paper) all of them together: then a
    scene counts less with every one that follows."""
    data: Literal["stage", "all"] = "stage"
    """Train on the new scene, or on every frame of every scene from scratch."""
    heads: Literal["one", "per_scene"] = "one"
    """One head for all scenes, or one each."""
    preconditioning: float = 0.0
    """How strongly updates of shared matrices spare the directions that each remembered scene uses
    (`continual.methods.preconditioning`)."""
    combine: Combine | None = None
    """How gradients of remembered scenes join that of the new one; None adds them up."""
    mir: bool = False
    """Whether those views are replayed that the new rows are about to spoil most."""
    build_map: bool = False
    """Whether the keyframes become a map with landmarks, which answers beside the network."""
    network: bool = True
    """Whether a network is trained at all; without one the map alone answers."""
    after_scene: Callable[[FinishedScene], dict[str, Tensor]] | None = None
    """What is kept of a finished scene beside its keyframes."""
    regularizer: Callable[[Head, Sequence[MethodState]], Tensor] | None = None
    """What the weights cost, given the states of all earlier scenes."""


PRECONDITIONING = 0.5
WEIGHTS: dict[Penalty, float] = {reprojection: 0.3, old_output: 0.3, relations: 0.3}
"""Strengths that did best on held-out frames, of three tried for every penalty (docs/results.md);
1 for all others."""


def _sars(frames: FrameStatistics, capacity: int) -> np.ndarray:
    return select_sars(frames.positions_m, frames.quaternions_wxyz, capacity, SarsOptions())


def _sars_filled(frames: FrameStatistics, capacity: int) -> np.ndarray:
    fill = SarsOptions(fill=True)
    return select_sars(frames.positions_m, frames.quaternions_wxyz, capacity, fill)


def _reservoir(frames: FrameStatistics, capacity: int) -> np.ndarray:
    return select_reservoir(len(frames), capacity, frames.rng())


def _hybrid(frames: FrameStatistics, capacity: int) -> np.ndarray:
    return select_hybrid(frames.features(), capacity, frames.rng())


def _herding(frames: FrameStatistics, capacity: int) -> np.ndarray:
    return select_herding(frames.features(), capacity)


def _leverage(frames: FrameStatistics, capacity: int) -> np.ndarray:
    return select_leverage(frames.features(), capacity, frames.rng())


def _coverage(frames: FrameStatistics, capacity: int) -> np.ndarray:
    return select_coverage(frames.visible_parts(), capacity, frames.rng())


def _coverage_redundant(frames: FrameStatistics, capacity: int) -> np.ndarray:
    return select_coverage(frames.visible_parts(), capacity, frames.rng(), "redundant")


def _gradients(frames: FrameStatistics, capacity: int) -> np.ndarray:
    return select_gradients(frames.gradients(), capacity, frames.rng())


_NETWORK = Strategy(
    source="this project: scene codes, own centres, anchored replay, preconditioning; no map",
    select=_sars_filled,
    penalty=anchored_reprojection,
    penalty_per_scene=True,
    preconditioning=PRECONDITIONING,
)

STRATEGIES: dict[str, Strategy] = {
    "evercal": Strategy(
        source="this project: a map of keyframes and sub-pixel landmarks, nothing trained",
        select=_sars_filled,
        build_map=True,
        network=False,
    ),
    "evercal_hybrid": replace(
        _NETWORK, source="this project: the map and the network of evercal_network", build_map=True
    ),
    "finetune": Strategy(source="control: the head and steps of evercal, no replay"),
    "evercal_network": _NETWORK,
    "er": Strategy(
        source="experience replay from a reservoir (Vitter, 1985): random frames, true poses",
        select=_reservoir,
        penalty=reprojection,
        strength=WEIGHTS[reprojection],
    ),
    "hybrid": Strategy(
        source="Bahadir et al., continual hand-eye calibration, Mach. Vis. Appl. 2024 (abstract)",
        select=_hybrid,
        penalty=reprojection,
        strength=WEIGHTS[reprojection],
    ),
    "icarl": Strategy(
        source="Rebuffi et al., iCaRL, CVPR 2017, ported to points",
        select=_herding,
        penalty=old_output,
        strength=WEIGHTS[old_output],
    ),
    "buff_cs": Strategy(
        source="Wang et al., Continual Learning for Image-Based Camera Localization, ICCV 2021",
        select=_coverage,
        penalty=bounded_by_teacher,
    ),
    "gdr": Strategy(
        source="Qi et al., FedCBDR's global-perspective data replay, NeurIPS 2025",
        select=_leverage,
        penalty=reprojection,
        strength=WEIGHTS[reprojection],
    ),
    "gss": Strategy(
        source="Aljundi et al., Gradient based sample selection, NeurIPS 2019",
        select=_gradients,
        penalty=reprojection,
        strength=WEIGHTS[reprojection],
    ),
    "mir": Strategy(
        source="Aljundi et al., Maximally interfered retrieval, NeurIPS 2019",
        select=_reservoir,
        penalty=reprojection,
        strength=WEIGHTS[reprojection],
        mir=True,
    ),
    "der": Strategy(
        source="Buzzega et al., Dark experience (DER++), NeurIPS 2020, ported to points",
        select=_reservoir,
        penalty=stored_output,
        after_scene=after_scene_points,
    ),
    "co2l": Strategy(
        source="Cha et al., Co2L's relation distillation, ICCV 2021, ported to points",
        select=_reservoir,
        penalty=relations,
        strength=WEIGHTS[relations],
    ),
    "agem": Strategy(
        source="Chaudhry et al., Efficient lifelong learning with A-GEM, ICLR 2019",
        select=_reservoir,
        penalty=fixed_clamp_reprojection,
        combine=averaged_constraint,
    ),
    "gem": Strategy(
        source="Lopez-Paz and Ranzato, Gradient episodic memory, NeurIPS 2017",
        select=_reservoir,
        penalty=fixed_clamp_reprojection,
        combine=gem,
    ),
    "gec": Strategy(
        source="Lai et al., GEC, NeurIPS 2025, several constraints",
        select=_reservoir,
        penalty=fixed_clamp_reprojection,
        combine=episodic_barrier,
        after_scene=after_scene_reference,
    ),
    "gec_moving": Strategy(
        source="the same with the references of its Algorithm 1, the losses of the step before",
        select=_reservoir,
        penalty=fixed_clamp_reprojection,
        combine=moving_barrier,
    ),
    "ewc": Strategy(
        source="Kirkpatrick et al., Elastic weight consolidation, PNAS 2017, a term per scene",
        after_scene=after_scene_fisher,
        regularizer=ewc_penalty,
    ),
    "ewc_online": Strategy(
        source="Schwarz et al., Progress and compress, ICML 2018, one running term",
        after_scene=after_scene_fisher_online,
        regularizer=ewc_online_penalty,
    ),
    "sars_spdd": Strategy(
        source="Li et al., Continual Hand-Eye Calibration, arXiv 2604.15814, Algorithms 1 and 2",
        select=_sars,
        penalty=spdd,
    ),
    "sars_spdd_filled": Strategy(
        source="the same with the largest radius that fills the memory",
        select=_sars_filled,
        penalty=spdd,
    ),
    "isolation": Strategy(
        source="after ESAC (Brachmann, Rother, ICCV 2019): an expert per scene behind a gate",
        heads="per_scene",
    ),
    "joint": Strategy(source="all frames of all scenes at once, restarted", data="all"),
    "joint_recall": Strategy(
        source="the same with the memory of evercal: what evercal could reach",
        select=_sars_filled,
        data="all",
        build_map=True,
    ),
}

SELECTORS: dict[str, Select] = {
    "reservoir": _reservoir,
    "hybrid": _hybrid,
    "herding": _herding,
    "coverage": _coverage,
    "coverage_redundant": _coverage_redundant,
    "leverage": _leverage,
    "gradients": _gradients,
    "sars": _sars,
    "sars_filled": _sars_filled,
}
"""Which frames stay, for `compose`."""

PENALTIES: dict[str, Penalty] = {
    "reprojection": reprojection,
    "old_output": old_output,
    "bounded": bounded_by_teacher,
    "relations": relations,
    "anchored": anchored_reprojection,
    "spdd": spdd,
}
"""What replay costs, for `compose`."""


def compose(name: str) -> Strategy:
    """A strategy made of others by its name, from now on one of STRATEGIES.

    Args:
        name: `SELECTOR+PENALTY`, the same with `+recall`, or a strategy and by how much its
            penalty and regularizer are to weigh more: `icarl@0.3`.

    Raises:
        InputError: any other name that is not known yet.
    """
    if name in STRATEGIES:
        return STRATEGIES[name]
    plain, weighed, factor = name.rpartition("@")
    if weighed and re.fullmatch(r"\d*\.?\d+", factor):
        rule = compose(plain)
        source = f"{rule.source}, weighing {factor} times as much"
        return STRATEGIES.setdefault(
            name, replace(rule, source=source, strength=rule.strength * float(factor))
        )
    selector, penalty, *more = [*name.split("+"), ""][:4]
    if selector not in SELECTORS or penalty not in PENALTIES or more not in ([""], ["recall", ""]):
        raise InputError(
            f"strategy {name!r}: unknown; choose from {', '.join(STRATEGIES)}, or SELECTOR+PENALTY "
            f"(+recall) of {', '.join(SELECTORS)} and {', '.join(PENALTIES)}, or one of these and "
            "its weight as in er@0.3"
        )
    source = f"composed: {selector} selects, replay costs {penalty}"
    cost = PENALTIES[penalty]
    made = Strategy(
        source, SELECTORS[selector], cost, WEIGHTS.get(cost, 1.0), build_map="recall" in more
    )
    return STRATEGIES.setdefault(name, made)
