"""The paper's Table 4 and the grid behind it: what which frames stay and what replay costs give."""

from collections.abc import Sequence

import numpy as np

from evercal.continual.benchmark.comparison import Run, TableRows, by_strategy, difference
from evercal.continual.methods.method import described
from evercal.continual.methods.replay import Replay
from evercal.continual.selectors import SELECTORS
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
"""Rows of Table 4 and their strategies. As printed, the first step changes the selector and keeps
iCaRL's penalty, the second changes the penalty from one with true poses to one without."""

PUBLISHED = {"i7s": (65.2, 72.0, 74.9), "i12s": (66.0, 90.9, 91.8)}
"""Of the rows as printed, by suite (Li et al., arXiv 2604.15814, Table 4)."""


def ablation_rows(runs: Sequence[Run], suite: str = "") -> TableRows:
    """Table 4: final accuracy and what each step gave, as far as its strategies were run.

    Args:
        runs: whose last stage is done.
        suite: its name; published numbers stand beside ours where the data are the same.

    Returns:
        A header alone where fewer than two steps of an ablation were run.
    """
    grouped, told = by_strategy(runs), PUBLISHED.get(suite)
    rows = [["ablation", "", "final %", "step", "95 %", *(["published %"] if told else [])]]
    for title, steps in ABLATIONS.items():
        if sum(name in grouped for _, name in steps) < 2:
            continue
        before: list[Run] = []
        for number, (what, name) in enumerate(steps):
            if name not in grouped:
                before = []
                continue
            now = grouped[name]
            final = float(np.mean([run.scores().final_accuracy for run in now]))
            step = difference(now, before) if before else None
            cells = ["", ""]
            if step is not None:
                cells = [f"{100 * step.mean:+.1f}", f"{100 * step.low:+.1f} {100 * step.high:+.1f}"]
            published = []
            if told:
                published = [f"{told[number]:.1f}" if title == "as printed" else ""]
            rows.append([title, what, f"{final:.1f}", *cells, *published])
            before = now
    return rows


def grid_rows(runs: Sequence[Run]) -> TableRows:
    """Final accuracy, a row per selector and a column per penalty; TFR in brackets.

    Strategies that are more than the two, or weigh the penalty otherwise, have no place in it.

    Returns:
        A header alone unless two selectors were run with two penalties at least.
    """
    cells: dict[tuple[str, str], list[Run]] = {}
    for of in by_strategy(runs).values():
        place = _place(of[0])
        if place is not None:
            cells.setdefault(place, of)
    selectors = [name for name in SELECTORS if any(s == name for s, _ in cells)]
    penalties = sorted({penalty for _, penalty in cells})
    rows = [["frames \\ cost", *penalties]]
    if len(selectors) < 2 or len(penalties) < 2:
        return rows
    for selector in selectors:
        row = [selector]
        for penalty in penalties:
            scores = [run.scores() for run in cells.get((selector, penalty), [])]
            final = np.mean([s.final_accuracy for s in scores]) if scores else 0.0
            lost = np.mean([s.total_forgetting for s in scores]) if scores else 0.0
            row.append(f"{final:.1f} ({lost:.1f})" if scores else "")
        rows.append(row)
    return rows


def _place(run: Run) -> tuple[str, str] | None:
    """Selector and penalty of a strategy that is replay of nothing but these two."""
    method = run.description.get("method")
    if not isinstance(method, dict) or method.get("kind") != "Replay" or run.description["map"]:
        return None
    penalty = method["penalty"]
    assert isinstance(penalty, dict)
    # The first strategy with a penalty tells how it is weighed; other weights are other rows.
    for strategy in STRATEGIES.values():
        if type(strategy.method) is not Replay:
            continue
        known = described(strategy.method) | {"selector": method["selector"]}
        if known["penalty"]["kind"] == penalty["kind"]:  # pyright: ignore[reportIndexIssue]
            return (str(method["selector"]), str(penalty["kind"])) if known == method else None
    return None
