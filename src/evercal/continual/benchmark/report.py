"""Tables and figures of a folder of results.

OUT/tables.md     all tables: means, contrasts, definitions of the columns
OUT/tables.tex    the tables of the paper, its rows below ours
OUT/bars.svg      final accuracy of each scene
OUT/figure.svg    accuracy over stages: each scene while later ones are learned
OUT/training.svg  loss and inliers of every training
OUT/overlays.png  test images: their contours by the pose of each strategy
"""

from pathlib import Path

from evercal.continual.benchmark import comparison, results as stored
from evercal.continual.benchmark.figures import (
    BARS,
    CURVES,
    LINES,
    draw_curves,
    draw_figures,
)
from evercal.continual.benchmark.overlays import OVERLAYS, draw_overlays
from evercal.continual.benchmark.paper_tables import (
    ACCURACY,
    ablation_table,
    latex,
    paper_table,
)
from evercal.errors import InputError
from evercal.storage import write_bytes
from evercal.storage.settings import read_settings
from evercal.typing import JsonObject

TABLES = "tables.md"
"""File of all tables."""
LATEX = "tables.tex"
"""File of the paper's tables."""


def write_report(folder: Path, reference: str) -> tuple[str, list[JsonObject]]:
    """Write tables and figures of a folder of results.

    All strategies are compared with `reference`. Returns the tables as Markdown, and the scores of
    each run for JSON; NaN becomes None.
    """
    results = comparison.complete_runs(stored.read(folder))
    if results.empty:
        raise InputError(f"{folder}: no complete run; make one with 'evercal bench'")
    settings = read_settings(folder / stored.SETTINGS)
    suite = str(settings.get("suite"))
    least = comparison.GATES[settings["head"]["condition"]]
    threshold, _ = comparison.thresholds(suite)
    scores = comparison.run_scores(results, suite)
    methods = comparison.method_table(scores)
    paper = paper_table(results, scores, suite)
    accuracies = comparison.formatted(paper.xs(ACCURACY, axis=1, level=1))
    ablation = ablation_table(scores, suite)
    others = methods.index.drop(reference, errors="ignore")
    pairs = [(reference, name) for name in others]
    contrasts = comparison.contrast_table(scores, pairs)
    if pairs:
        contrasts = contrasts[contrasts["runs"] > 0]
    tables = {
        f"Strategies at {threshold.text}, means over runs": methods.reset_index(),
        "Final accuracy, as Tables 1 to 3 of the paper": accuracies.reset_index(
            names="scene"
        ),
        "Differences on common seeds, in points": contrasts,
        "Ablation after Table 4 of the paper": ablation,
    }
    sections = []
    for title, table in tables.items():
        if len(table):
            rows = table.to_markdown(index=False, disable_numparse=True)
            sections.append(f"## {title}\n\n{rows}")
    text = "\n\n".join([*sections, comparison.gate(scores, suite, least)])
    figures = f"![final accuracy]({BARS})\n![accuracy over stages]({LINES})"
    if draw_overlays(folder, methods.index):
        figures += f"\n![contours by the estimated poses]({OVERLAYS})"
    if draw_curves(folder):
        figures += f"\n![loss and inliers of every training]({CURVES})"
    page = f"{text}\n\n{comparison.LEGEND}\n\n{figures}\n"
    write_bytes(folder / TABLES, page.encode())
    text_of_paper = latex(paper)
    if len(ablation):
        text_of_paper += f"\n{latex(ablation, index=False)}"
    write_bytes(folder / LATEX, text_of_paper.encode())
    draw_figures(results, methods.index, threshold, folder)
    records = scores.reset_index().astype(object)
    return text, records.where(records.notna(), None).to_dict("records")
