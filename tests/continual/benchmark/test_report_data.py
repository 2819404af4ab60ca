"""Tables of a folder of results, alone and beside other settings."""

from pathlib import Path

import pytest
from evercal.continual.benchmark.report_data import TITLES, read_report, tables_text

from evercal.continual.benchmark import results
from evercal.continual.benchmark.results import SETTINGS, STRATEGIES
from evercal.continual.strategies import strategy_named
from evercal.errors import InputError
from evercal.storage import write_json

from .test_comparison import lines


def folder(root: Path, name: str, correct: int, **settings: object) -> Path:
    """Results of `evercal`, with `correct` of 20 frames at the end, and of `joint`."""
    out = root / name
    out.mkdir()
    scenes = [["a", 9, 20], ["b", 9, 20]]
    defaults = {"suite": "custom", "scenes": scenes, "judged": "test frames"}
    write_json(out / SETTINGS, defaults | settings)
    described = {name: strategy_named(name).description() for name in ("evercal", "joint")}
    write_json(out / STRATEGIES, described)
    results.append(out, lines("evercal", 0, [[16], [correct, correct]]))
    results.append(out, lines("joint", 0, [[10], [10, 10]]))
    return out


def test_tables_without_results_are_omitted(tmp_path: Path) -> None:
    tables = read_report(folder(tmp_path, "large", 18), "evercal").tables()
    assert [row[0] for row in tables["methods"]] == ["strategy", "evercal", "joint"]
    assert tables["differences"][1][:2] == ["evercal - joint", "+40.0"]
    # Without remembered frames, ablation and other folders.
    assert list(tables) == ["methods", "thresholds", "scenes", "differences"]
    text = tables_text(tables, "terminal")
    assert all(TITLES[name] in text for name in tables)
    assert "TFR (total forgetting rate): mean drop" in text


def test_results_under_other_settings_are_compared(tmp_path: Path) -> None:
    large, small = folder(tmp_path, "large", 18), folder(tmp_path, "small", 14, memory_share=0.01)
    tables = read_report(large, "evercal", [small]).tables()
    assert [row[0] for row in tables["methods"][1:]] == ["evercal", "joint"]
    header, *rows = tables["compare_with"]
    final, memory = header.index("final %"), header.index("memory MB")
    # Joint training needs all frames again, so it has no memory to compare.
    assert [(row[0], row[final], row[memory]) for row in rows] == [
        ("evercal (small)", "70.0", "2.0"),
        ("joint (small)", "50.0", "-"),
    ]


@pytest.mark.parametrize(
    ("key", "value"),
    [("suite", "real2"), ("scenes", [["a", 9, 20]]), ("judged", "held-out training frames")],
)
def test_results_of_other_scenes_are_refused(tmp_path: Path, key: str, value: object) -> None:
    here, there = folder(tmp_path, "here", 18), folder(tmp_path, "there", 18, **{key: value})
    with pytest.raises(InputError, match=f"there: {key} is .*compare results of the same frames"):
        read_report(here, "evercal", [there])


def test_missing_results_and_settings_are_refused(tmp_path: Path) -> None:
    here = folder(tmp_path, "here", 18)
    with pytest.raises(InputError, match="nowhere: no results here"):
        read_report(here, "evercal", [tmp_path / "nowhere"])
    (here / SETTINGS).unlink()
    with pytest.raises(InputError, match="no settings in JSON"):
        read_report(here, "evercal")


def test_strategies_are_ranked_and_seven_plotted(tmp_path: Path) -> None:
    here = folder(tmp_path, "here", 12)
    for seed in (0, 1):
        results.append(here, lines("er", seed, [[16], [4, 4]]))
    for correct, name in enumerate(("gem", "agem", "mir", "gss", "der", "co2l"), start=14):
        results.append(here, lines(name, 0, [[16], [correct, correct]]))
    report = read_report(here, "evercal")
    ranked = ["co2l", "der", "gss", "mir", "agem", "gem", "evercal", "joint", "er"]
    assert [row[0] for row in report.tables()["methods"][1:]] == ranked
    assert report.plotted == ["evercal", "er", "co2l", "der", "gss", "mir", "agem"]
