"""The ablation of the paper (Table 4), and a grid of selectors and penalties."""

from collections.abc import Mapping, Sequence

import numpy as np

from evercal.continual.benchmark.comparison import Run, TableRows, by_strategy, difference
from evercal.continual.methods.method import described
from evercal.continual.methods.replay import Replay
from evercal.continual.selection.selectors import SELECTORS
from evercal.continual.strategies import STRATEGIES

ABLATIONS: dict[str, tuple[tuple[str, str], ...]] = {
    "as printed": (
        ("iCaRL", "icarl"),
        ("+ SARS", "sars_old_output"),
        ("+ SARS + SPDD", "sars_spdd"),
    ),
    "one change at a time": (
        ("random, reprojection", "er"),
        ("SARS, reprojection", "sars_reprojection"),
        ("SARS, SPDD", "sars_spdd"),
    ),
    "the penalty first": (
        ("random, reprojection", "er"),
        ("random, SPDD", "reservoir_spdd"),
        ("SARS, SPDD", "sars_spdd"),
    ),
}
"""Rows of Table 4 and their strategies.

As printed, the first step changes the selector and keeps iCaRL's penalty, which uses true poses.
The second step replaces it by a penalty without true poses.
"""

PUBLISHED = {"i7s": (65.2, 72.0, 74.9), "i12s": (66.0, 90.9, 91.8)}
"""Final accuracies of the rows as printed, by suite (Li et al., arXiv 2604.15814, Table 4)."""


def ablation_rows(runs: Sequence[Run], suite: str = "") -> TableRows:
    """Tabulate Table 4: final accuracy, and the gain of each step with its 95 % interval.

    Args:
        runs: Complete runs. Steps that were not run are left out.
        suite: Name of the suite. Published numbers are added if the paper has them.

    Returns:
        The header alone if fewer than two steps of every ablation were run.
    """
    grouped, published = by_strategy(runs), PUBLISHED.get(suite)
    header = ["ablation", "", "final %", "step", "95 %", *(["published %"] if published else [])]
    rows = [header]
    for title, steps in ABLATIONS.items():
        if sum(name in grouped for _, name in steps) < 2:
            continue
        before: list[Run] = []
        for i, (label, name) in enumerate(steps):
            group = grouped.get(name, [])
            if group:
                final = np.mean([run.scores().final_accuracy for run in group])
                row = [title, label, f"{final:.1f}", *_step(group, before)]
                if published:
                    row.append(f"{published[i]:.1f}" if title == "as printed" else "")
                rows.append(row)
            before = group
    return rows


def _step(runs: Sequence[Run], before: Sequence[Run]) -> list[str]:
    step = difference(runs, before)
    if step is None:
        return ["", ""]
    return [f"{100 * step.mean:+.1f}", f"{100 * step.low:+.1f} {100 * step.high:+.1f}"]


def grid_rows(runs: Sequence[Run]) -> TableRows:
    """Tabulate final accuracy and TFR, a row per selector and a column per penalty.

    Only strategies that are replay with default weights take part.

    Returns:
        The header alone unless two selectors and two penalties were run.
    """
    groups = {_parts(group[0]): group for group in reversed(by_strategy(runs).values())}
    cells = {parts: _accuracy_and_forgetting(group) for parts, group in groups.items() if parts}
    selectors = [name for name in SELECTORS if any(s == name for s, _ in cells)]
    penalties = sorted({penalty for _, penalty in cells})
    header = ["frames \\ cost", *penalties]
    if len(selectors) < 2 or len(penalties) < 2:
        return [header]
    return [header, *([s, *(cells.get((s, p), "") for p in penalties)] for s in selectors)]


def _accuracy_and_forgetting(runs: Sequence[Run]) -> str:
    scores = [run.scores() for run in runs]
    final = np.mean([score.final_accuracy for score in scores])
    return f"{final:.1f} ({np.mean([score.total_forgetting for score in scores]):.1f})"


def _parts(run: Run) -> tuple[str, str] | None:
    """Return selector and penalty of a strategy that is replay with default weights."""
    method = run.description.get("method")
    if not isinstance(method, Mapping) or method["kind"] != "Replay" or run.description["map"]:
        return None
    for strategy in STRATEGIES.values():
        if type(strategy.method) is not Replay:
            continue
        default = described(strategy.method) | {"selector": method["selector"]}
        penalty = default["penalty"]
        assert isinstance(penalty, Mapping)
        # The first strategy with a penalty defines its default weight.
        if penalty["kind"] == method["penalty"]["kind"]:
            return (str(method["selector"]), str(penalty["kind"])) if default == method else None
    return None
