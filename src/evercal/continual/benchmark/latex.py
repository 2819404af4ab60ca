"""The layout of the paper's tables: scenes down, methods across, error and accuracy each.

Tables 1 to 3 are of this kind; Table 4, the ablation, follows where its strategies were run.

Published numbers stand beside ours where the data are the same; they are those of Li et al.,
"Continual Hand-Eye Calibration for Open-world Robotic Manipulation", arXiv 2604.15814.
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
"""By suite and strategy: final accuracy and TFR, per cent."""


def paper_tables(runs: Sequence[Run], suite: str, ablation: TableRows) -> str:
    """`paper_table` and, where its strategies were run, `ablation_table`."""
    found = [paper_table(runs, suite), ablation_table(ablation)]
    return "\n\n".join(table for table in found if table)


def ablation_table(ablation: TableRows) -> str:
    """A LaTeX table (booktabs) of what `ablation_rows` found; empty if that is a header alone."""
    header, *rows = ablation
    if not rows:
        return ""
    lines = [rf"\begin{{tabular}}{{ll{'r' * (len(header) - 2)}}}", r"\toprule"]
    lines += [rf"{' & '.join(map(_escaped, row))} \\" for row in (header, *rows)]
    lines.insert(3, r"\midrule")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"])


def paper_table(runs: Sequence[Run], suite: str) -> str:
    """A LaTeX table (booktabs) of final errors and accuracies, means over runs.

    Args:
        runs: whose last stage is done.
        suite: its name; simulated suites are judged at 1 cm and 1 deg as in the paper, others at 5.
    """
    grouped = by_strategy(runs)
    thresholds = FINE if suite.startswith("sim") else COARSE
    names = list(runs[0].scenes)
    heads = " & ".join(rf"\multicolumn{{3}}{{c}}{{{_escaped(name)}}}" for name in grouped)
    units = " & ".join([r"$t$, cm & $r$, deg & Acc"] * len(grouped))
    lines = [
        rf"\begin{{tabular}}{{l{'rrr' * len(grouped)}}}",
        r"\toprule",
        rf"Scene & {heads} \\",
        rf" & {units} \\",
        r"\midrule",
    ]
    for name in names:
        cells = [cell for of in grouped.values() for cell in _cells(of, name, thresholds)]
        lines.append(rf"{_escaped(name)} & {' & '.join(cells)} \\")
    lines.append(r"\midrule")
    finals = {name: [run.scores(thresholds) for run in of] for name, of in grouped.items()}
    rows = [
        ("Mean", {name: _mean([s.final_accuracy for s in of]) for name, of in finals.items()}),
        ("TFR", {name: _mean([s.total_forgetting for s in of]) for name, of in finals.items()}),
    ]
    told = PUBLISHED.get(suite, {})
    if told:
        rows += [
            ("Mean, published", {name: _number(told.get(name, _NONE)[0]) for name in grouped}),
            ("TFR, published", {name: _number(told.get(name, _NONE)[1]) for name in grouped}),
        ]
    for title, values in rows:
        spread = " & ".join(f" &  & {values[name]}" for name in grouped)
        lines.append(rf"{title} & {spread} \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"])


_NONE = (math.nan, math.nan)


def _cells(runs: Sequence[Run], scene: str, thresholds: tuple[float, float]) -> list[str]:
    """Median error in cm and deg, and accuracy, of a scene at the end."""
    ends = [run.end(scene) for run in runs]
    centimetres = [100 * _median(end.translation_m) for end in ends]
    degrees = [math.degrees(_median(end.rotation_rad)) for end in ends]
    accuracy = [100 * float(end.correct(thresholds).mean()) for end in ends]
    return [_mean(centimetres), _mean(degrees), _mean(accuracy)]


def _median(errors: Sequence[float]) -> float:
    return sorted(errors)[len(errors) // 2]  # a mean of two may be of a number and infinity


def _mean(values: Sequence[float]) -> str:
    return _number(float(np.mean(values)))


def _number(value: float) -> str:
    if math.isnan(value):
        return "--"
    return r"$\infty$" if math.isinf(value) else f"{value:.1f}"


def _escaped(name: str) -> str:
    return name.replace("_", r"\_").replace("%", r"\%")
