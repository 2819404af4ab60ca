r"""LaTeX tables in the layout of the paper: scenes down, strategies across (needs booktabs).

Published numbers are those of Li et al., "Continual Hand-Eye Calibration for Open-world Robotic
Manipulation", arXiv 2604.15814.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from evercal.continual.benchmark.comparison import Run, TableRows, by_strategy
from evercal.evaluation.metrics import COARSE, FINE

PUBLISHED: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "i7s": {
        "joint": (81.7, math.nan),
        "finetune": (1.1, math.nan),
        "icarl": (65.2, 11.37),
        "buff_cs": (66.1, 13.03),
        "gec": (26.5, 62.67),
        "gdr": (59.6, 12.25),
        "sars_spdd": (74.9, 6.65),
    },
    "i12s": {
        "joint": (96.9, math.nan),
        "finetune": (6.2, math.nan),
        "icarl": (66.0, 33.3),
        "buff_cs": (83.1, 15.7),
        "gec": (13.5, 88.9),
        "gdr": (78.7, 21.9),
        "sars_spdd": (91.8, 8.1),
    },
}
"""Published final accuracy and TFR in per cent, by suite and strategy."""


def paper_tables(runs: Sequence[Run], suite: str, ablation: TableRows | None) -> str:
    """Format `paper_table` and, if its strategies were run, the rows of `ablation_rows`."""
    if ablation is None:
        return paper_table(runs, suite)
    header, *rows = ablation
    table = _tabular(f"ll{'r' * (len(header) - 2)}", [header], [rows])
    return f"{paper_table(runs, suite)}\n\n{table}"


def paper_table(runs: Sequence[Run], suite: str) -> str:
    """Format final errors and accuracies, means over runs.

    Args:
        runs: Complete runs.
        suite: Name of the suite. Accuracy is at 1 cm and 1 deg for simulated suites, as in the
            paper, and at 5 cm and 5 deg for others.
    """
    grouped = by_strategy(runs)
    thresholds = FINE if suite.startswith("sim") else COARSE
    scores = [[run.scores(thresholds) for run in group] for group in grouped.values()]
    means = {
        "Mean": [_mean([score.final_accuracy for score in group]) for group in scores],
        "TFR": [_mean([score.total_forgetting for score in group]) for group in scores],
    }
    if suite in PUBLISHED:
        published = [PUBLISHED[suite].get(name, (math.nan, math.nan)) for name in grouped]
        means["Mean, published"] = [_number(accuracy) for accuracy, _ in published]
        means["TFR, published"] = [_number(forgetting) for _, forgetting in published]
    names = [rf"\multicolumn{{3}}{{c}}{{{_escaped(name)}}}" for name in grouped]
    header = [["Scene", *names], ["", *["$t$, cm", "$r$, deg", "Acc"] * len(grouped)]]
    body = [
        [scene, *(cell for group in grouped.values() for cell in _cells(group, scene, thresholds))]
        for scene in runs[0].scenes
    ]
    totals = [[title, *(c for v in values for c in ("", "", v))] for title, values in means.items()]
    return _tabular(f"l{'rrr' * len(grouped)}", header, [body, totals])


def _tabular(
    columns: str, header: Sequence[Sequence[str]], blocks: Sequence[Sequence[Sequence[str]]]
) -> str:
    lines = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule"]
    lines += [rf"{' & '.join(row)} \\".replace("%", r"\%") for row in header]
    for block in blocks:
        lines += [r"\midrule", *(rf"{' & '.join(map(_escaped, row))} \\" for row in block)]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"])


def _cells(runs: Sequence[Run], scene: str, thresholds: tuple[float, float]) -> list[str]:
    """Format median error in cm and deg, and accuracy in per cent, of a scene at the end."""
    ends = [run.end(scene) for run in runs]
    return [
        _mean([100 * _median(end.translation_m) for end in ends]),
        _mean([math.degrees(_median(end.rotation_rad)) for end in ends]),
        _mean([100 * float(end.correct(thresholds).mean()) for end in ends]),
    ]


def _median(errors: Sequence[float]) -> float:
    # The upper median: a mean of the two middle errors may include infinity.
    return sorted(errors)[len(errors) // 2]


def _mean(values: Sequence[float]) -> str:
    return _number(float(np.mean(values)))


def _number(value: float) -> str:
    if math.isnan(value):
        return "--"
    return r"$\infty$" if math.isinf(value) else f"{value:.1f}"


def _escaped(text: str) -> str:
    return text.replace("_", r"\_").replace("%", r"\%")
