"""Table 4 and the grid: who has a place where, and what a step gave."""

import pytest

from evercal.benchmark.ablation import ablation_rows, grid_rows
from evercal.benchmark.comparison import Run, runs_of
from evercal.benchmark.latex import ablation_table, paper_tables
from evercal.continual import strategies

from .test_comparison import lines


@pytest.fixture(autouse=True)
def _known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Composing adds to the list of strategies: for one test only."""
    monkeypatch.setattr(strategies, "STRATEGIES", dict(strategies.STRATEGIES))


def runs(**finals: int) -> list[Run]:
    """A run per strategy: 16 of 20 frames right when learned, so many at the end."""
    found = []
    for name, right in finals.items():
        found += lines(name.replace("_plus_", "+"), 0, [[16], [right, right]])
    return runs_of(found)


def test_steps_of_the_ablation() -> None:
    of = runs(icarl=10, sars_plus_old_output=14, sars_spdd=12, er=8)
    header, *rows = ablation_rows(of, "i7s")
    assert header == ["ablation", "", "final %", "step", "95 %", "published %"]
    assert [row[1:4] for row in rows] == [
        ["iCaRL", "50.0", ""],
        ["+ SARS", "70.0", "+20.0"],
        ["+ SARS + SPDD", "60.0", "-10.0"],
        ["random, reprojection", "40.0", ""],
        ["SARS, SPDD", "60.0", ""],  # the step between was not run
    ]
    assert [row[-1] for row in rows] == ["65.2", "72.0", "74.9", "", ""]
    low, high = map(float, rows[1][4].split())
    assert low <= 20 <= high
    # On other data nothing published is comparable.
    assert all(len(row) == 5 for row in ablation_rows(of, "sim-mini"))
    assert len(ablation_rows(runs(icarl=10, joint=12))) == 1


def test_the_grid_takes_what_is_nothing_but_two_parts() -> None:
    of = runs(
        er=10,
        icarl=12,
        sars_plus_old_output=14,
        reservoir_plus_spdd=4,
        evercal=20,  # protected and recalled
        agem=18,  # gradients are joined by a rule
        mine=17,  # a plugin's
    )
    assert grid_rows(of) == [
        ["frames \\ cost", "reprojection", "old_output", "spdd"],
        ["reservoir", "50.0 (30.0)", "", "20.0 (60.0)"],
        ["herding", "", "60.0 (20.0)", ""],
        ["sars", "", "70.0 (10.0)", ""],
    ]
    heavier = runs(**{"er": 10, "icarl": 12})
    assert len(grid_rows(heavier)) == 3
    assert len(grid_rows(runs(er=10, hybrid=12))) == 1


def test_a_weighed_strategy_is_another() -> None:
    of = runs_of(lines("er@3", 0, [[16], [1, 1]]) + lines("icarl", 0, [[16], [1, 1]]))
    assert len(grid_rows(of)) == 1


def test_latex_has_the_ablation_where_there_is_one() -> None:
    alone, two = runs(icarl=10), runs(icarl=10, sars_spdd=12)
    steps = ablation_rows(two, "i12s")
    text = ablation_table(steps)
    assert r"as printed & + SARS + SPDD & 60.0 &" in text
    assert text.startswith(r"\begin{tabular}{llrrrr}")
    none = ablation_rows(alone, "i12s")
    assert ablation_table(none) == ""
    assert paper_tables(alone, "i12s", none).count("tabular") == 2
    assert paper_tables(two, "i12s", steps).count("tabular") == 4
