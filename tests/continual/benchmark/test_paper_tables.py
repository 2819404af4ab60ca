"""The paper's tables: steps of the ablation, published numbers, LaTeX."""

import itertools

import pandas as pd
import pytest

from evercal.continual.benchmark.comparison import run_scores
from evercal.continual.benchmark.paper_tables import (
    ABLATIONS,
    ablation_table,
    latex,
    paper_table,
    published,
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
    simulated = ablation_table(run_scores(runs(er=10, sars_reprojection=12), "sim"))
    assert simulated["final %"].tolist() == ["0.0"] * 2
    assert simulated["final %, 5 cm"].tolist() == ["50.0", "60.0"]


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
    paper = paper_table(results, run_scores(results, "i12s"), "i12s")
    ours = ["b", "a", "Mean", "TFR"]
    assert list(paper.index[:4]) == ours
    assert len(paper) == 4 + 12 + 2
    assert list(paper.index[-2:]) == ["Mean, published", "TFR, published"]
    assert paper.loc["a", "icarl"].tolist() == [30.0, 0.573, 50.0]
    assert paper.loc["b", "sars_spdd"].tolist() == [2.0, 0.573, 60.0]
    luke = "apt2-luke, published"
    assert paper.loc[luke, "sars_spdd"].tolist() == [2.3, 1.0, 86.5]
    accuracy = paper.xs("Acc, %", axis=1, level=1)
    shown = accuracy.loc[[*ours, *paper.index[-2:]]]
    assert shown["sars_spdd"].tolist() == [60.0, 60.0, 60.0, 20.0, 91.8, 8.1]
    assert shown["joint"].isna().tolist() == [False, False, False, True, False, True]
    assert (
        list(paper_table(results, run_scores(results, "real2"), "real2").index) == ours
    )


def test_simulated_suites_are_judged_at_1_cm_and_stand_beside_the_papers_sim() -> None:
    results = runs(icarl=10).assign(within_1cm_1deg=[12, 6, 6] * 2)
    simulated = paper_table(results, run_scores(results, "sim-mini"), "sim-mini")[
        "icarl", "Acc, %"
    ]
    assert simulated[["b", "a", "Mean", "TFR"]].tolist() == pytest.approx([30] * 4)
    theirs = ["bedroom", "kitchen", "living", "Mean", "TFR"]
    rows = [f"{name}, published" for name in theirs]
    assert simulated[rows].tolist() == [40.2, 68.8, 99.6, 69.5, 44.9]


@pytest.mark.parametrize(("suite", "scenes"), [("i7s", 7), ("i12s", 12), ("sim", 3)])
def test_published_means_are_those_of_their_rows(suite: str, scenes: int) -> None:
    """But for two that the paper prints otherwise; docs/paper.md names them."""
    contradictory = {("i7s", "gec"), ("i12s", "icarl")}
    rows = published(suite)
    of_scenes = rows[~rows["scene"].isin(["Mean", "TFR"])].groupby("strategy")
    assert set(of_scenes.size()) == {scenes}
    means = of_scenes["Acc, %"].mean()
    printed = rows[rows["scene"] == "Mean"].set_index("strategy")["Acc, %"]
    for name, mean in means.items():
        agrees = mean == pytest.approx(printed[name], abs=0.09)
        assert agrees == ((suite, name) not in contradictory)


def test_latex_escapes_names_and_marks_missing_numbers() -> None:
    results = pd.concat([runs(sars_spdd=12), JOINT])
    results.loc[results["strategy"] == "joint", "median_mm"] = float("inf")
    text = latex(paper_table(results, run_scores(results, "i7s"), "i7s"))
    assert r"\multicolumn{3}{c}{sars\_spdd} & \multicolumn{3}{c}{joint}" in text
    assert r"b & 2.0 & 0.6 & 60.0 & inf & 0.6 & 90.0 \\" in text
    assert r"TFR & -- & -- & 20.0 & -- & -- & -- \\" in text
