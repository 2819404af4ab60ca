"""Published numbers keep every frame correct or incorrect, and tables unchanged."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from evercal.continual.benchmark.published import (
    COUNTED,
    Published,
    PublishedScene,
    from_bench,
    read_published,
    write_published,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from evercal.continual.benchmark.comparison import (
    AREA,
    difference,
    method_rows,
    runs_of,
    threshold_rows,
)
from evercal.continual.benchmark.results import SETTINGS, SceneResult, append, read
from evercal.errors import InputError
from evercal.storage import write_json
from tests.continual.benchmark.test_comparison import OURS, THEIRS, lines
from tests.continual.benchmark.test_results import result


def bench(folder: Path, results: list[SceneResult]) -> Path:
    folder.mkdir(exist_ok=True)
    write_json(folder / SETTINGS, {"suite": "two"})
    append(folder, results)
    return folder


def published(tmp_path: Path, results: list[SceneResult]) -> Published:
    """Publish results, and check that they are read as they were written."""
    summary = from_bench(bench(tmp_path / "run", results), "two", "a note")
    path = write_published(tmp_path, summary)
    assert read_published(path) == summary
    return summary


def test_tables_equal_those_of_the_bench(tmp_path: Path) -> None:
    summary = published(tmp_path, OURS + THEIRS)
    runs, before = runs_of(summary.results()), runs_of(read(tmp_path / "run"))
    header, *rows = method_rows(runs)
    # Errors are rounded to a tenth of a millimetre: 0.05 % of 20 cm.
    rounded = {header.index(name) for name in (AREA, "median cm, right scene")}
    for row, expected in zip(rows, method_rows(before)[1:], strict=True):
        for column, (cell, other) in enumerate(zip(row, expected, strict=True)):
            if column in rounded:
                assert float(cell) == pytest.approx(float(other), abs=0.11)
            else:
                assert cell == other
    for ours, theirs in zip(threshold_rows(runs)[1:], threshold_rows(before)[1:], strict=True):
        assert ours[2:] == theirs[2:]
        assert float(ours[1]) == pytest.approx(float(theirs[1]), abs=0.11)
    assert difference(runs[:2], runs[2:]) == difference(before[:2], before[2:])


def test_earlier_stages_are_counts(tmp_path: Path) -> None:
    results = published(tmp_path, OURS).results()
    kinds = {(type(result), result.stage) for result in results}
    assert kinds == {(PublishedScene, 0), (SceneResult, 1)}
    first = results[0]
    assert isinstance(first, PublishedScene)
    assert (first.frames, first.within) == (20, (16, 16, 0, 0, 0))
    assert first.accuracy() == 0.8
    with pytest.raises(KeyError):
        first.accuracy((0.03, 0.1))


ERRORS = st.floats(0, 0.12) | st.sampled_from([0.005, 0.01, 0.02, 0.05, 0.1, math.inf])


@settings(max_examples=60)
@given(
    st.lists(
        st.tuples(ERRORS, ERRORS.map(lambda v: math.radians(100 * v)), st.booleans()),
        min_size=2,
        max_size=12,
    )
)
def test_no_frame_changes_between_correct_and_incorrect(
    tmp_path_factory: pytest.TempPathFactory, frames: list[tuple[float, float, bool]]
) -> None:
    posed = [math.isfinite(m) and math.isfinite(r) for m, r, _ in frames]
    both = list(zip(frames, posed, strict=True))
    one = result(
        frames=tuple(f"f{i}" for i in range(len(frames))),
        translation_m=tuple(f[0] if p else math.inf for f, p in both),
        rotation_rad=tuple(f[1] if p else math.inf for f, p in both),
        wrong_scene=tuple(f[2] and not p for f, p in both),
        near_training_frame=(False,) * len(frames),
        squared_mahalanobis=tuple(5.0 + 10 * f[2] if p else math.nan for f, p in both),
    )
    summary = published(tmp_path_factory.mktemp("b"), [one])
    (whole,) = summary.results()
    assert isinstance(whole, SceneResult)
    # Results on disk have six digits.
    six = replace(
        one,
        translation_m=tuple(round(v, 6) if math.isfinite(v) else v for v in one.translation_m),
        rotation_rad=tuple(round(v, 6) if math.isfinite(v) else v for v in one.rotation_rad),
    )
    (counted,) = summary.scenes
    for bound, count in zip(COUNTED, counted.within, strict=True):
        assert whole.correct(bound).tolist() == six.correct(bound).tolist()
        assert count == six.correct(bound).sum() == round(counted.accuracy(bound) * len(frames))
    assert whole.refused.tolist() == one.refused.tolist()
    assert whole.wrong_scene == one.wrong_scene
    assert counted.refused == one.refused.sum()
    assert counted.stated_95 == sum(posed)
    inside = np.array(one.squared_mahalanobis) < 12.59
    assert (np.array(whole.squared_mahalanobis) < 12.59).tolist() == inside.tolist()
    assert counted.inside_95 == inside.sum()
    good = np.isfinite(six.translation_m)
    gap = np.array(whole.translation_m)[good] - np.array(six.translation_m)[good]
    assert (np.abs(gap) <= 0.51e-4).all()


def test_incomplete_and_inconsistent_runs_are_not_published(tmp_path: Path) -> None:
    incomplete = lines("late", 0, [[16]])
    summary = published(tmp_path, OURS + incomplete)
    assert {scene.strategy for scene in summary.scenes} == {"ours"}
    with pytest.raises(InputError, match="no run is complete"):
        from_bench(tmp_path / "nowhere", "x")
    other = [replace(line, frames=tuple(f"x{i}" for i in range(20))) for line in THEIRS]
    with pytest.raises(InputError, match=r"runs use different test frames of \w"):
        from_bench(bench(tmp_path / "mixed", OURS + other), "x")


def test_changed_settings_and_broken_lines_are_refused(tmp_path: Path) -> None:
    published(tmp_path, OURS)
    path = tmp_path / "two.jsonl"
    good = path.read_text()
    path.write_text(good.replace('"suite":"two"', '"suite":"three"'))
    with pytest.raises(InputError, match="settings do not match their hash"):
        read_published(path)
    path.write_text(good + '["ours", 1, 2]\n')
    with pytest.raises(InputError, match=r"line 8 is not a published result"):
        read_published(path)
    path.write_text("")
    with pytest.raises(InputError, match="line 1"):
        read_published(path)


def test_results_of_a_large_suite_stay_small(tmp_path: Path) -> None:
    """Seven scenes of 39 frames, 25 strategies, three seeds, errors up to 3 m."""
    rng = np.random.default_rng(0)
    frames = tuple(f"test-{i:06d}" for i in range(39))
    results = []
    for strategy in range(25):
        for seed in range(3):
            for stage in range(7):
                for scene in range(stage + 1):
                    errors = tuple(np.exp(rng.uniform(-7, 1, 39)).tolist())
                    line = result(
                        stage,
                        f"bedroom-{scene}",
                        strategy=f"a_strategy_{strategy}",
                        seed=seed,
                        frames=frames,
                        translation_m=errors,
                        rotation_rad=errors,
                        wrong_scene=(False,) * 39,
                        near_training_frame=(False,) * 39,
                    )
                    results.append(line)
    path = write_published(tmp_path, from_bench(bench(tmp_path / "run", results), "large"))
    assert path.stat().st_size < 500_000
    assert json.loads(path.read_text().splitlines()[0])["kind"] == "bench"
