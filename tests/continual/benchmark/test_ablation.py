"""Table 4 and the grid: who has a place where, and what a step gave."""

import itertools
import json

from evercal.continual.benchmark.ablation import ABLATIONS, ablation_rows, grid_rows
from evercal.continual.benchmark.comparison import Run, runs_of
from evercal.continual.benchmark.latex import ablation_table, paper_tables
from evercal.continual.benchmark.rows import load_rows
from evercal.continual.strategies import STRATEGIES

from .test_comparison import lines

ROWS = {row.name: row for table in ("table4", "spdd-sweep", "with-map") for row in load_rows(table)}
KNOWN = {name: made.description() for name, made in (STRATEGIES | ROWS).items()}


def runs(**finals: int) -> list[Run]:
    """A run per strategy: 16 of 20 frames right when learned, so many at the end."""
    found = []
    for name, right in finals.items():
        found += lines(name, 0, [[16], [right, right]])
    return runs_of(found, json.loads(json.dumps(KNOWN)))


def test_steps_of_the_ablation() -> None:
    of = runs(icarl=10, sars_old_output=14, sars_spdd=12, er=8)
    header, *rows = ablation_rows(of, "i7s")
    assert header == ["ablation", "", "final %", "step", "95 %", "published %"]
    assert [row[1:4] for row in rows] == [
        ["iCaRL", "50.0", ""],
        ["+ SARS", "70.0", "+20.0"],
        ["+ SARS + SPDD", "60.0", "-10.0"],
        ["random, reprojection", "40.0", ""],
        ["SARS, SPDD", "60.0", ""],  # the step between was not run
        ["random, reprojection", "40.0", ""],  # the same, the penalty first
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
    # On other data nothing published is comparable.
    assert all(len(row) == 5 for row in ablation_rows(of, "sim-mini"))
    assert len(ablation_rows(runs(icarl=10, joint=12))) == 1


def test_the_grid_takes_what_is_nothing_but_two_parts() -> None:
    of = runs(
        er=10,
        icarl=12,
        sars_old_output=14,
        reservoir_spdd=4,
        evercal=20,  # a map
        er_map=20,  # replay beside a map
        agem=18,  # steps are constrained
        mir=17,  # views are chosen, too
        mine=17,  # nobody says what it is
    )
    assert grid_rows(of) == [
        ["frames \\ cost", "Distillation", "OldOutput", "Reprojection"],
        ["reservoir", "20.0 (60.0)", "", "50.0 (30.0)"],
        ["herding", "", "60.0 (20.0)", ""],
        ["sars", "", "70.0 (10.0)", ""],
    ]
    heavier = runs(**{"er": 10, "icarl": 12})
    assert len(grid_rows(heavier)) == 3
    assert len(grid_rows(runs(er=10, hybrid=12))) == 1


def test_what_weighs_its_penalty_otherwise_is_another() -> None:
    """The best of a sweep may not stand where the paper's own weight belongs."""
    of = runs(spdd_30=18, points_only_10=17, sars_spdd=12, er=10, sars_reprojection=9)
    rows = grid_rows(of)
    assert rows[0] == ["frames \\ cost", "Distillation", "Reprojection"]
    assert rows[2] == ["sars", "60.0 (20.0)", "45.0 (35.0)"]
    assert len(grid_rows(runs(spdd_30=18, er=10))) == 1


def test_every_row_of_the_ablation_is_in_the_table_that_is_shipped() -> None:
    table = {row.name: row for row in load_rows("table4")}
    for steps in ABLATIONS.values():
        for (_, before), (_, after) in itertools.pairwise(steps):
            # A step changes one thing: the frames that stay, or what replaying them costs.
            one, two = (table[name].description()["method"] for name in (before, after))
            assert isinstance(one, dict)
            assert isinstance(two, dict)
            changed = {key for key in one if one[key] != two[key]} - {"weight"}
            assert len(changed) == 1
            assert changed <= {"selector", "penalty"}


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
