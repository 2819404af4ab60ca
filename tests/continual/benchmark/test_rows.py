"""Strategies from rows of JSON files, and one-line errors for invalid rows."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from evercal.continual.benchmark.rows import load_rows
from evercal.continual.methods.gradient_constraints import EpisodicConstraint

from evercal.continual.methods.penalties import Distillation, OldOutput, Reprojection
from evercal.continual.methods.replay import Replay
from evercal.continual.methods.spdd import SpddOptions
from evercal.continual.strategies import STRATEGIES, Strategy
from evercal.errors import InputError


def loaded(tmp_path: Path, *rows: object) -> tuple[Strategy, ...]:
    """Load strategies from a file with these rows."""
    path = tmp_path / "rows.json"
    path.write_text(json.dumps(list(rows)))
    return load_rows(str(path))


def test_packaged_rows_of_table_4() -> None:
    rows = {row.name: row.method for row in load_rows("table4")}
    assert rows["icarl"] == Replay("herding", OldOutput())
    assert rows["sars_old_output"] == Replay("sars", OldOutput())
    assert rows["sars_spdd"] == Replay("sars", Distillation(), 1.0)
    assert rows["er"] == Replay("reservoir", Reprojection(), 0.3)
    assert rows["sars_reprojection"] == Replay("sars", Reprojection(), 0.3)
    assert rows["reservoir_spdd"] == Replay("reservoir", Distillation(), 1.0)
    assert len(rows) == 6


def test_packaged_sweep_of_spdd() -> None:
    paper = Replay("sars", Distillation())
    points = SpddOptions(prior_weight=0.0, metric_weight=0.0)
    expected = {
        f"spdd_{n}": replace(paper, penalty=Distillation(scale=float(n)))
        for n in (0.3, 1, 3, 10, 30, 100)
    }
    # A mean over 50 active centres and 3 coordinates instead of a sum.
    offsets = SpddOptions(metric_weight=0.00667)
    expected["spdd_offsets_averaged"] = replace(paper, penalty=Distillation(offsets))
    expected["spdd_every_scene"] = replace(paper, every_scene=True)
    expected |= {
        f"points_only_{n}": replace(paper, penalty=Distillation(points, float(n))) for n in (10, 30)
    }
    assert {row.name: row.method for row in load_rows("spdd-sweep")} == expected


def test_packaged_baselines_beside_a_map() -> None:
    rows = load_rows("with-map")
    without = {"evercal", "evercal_network", "evercal_hybrid", "joint", "joint_map"}
    # Beside a map, its keyframes are replayed, so these would repeat other rows.
    without |= {"hybrid", "gdr", "gss", "sars_spdd_filled", "sars_spdd_every_scene"}
    assert {row.name for row in rows} == {f"{name}_map" for name in set(STRATEGIES) - without}
    for row in rows:
        assert row.name.endswith("_map")
        plain = STRATEGIES[row.name.removesuffix("_map")]
        assert row == replace(plain, name=row.name, builds_map=True)
        assert not plain.builds_map


@pytest.mark.parametrize("table", ["table4", "spdd-sweep", "with-map"])
def test_packaged_names_are_unique_and_keep_their_meaning(table: str) -> None:
    rows = load_rows(table)
    assert len({row.name for row in rows}) == len(rows)
    for row in rows:
        if row.name in STRATEGIES:
            assert row == STRATEGIES[row.name]


def test_rows_change_nested_fields_penalty_and_map(tmp_path: Path) -> None:
    mine, strict, other, map_alone = loaded(
        tmp_path,
        {"name": "mine", "of": "icarl", "with": {"weight": 1, "penalty": {"px_per_m": 25}}},
        {"name": "gec_strict", "of": "gec", "with": {"slack": 0.0, "warm_steps": 0}},
        {
            "name": "er-spdd.2",
            "of": "er",
            "with": {"penalty": {"kind": "Distillation", "options": {"temperature": 1.5}}},
            "map": True,
        },
        {"name": "recall", "of": "evercal"},
    )
    assert mine.method == Replay("herding", OldOutput(25.0), 1.0)
    assert strict.method == EpisodicConstraint(slack=0.0, warm_steps=0)
    assert other.method == Replay("reservoir", Distillation(SpddOptions(temperature=1.5)), 0.3)
    assert other.builds_map
    assert map_alone == replace(STRATEGIES["evercal"], name="recall")
    # Integers become floats where the field is a float.
    method = mine.description()["method"]
    assert isinstance(method, dict)
    assert (method["selector"], repr(method["weight"])) == ("herding", "1.0")


BAD = [
    (3, "row 3; give name and of"),
    ({"name": "a"}, "give name and of"),
    ({"of": "er"}, "give name and of"),
    ({"name": "a", "of": "er", "weight": 3}, "give name and of, optionally with and map"),
    ({"name": "a", "of": "magic"}, "strategy 'magic': unknown"),
    ({"name": "../a", "of": "er"}, "name '../a': give letters"),
    ({"name": "", "of": "er"}, "name '': give letters"),
    ({"name": "a", "of": "er", "with": {"wait": 3}}, "Replay has no fields .*wait.* weight"),
    ({"name": "a", "of": "er", "with": {"kind": "Gem"}}, "Replay has no fields"),
    ({"name": "a", "of": "er", "with": [1]}, "Replay has no fields"),
    ({"name": "a", "of": "er", "with": {"weight": "heavy"}}, "Replay.weight is 'heavy'"),
    ({"name": "a", "of": "er", "with": {"weight": None}}, "Replay.weight is None; give one like"),
    ({"name": "a", "of": "er", "with": {"every_scene": 1}}, "Replay.every_scene is 1"),
    ({"name": "a", "of": "mir", "with": {"chosen": 2.5}}, "chosen is 2.5; give one like 8"),
    ({"name": "a", "of": "er", "with": {"selector": "best"}}, "selector 'best': unknown; use one"),
    ({"name": "a", "of": "er", "with": {"penalty": 3}}, "Reprojection has no fields 3"),
    (
        {"name": "a", "of": "er", "with": {"penalty": {"kind": "Magic"}}},
        "penalty 'Magic': unknown; use one of Reprojection, OldOutput",
    ),
    (
        {"name": "a", "of": "sars_spdd", "with": {"penalty": {"options": {"temperature": 0}}}},
        "give a temperature > 0",
    ),
    ({"name": "a", "of": "evercal", "with": {"weight": 3}}, "evercal trains nothing"),
    ({"name": "a", "of": "er", "map": "yes"}, "map is 'yes'; give true or false"),
    ({"name": "a", "of": "evercal", "map": False}, "true if nothing is trained"),
]


@pytest.mark.parametrize(("row", "message"), BAD)
def test_invalid_row_is_refused(tmp_path: Path, row: object, message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        loaded(tmp_path, {"name": "good", "of": "er"}, row)
    assert "\n" not in str(error.value)


def test_files_without_rows_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="rows table5: give spdd-sweep, table4, with-map, or"):
        load_rows("table5")
    with pytest.raises(InputError, match=r"none\.json: no such file"):
        load_rows(str(tmp_path / "none.json"))
    for text, message in (("{", "not JSON"), ('{"name": "a"}', "give a list of rows")):
        (tmp_path / "bad.json").write_text(text)
        with pytest.raises(InputError, match=message):
            load_rows(str(tmp_path / "bad.json"))
