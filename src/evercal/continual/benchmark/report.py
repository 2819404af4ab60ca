"""Tables and figure of a folder of results.

OUT/tables.md     all tables, with the definitions of their columns
OUT/tables.tex    the tables of the paper
OUT/figure.svg    accuracy of each scene while later ones are learned
"""

from pathlib import Path

import numpy as np

from evercal.continual.benchmark import comparison
from evercal.continual.benchmark import results as stored
from evercal.continual.benchmark.figures import line_style, new_figure, tidy
from evercal.continual.benchmark.paper_tables import ablation_table, latex, paper_table
from evercal.continual.benchmark.results import Table
from evercal.errors import InputError
from evercal.storage import write_bytes
from evercal.storage.settings import read_settings

TABLES = "tables.md"
LATEX = "tables.tex"
FIGURE = "figure.svg"
_LINES = 7
"""Strategies of the figure."""


def write_report(folder: Path, reference: str) -> str:
    """Write tables and figure of a folder of results, and return the tables as Markdown.

    All strategies are compared with `reference`.
    """
    results = stored.read(folder)
    if results.empty:
        raise InputError(f"{folder}: no results here; make some with 'evercal bench'")
    suite = str(read_settings(folder / stored.SETTINGS).get("suite"))
    results = comparison.complete_runs(results)
    scores = comparison.run_scores(results)
    scenes = comparison.scene_table(results).reset_index()
    methods = comparison.method_table(scores)
    ablation = ablation_table(scores, suite)
    others = methods.index.drop(reference, errors="ignore")
    contrasts = comparison.contrast_table(
        scores, [(reference, name) for name in others]
    )
    tables = {
        "Strategies, means over runs": methods.reset_index(),
        "Accuracy of each scene: just after learning it -> at the end": scenes,
        "Differences on common seeds, in points": contrasts[
            contrasts["runs"] > 0
        ].reset_index(),
        "Ablation after Table 4 of the paper": ablation,
    }
    text = "\n\n".join(
        f"## {title}\n\n{table.to_markdown(index=False, disable_numparse=True)}"
        for title, table in tables.items()
        if len(table)
    )
    page = f"{text}\n\n{comparison.LEGEND}\n\n![accuracy]({FIGURE})\n"
    write_bytes(folder / TABLES, page.encode())
    paper = latex(paper_table(results, suite))
    if len(ablation):
        paper += f"\n{latex(ablation, index=False)}"
    write_bytes(folder / LATEX, paper.encode())
    _figure(results, methods.index[:_LINES], folder / FIGURE)
    return text


def _figure(results: Table, strategies: Table, path: Path) -> None:
    """Plot the accuracy on each scene while later ones are learned, means over runs."""
    by_strategy = results.groupby("strategy")
    runs = {
        name: [
            comparison.matrix(run)
            for _, run in by_strategy.get_group(name).groupby("seed")
        ]
        for name in strategies
    }
    # With several orders, a panel is the place of a scene in the order.
    orders = {tuple(run.columns) for group in runs.values() for run in group}
    count = len(next(iter(orders)))
    titles = (
        next(iter(orders))
        if len(orders) == 1
        else [f"scene {i + 1}" for i in range(count)]
    )
    figure = new_figure(2.6 * (count + 1), 2.8)
    panels = figure.subplots(1, count + 1, sharex=True, sharey=True)
    stages = np.arange(1, count + 1)
    for index, (name, group) in enumerate(runs.items()):
        accuracies = np.mean([run.to_numpy(float) for run in group], axis=0)
        for j in range(count):
            panels[j].plot(stages[j:], accuracies[j:, j], **line_style(index, name))
        means = [accuracies[i, : i + 1].mean() for i in range(count)]
        panels[count].plot(stages, means, **line_style(index, name))
    for panel, title in zip(panels, [*titles, "mean of scenes learned"], strict=True):
        panel.set_title(title, fontsize=9)
        panel.set_ylim(-3, 103)
        tidy(panel)
    figure.supxlabel("scenes learned", fontsize=9)
    figure.supylabel("accuracy (%)", fontsize=9)
    handles, labels = panels[count].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper center", ncols=_LINES, frameon=False
    )
    figure.savefig(path)
