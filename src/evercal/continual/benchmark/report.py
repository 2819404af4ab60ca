"""Tables and figure of a folder of results.

OUT/tables.md     all tables, with the definitions of their columns
OUT/tables.tex    the tables of the paper
OUT/figure.svg    accuracy of each scene while later ones are learned
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from evercal.continual.benchmark import comparison, results as stored
from evercal.continual.benchmark.figures import line_style, new_figure, tidy
from evercal.continual.benchmark.paper_tables import ablation_table, latex, paper_table
from evercal.continual.benchmark.results import Table
from evercal.errors import InputError
from evercal.storage import write_bytes
from evercal.storage.settings import read_settings

TABLES = "tables.md"
"""File of all tables."""
LATEX = "tables.tex"
"""File of the paper's tables."""
FIGURE = "figure.svg"
"""File of the figure."""
_LINES = 7
"""Maximum number of strategies in the figure: the best ones."""


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
    pairs = [(reference, name) for name in others]
    contrasts = comparison.contrast_table(scores, pairs)
    contrasts = contrasts[contrasts["runs"] > 0].reset_index()
    tables = {
        "Strategies, means over runs": methods.reset_index(),
        "Accuracy of each scene: just after learning it -> at the end": scenes,
        "Differences on common seeds, in points": contrasts,
        "Ablation after Table 4 of the paper": ablation,
    }
    sections = []
    for title, table in tables.items():
        if len(table):
            rows = table.to_markdown(index=False, disable_numparse=True)
            sections.append(f"## {title}\n\n{rows}")
    text = "\n\n".join(sections)
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
    runs = {}
    for name in strategies:
        of_strategy = results[results["strategy"] == name]
        runs[name] = [comparison.matrix(run) for _, run in of_strategy.groupby("seed")]
    titles = _panel_titles(runs)
    count = len(titles)
    figure = new_figure(2.6 * (count + 1), 2.8)
    panels = figure.subplots(1, count + 1, sharex=True, sharey=True)
    stages = np.arange(1, count + 1)
    for index, (name, matrices) in enumerate(runs.items()):
        style = line_style(index, name)
        accuracies = np.mean([matrix.to_numpy(float) for matrix in matrices], axis=0)
        for j in range(count):
            panels[j].plot(stages[j:], accuracies[j:, j], **style)
        means = [accuracies[i, : i + 1].mean() for i in range(count)]
        panels[count].plot(stages, means, **style)
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


def _panel_titles(runs: Mapping[str, Sequence[Table]]) -> Sequence[str]:
    """The scenes in their order; with several orders, a panel is a place in the order."""
    orders = set()
    for matrices in runs.values():
        orders.update(tuple(matrix.columns) for matrix in matrices)
    first = orders.pop()
    if not orders:
        return first
    return [f"scene {i + 1}" for i in range(len(first))]
