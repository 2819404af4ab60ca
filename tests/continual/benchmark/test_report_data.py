"""Results as one report: every table once, and the same scenes under other settings beside it."""

from pathlib import Path

import pytest

from evercal.continual.benchmark import results
from evercal.continual.benchmark.report_data import read_report
from evercal.continual.benchmark.results import SETTINGS, STRATEGIES
from evercal.continual.strategies import strategy_named
from evercal.errors import InputError
from evercal.storage import write_json

from .test_comparison import lines


def folder(root: Path, name: str, right: int, **settings: object) -> Path:
    """Results of `evercal`, so many of 20 frames right at the end, and of `joint`."""
    out = root / name
    out.mkdir()
    held = {"suite": "custom", "scenes": [["a", 9, 20], ["b", 9, 20]], "judged": "test frames"}
    write_json(out / SETTINGS, held | settings)
    known = {name: strategy_named(name).description() for name in ("evercal", "joint")}
    write_json(out / STRATEGIES, known)
    results.append(out, lines("evercal", 0, [[16], [right, right]]))
    results.append(out, lines("joint", 0, [[10], [10, 10]]))
    return out


def test_tables_of_a_folder(tmp_path: Path) -> None:
    report = read_report(folder(tmp_path, "large", 18), "evercal")
    tables = report.tables()
    assert [row[0] for row in tables.methods] == ["strategy", "evercal", "joint"]
    assert tables.differences[1][:2] == ["evercal - joint", "+40.0"]
    # No frames were kept, no ablation run, nothing put beside it.
    assert tables.non_empty() == [
        tables.methods,
        tables.thresholds,
        tables.scenes,
        tables.differences,
    ]


def test_other_settings_beside_it(tmp_path: Path) -> None:
    large, small = folder(tmp_path, "large", 18), folder(tmp_path, "small", 14, memory_share=0.01)
    report = read_report(large, "evercal", [small])
    tables = report.tables()
    assert [row[0] for row in tables.methods[1:]] == ["evercal", "joint"]
    header, *rows = tables.compare_with
    assert [(row[0], row[header.index("final %")]) for row in rows] == [
        ("evercal (small)", "70.0"),
        ("joint (small)", "50.0"),
    ]
    assert tables.non_empty()[-1] == tables.compare_with


def test_other_scenes_are_refused(tmp_path: Path) -> None:
    here = folder(tmp_path, "here", 18)
    for number, (key, value) in enumerate(
        {"suite": "real2", "scenes": [["a", 9, 20]], "judged": "held-out training frames"}.items()
    ):
        there = folder(tmp_path, f"there-{number}", 18, **{key: value})
        with pytest.raises(InputError, match=f"there-{number}: {key} .* only the same frames"):
            read_report(here, "evercal", [there])


def test_no_results(tmp_path: Path) -> None:
    here = folder(tmp_path, "here", 18)
    with pytest.raises(InputError, match="nowhere: no results here"):
        read_report(here, "evercal", [tmp_path / "nowhere"])
    (here / SETTINGS).unlink()
    with pytest.raises(InputError, match="no settings in JSON"):
        read_report(here, "evercal")


def test_the_best_first_and_seven_in_figures(tmp_path: Path) -> None:
    here = folder(tmp_path, "here", 12)
    for seed in (0, 1):
        results.append(here, lines("er", seed, [[16], [4, 4]]))
    for right, name in enumerate(("gem", "agem", "mir", "gss", "der", "co2l"), start=14):
        results.append(here, lines(name, 0, [[16], [right, right]]))
    report = read_report(here, "evercal")
    ranked = ["co2l", "der", "gss", "mir", "agem", "gem", "evercal", "joint", "er"]
    assert list(dict.fromkeys(run.strategy for run in report.runs)) == ranked
    assert [row[0] for row in report.tables().methods[1:]] == ranked
    assert report.plotted == ["evercal", "er", "co2l", "der", "gss", "mir", "agem"]


def test_who_needs_all_frames_has_no_memory_to_compare(tmp_path: Path) -> None:
    here = folder(tmp_path, "here", 18)
    tables = read_report(here, "evercal", [folder(tmp_path, "there", 18)]).tables()
    for header, ours, joint in (tables.methods, tables.compare_with):
        column = header.index("memory MB")
        assert float(ours[column]) >= 0
        assert joint[column] == "-"
