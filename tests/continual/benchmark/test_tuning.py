"""Tuning tries every weight, two more beyond an end, and writes the trials."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd
import pytest

from evercal.continual.benchmark import tuning
from evercal.continual.benchmark.strategy_run import BenchOptions
from evercal.continual.benchmark.tuning import TUNED, beyond, run_tuning
from evercal.continual.strategies import strategy_named
from evercal.errors import InputError

if TYPE_CHECKING:
    from evercal.continual.learning.stage import StageOptions
    from evercal.recordings import Recording

    Arcs = tuple[Recording, Recording]


@pytest.fixture
def options(arc_stage: StageOptions) -> BenchOptions:
    fit = replace(arc_stage.fit, iterations=3, batch=64, replay_batch=32)
    encode = replace(arc_stage.encode, views_per_frame=1)
    stage = replace(arc_stage, fit=fit, encode=encode, replay_views_per_frame=1)
    strategies = strategy_named("er"), strategy_named("gec")
    return BenchOptions(
        lambda seed: replace(stage, seed=seed), strategies, (0,), short_side=120
    )


def test_trials_are_tabulated(
    arcs: Arcs, options: BenchOptions, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenes = [
        replace(scene, train=scene.train[:18], test=scene.test[:9:4]) for scene in arcs
    ]
    trials = {"weight": (0.5, 1.0, 2.0), "alpha": (4.0, 8.0, 16.0)}
    monkeypatch.setattr(tuning, "TRIALS", trials)

    def beyond_trials(areas: pd.Series) -> tuple[float, ...]:
        assert len(areas) == 3, "weights beyond an end are no trials"
        return (1 / 7, 7.0)

    monkeypatch.setattr(tuning, "beyond", beyond_trials)
    steps = list(run_tuning(scenes, options, tmp_path))
    assert len(steps) == 20
    table = pd.read_csv(tmp_path / TUNED)
    rows = list(table[["method", "value"]].itertuples(index=False, name=None))
    tried = [("er", w) for w in (0.142857, 0.5, 1.0, 2.0, 7.0)]
    tried += [("gec", w) for w in (0.142857, 4.0, 7.0, 8.0, 16.0)]
    assert rows == tried
    assert table["auc_20cm"].to_numpy() == pytest.approx(
        (table["auc_earlier"] + table["auc_newest"]) / 2, abs=0.011
    )
    # Everything is there: the same call runs nothing.
    assert list(run_tuning(scenes, options, tmp_path)) == []


def test_two_weights_follow_beyond_an_end_only() -> None:
    def after(*areas: float) -> list[float]:
        weights = [0.1, 0.3, 1.0, 3.0, 10.0]
        return list(beyond(pd.Series(areas, index=pd.Index(weights))))

    assert after(1, 2, 3, 2, 1) == []
    assert after(1, 2, 3, 9, 4) == []
    assert after(1, 2, 3, 4, 5) == pytest.approx([33.3, 111.1], rel=1e-2)
    assert after(5, 4, 3, 2, 1) == pytest.approx([0.0333, 0.0111], rel=1e-2)


def test_strategy_without_a_weight_is_refused(
    arcs: Arcs, options: BenchOptions, tmp_path: Path
) -> None:
    options = replace(options, strategies=(strategy_named("finetune"),))
    with pytest.raises(InputError, match="no strategy to tune"):
        list(run_tuning(arcs, options, tmp_path))
