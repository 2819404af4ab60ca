"""Variants of SARS + SPDD for `evercal bench SUITE --plugin examples/replay_ideas.py`.

Each fills the memory and changes the loss of replayed rows. Their rows on held-out frames are in
research/network-trials.md; the best one is the strategy `sars_pixels`.
"""

from evercal.continual.methods.penalties import (
    AnchoredReprojection,
    Distillation,
    OldOutput,
)
from evercal.continual.methods.replay import Replay
from evercal.continual.methods.spdd import SpddOptions
from evercal.continual.strategies import Strategy

POINTS_ALONE = Distillation(SpddOptions(prior_weight=0.0, metric_weight=0.0))
"""SPDD without its structural terms: old points alone."""
METHODS = {
    "filled_anchored": Replay("sars_filled", AnchoredReprojection()),
    "filled_old_output": Replay("sars_filled", OldOutput()),
    "filled_points": Replay("sars_filled", POINTS_ALONE, weight=10.0),
    "deviation_spdd": Replay("sars_deviation", Distillation(), weight=10.0),
}
STRATEGIES = {
    name: Strategy(name, method, source="this project, beyond arXiv 2604.15814")
    for name, method in METHODS.items()
}
