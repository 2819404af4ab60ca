"""The same results from a cluster (Ray on this machine) as from a plain loop."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from evercal.benchmark import ray_runs as cluster
from evercal.benchmark.bench import BenchOptions, run_bench
from evercal.benchmark.ray_runs import run_on_ray
from evercal.benchmark.results import SceneResult, read
from evercal.continual.strategies import strategy_named
from evercal.errors import InputError

if TYPE_CHECKING:
    from evercal.continual.stage import StageOptions
    from evercal.datasets import Scene


def told(folder: Path) -> list[SceneResult]:
    found = [replace(result, seconds=0.0) for result in read(folder)]
    return sorted(found, key=lambda o: (o.strategy, o.seed, o.stage, o.scene))


@pytest.mark.slow
def test_a_cluster_gives_what_a_loop_gives(
    arcs: tuple[Scene, Scene], arc_stage: StageOptions, tmp_path: Path
) -> None:
    pytest.importorskip("ray", reason="the extra 'ray' is not installed")

    def stage(seed: int) -> StageOptions:
        fit = replace(arc_stage.fit, iterations=4, batch=64, replay_batch=32)
        encode = replace(arc_stage.encode, views_per_frame=1, seed=seed)
        return replace(arc_stage, fit=fit, encode=encode, replay_views_per_frame=1, seed=seed)

    few = [replace(scene, train=scene.train[:18], test=scene.test[:3]) for scene in arcs]
    options = BenchOptions(
        stage, tuple(map(strategy_named, ("evercal", "joint"))), seeds=(0,), short_side=120
    )
    plain, spread = tmp_path / "plain", tmp_path / "spread"
    list(run_bench(few, replace(options, strategies=options.strategies[1:]), spread))
    steps = list(run_on_ray(few, options, spread, "local"))
    assert [(s.strategy, s.done, s.total) for s in steps] == [("evercal", 3, 4), ("evercal", 4, 4)]
    list(run_bench(few, options, plain))
    names = [sorted(path.name for path in (at / "views").iterdir()) for at in (plain, spread)]
    assert (
        names[0]
        == names[1]
        == [f"{s.name}-{r}.npz" for s in options.strategies for r in ("one", "two")]
    )
    for a, b in zip(told(plain), told(spread), strict=True):
        assert (a.strategy, a.stage, a.scene, a.frames) == (b.strategy, b.stage, b.scene, b.frames)
        # Another process may use another number of threads, and sums round otherwise.
        assert a.memory_bytes == b.memory_bytes
        assert a.wrong_scene == pytest.approx(b.wrong_scene)
    assert list(run_on_ray(few, options, spread, "local")) == []


def test_without_the_extra_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"pip install 'evercal\[ray\]'"):
        cluster._ray()
