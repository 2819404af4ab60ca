"""The ablation of the paper, and the grid of selectors and penalties."""

import itertools
import json

from evercal.continual.benchmark.ablation import ABLATIONS, ablation_rows, grid_rows
from evercal.continual.benchmark.latex import paper_tables
from evercal.continual.benchmark.rows import load_rows

from evercal.continual.benchmark.comparison import Run, runs_of
from evercal.continual.strategies import STRATEGIES

from .test_comparison import lines

ROWS = {row.name: row for table in ("table4", "spdd-sweep", "with-map") for row in load_rows(table)}
DESCRIPTIONS = {name: item.description() for name, item in (STRATEGIES | ROWS).items()}


def runs(**finals: int) -> list[Run]:
    """One run per strategy: 16 of 20 frames correct when learned, the given number at the end."""
    results = []
    for name, correct in finals.items():
        results += lines(name, 0, [[16], [correct, correct]])
    return runs_of(results, json.loads(json.dumps(DESCRIPTIONS)))


def test_steps_are_differences_of_consecutive_rows() -> None:
    complete = runs(icarl=10, sars_old_output=14, sars_spdd=12, er=8)
    header, *rows = ablation_rows(complete, "i7s")
    assert header == ["ablation", "", "final %", "step", "95 %", "published %"]
    assert [row[1:4] for row in rows] == [
        ["iCaRL", "50.0", ""],
        ["+ SARS", "70.0", "+20.0"],
        ["+ SARS + SPDD", "60.0", "-10.0"],
        ["random, reprojection", "40.0", ""],
        ["SARS, SPDD", "60.0", ""],  # no step: the row before was not run
        ["random, reprojection", "40.0", ""],
        ["SARS, SPDD", "60.0", ""],
    ]
    assert [row[-1] for row in rows] == ["65.2", "72.0", "74.9", "", "", "", ""]
    other = ablation_rows(runs(er=8, reservoir_spdd=11, sars_spdd=12))[-3:]
    assert [row[1:4] for row in other] == [
        ["random, reprojection", "40.0", ""],
        ["random, SPDD", "55.0", "+15.0"],
        ["SARS, SPDD", "60.0", "+5.0"],
    ]
    low, high = map(float, rows[1][4].split())
    assert low <= 20 <= high
    assert all(len(row) == 5 for row in ablation_rows(complete, "sim-mini"))
    assert len(ablation_rows(runs(icarl=10, joint=12))) == 1


def test_grid_shows_plain_replay_only() -> None:
    complete = runs(
        er=10,
        icarl=12,
        sars_old_output=14,
        reservoir_spdd=4,
        evercal=20,  # a map
        er_map=20,  # replay beside a map
        agem=18,  # constrains steps
        mir=17,  # selects views
        mine=17,  # no description
    )
    assert grid_rows(complete) == [
        ["frames \\ cost", "Distillation", "OldOutput", "Reprojection"],
        ["reservoir", "20.0 (60.0)", "", "50.0 (30.0)"],
        ["herding", "", "60.0 (20.0)", ""],
        ["sars", "", "70.0 (10.0)", ""],
    ]
    assert len(grid_rows(runs(er=10, hybrid=12))) == 1


def test_grid_omits_other_penalty_weights() -> None:
    complete = runs(spdd_30=18, points_only_10=17, sars_spdd=12, er=10, sars_reprojection=9)
    rows = grid_rows(complete)
    assert rows[0] == ["frames \\ cost", "Distillation", "Reprojection"]
    assert rows[2] == ["sars", "60.0 (20.0)", "45.0 (35.0)"]
    assert len(grid_rows(runs(spdd_30=18, er=10))) == 1


def test_packaged_ablation_changes_one_thing_per_step() -> None:
    table = {row.name: row for row in load_rows("table4")}
    for steps in ABLATIONS.values():
        for (_, before), (_, after) in itertools.pairwise(steps):
            one, two = (table[name].description()["method"] for name in (before, after))
            assert isinstance(one, dict)
            assert isinstance(two, dict)
            changed = {key for key in one if one[key] != two[key]} - {"weight"}
            assert len(changed) == 1
            assert changed <= {"selector", "penalty"}


def test_latex_includes_the_ablation_if_it_was_run() -> None:
    two = runs(icarl=10, sars_spdd=12)
    assert paper_tables(two, "i12s", None).count("tabular") == 2
    text = paper_tables(two, "i12s", ablation_rows(two, "i12s"))
    assert text.count("tabular") == 4
    assert r"as printed & + SARS + SPDD & 60.0 &" in text
    assert r"\begin{tabular}{llrrrr}" in text
