"""The paper's tables: steps of the ablation, published numbers, LaTeX."""

import itertools

import pandas as pd

from evercal.continual.benchmark.comparison import run_scores
from evercal.continual.benchmark.paper_tables import (
    ABLATIONS,
    ablation_table,
    latex,
    paper_table,
)
from evercal.continual.strategies import strategy_named

from .results_by_hand import JOINT, table


def runs(**finals: int) -> pd.DataFrame:
    """Two runs per strategy: 16 of 20 frames correct when learned, the given number at the end."""
    return pd.concat(
        [
            table(name, seed, [[16], [correct, correct]])
            for name, correct in finals.items()
            for seed in (0, 1)
        ]
    )


def test_steps_are_differences_of_consecutive_rows() -> None:
    scores = run_scores(runs(icarl=10, sars_old_output=14, sars_spdd=12, er=8))
    ablation = ablation_table(scores, "i7s")
    assert ablation[["", "final %", "step"]].to_numpy().tolist() == [
        ["iCaRL", "50.0", "-"],
        ["+ SARS", "70.0", "+20.0"],
        ["+ SARS + SPDD", "60.0", "-10.0"],
        ["random, reprojection", "40.0", "-"],
        ["SARS, SPDD", "60.0", "-"],  # no step: the row before was not run
        ["random, reprojection", "40.0", "-"],
        ["SARS, SPDD", "60.0", "-"],
    ]
    assert ablation["published %"].tolist() == ["65.2", "72.0", "74.9", "", "", "", ""]
    assert ablation["95 %"][1] == "+20.0 to +20.0"
    assert "published %" not in ablation_table(scores, "sim-mini")
    assert ablation_table(run_scores(runs(icarl=10, joint=12))).empty


def test_ablation_changes_one_thing_per_step() -> None:
    for steps in ABLATIONS.values():
        for (_, before), (_, after) in itertools.pairwise(steps):
            one, two = (
                strategy_named(name).description()["method"] for name in (before, after)
            )
            assert isinstance(one, dict)
            assert isinstance(two, dict)
            changed = {key for key in one if one[key] != two[key]} - {"weight"}
            assert len(changed) == 1
            assert changed <= {"selector", "penalty"}


def test_paper_table_has_scenes_means_and_published_numbers() -> None:
    results = pd.concat([runs(icarl=10, sars_spdd=12), JOINT])
    paper = paper_table(results, "i12s")
    assert list(paper.index) == [
        "b",
        "a",
        "Mean",
        "TFR",
        "Mean, published",
        "TFR, published",
    ]
    assert paper.loc["a", "icarl"].tolist() == [30.0, 0.573, 50.0]
    assert paper.loc["b", "sars_spdd"].tolist() == [2.0, 0.573, 60.0]
    accuracy = paper.xs("Acc, %", axis=1, level=1)
    assert accuracy["sars_spdd"].tolist() == [60.0, 60.0, 60.0, 20.0, 91.8, 8.1]
    assert accuracy["joint"].isna().tolist() == [False, False, False, True, False, True]
    # Simulated suites are judged at 1 cm and 1 deg, as in the paper.
    simulated = paper_table(results, "sim-mini")
    assert list(simulated.index) == ["b", "a", "Mean", "TFR"]
    assert simulated.loc["Mean", ("icarl", "Acc, %")] == 0.0


def test_latex_escapes_names_and_marks_missing_numbers() -> None:
    results = pd.concat([runs(sars_spdd=12), JOINT])
    results.loc[results["strategy"] == "joint", "median_mm"] = float("inf")
    text = latex(paper_table(results, "i7s"))
    assert r"\multicolumn{3}{c}{sars\_spdd} & \multicolumn{3}{c}{joint}" in text
    assert r"b & 2.0 & 0.6 & 60.0 & $\infty$ & 0.6 & 90.0 \\" in text
    assert r"TFR & -- & -- & 20.0 & -- & -- & -- \\" in text
