"""The paper's table from outcomes."""

import math

import pytest

from evercal.continual.benchmark.comparison import runs_of
from evercal.continual.benchmark.latex import PUBLISHED, paper_table
from evercal.continual.benchmark.results import SceneResult


def result(strategy: str, stage: int, scene: str, errors: list[float]) -> SceneResult:
    return SceneResult(
        strategy,
        0,
        stage,
        scene,
        tuple(str(i) for i in range(len(errors))),
        tuple(errors),
        tuple(math.radians(100 * e) if math.isfinite(e) else e for e in errors),
        (False,) * len(errors),
        (False,) * len(errors),
        seconds=1.0,
        memory_bytes=0,
        head_bytes=0,
        frames_kept=0,
    )


RUNS = runs_of(
    [
        result("sars_spdd", 0, "a_1", [0.005, 0.008, 0.02]),
        result("sars_spdd", 1, "a_1", [0.005, 0.02, 0.3]),
        result("sars_spdd", 1, "b", [0.008, math.inf, math.inf]),
    ]
)


@pytest.mark.parametrize(
    ("suite", "first", "mean", "tfr"),
    [("custom", "2.0 & 2.0 & 66.7", "50.0", "33.3"), ("sim", "2.0 & 2.0 & 33.3", "33.3", "33.3")],
)
def test_scenes_down_and_methods_across(suite: str, first: str, mean: str, tfr: str) -> None:
    lines = paper_table(RUNS, suite).splitlines()
    assert lines[2] == r"Recording & \multicolumn{3}{c}{sars\_spdd} \\"
    assert rf"a\_1 & {first} \\" in lines
    assert r"b & $\infty$ & $\infty$ & 33.3 \\" in lines
    assert [line.split("&")[-1].split()[0] for line in lines if line[:4] in ("Mean", "TFR ")] == [
        mean,
        tfr,
    ]
    assert len({line.count("&") for line in lines if line.endswith(r"\\")} - {1}) == 1


def test_published_numbers_stand_beside_ours_where_the_data_are_the_same() -> None:
    text = paper_table(RUNS, "i7s")
    assert r"Mean, published &  &  & 74.9 \\" in text
    assert r"TFR, published &  &  & 6.7 \\" in text  # 6.65
    assert "published" not in paper_table(RUNS, "sim-7")
    joint = runs_of([result("der", 1, scene, [0.01]) for scene in ("a", "b")])
    assert r"Mean, published &  &  & -- \\" in paper_table(joint, "i12s")
    # The paper's own table: SARS and SPDD against the best of the others.
    for suite in PUBLISHED.values():
        assert suite["sars_spdd"][0] > max(suite[name][0] for name in ("icarl", "buff_cs", "gdr"))
