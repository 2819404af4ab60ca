"""Runs on a cluster give the results of a loop, also after failures."""

from __future__ import annotations

import os
import pickle
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pytest

from evercal.continual.benchmark.bench import BenchOptions, run_bench
from evercal.continual.benchmark.ray_runs import run_on_ray
from evercal.continual.benchmark.results import KEY, read
from evercal.continual.strategies import strategy_named
from evercal.errors import InputError
from evercal.recordings import Frame, Recording

if TYPE_CHECKING:
    from evercal.continual.learning.stage import StageOptions


@pytest.fixture
def scenes(arcs: tuple[Recording, Recording]) -> list[Recording]:
    return [replace(scene, train=scene.train[:18], test=scene.test[:3]) for scene in arcs]


@pytest.fixture
def options(arc_stage: StageOptions) -> BenchOptions:
    def stage(seed: int) -> StageOptions:
        fit = replace(arc_stage.fit, iterations=4, batch=64, replay_batch=32)
        encode = replace(arc_stage.encode, views_per_frame=1, seed=seed)
        return replace(arc_stage, fit=fit, encode=encode, replay_views_per_frame=1, seed=seed)

    return BenchOptions(stage, (strategy_named("evercal"),), seeds=(0,), short_side=120)


def comparable(folder: Path) -> pd.DataFrame:
    return read(folder).drop(columns="seconds").sort_values(KEY, ignore_index=True)


@pytest.mark.slow("src/evercal/continual/benchmark")
def test_cluster_gives_the_results_of_a_loop(
    scenes: list[Recording], options: BenchOptions, tmp_path: Path
) -> None:
    pytest.importorskip("ray", reason="the extra 'ray' is not installed")
    options = replace(options, strategies=(*options.strategies, strategy_named("joint")))
    plain, spread = tmp_path / "plain", tmp_path / "spread"
    list(run_bench(scenes, replace(options, strategies=options.strategies[1:]), spread))
    steps = list(run_on_ray(scenes, options, spread, "local"))
    assert [(s.strategy, s.done, s.total) for s in steps] == [("evercal", 3, 4), ("evercal", 4, 4)]
    list(run_bench(scenes, options, plain))
    # Processes with other numbers of threads round sums differently.
    for name in (*KEY, "frames", "wrong_scene", "memory_bytes"):
        assert comparable(plain)[name].tolist() == comparable(spread)[name].tolist()
    assert list(run_on_ray(scenes, options, spread, "local")) == []


@pytest.mark.slow("src/evercal/continual/benchmark")
def test_run_of_a_dead_worker_is_retried(
    scenes: list[Recording],
    options: BenchOptions,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pytest.importorskip("ray", reason="the extra 'ray' is not installed")
    flag, here = tmp_path / "died", os.getpid()

    def stage(seed: int) -> StageOptions:
        if os.getpid() != here and not flag.exists():
            flag.touch()
            os._exit(1)
        return options.stage(seed)

    with_exit = replace(options, stage=stage)
    steps = list(run_on_ray(scenes, with_exit, tmp_path / "out", "local"))
    assert [step.done for step in steps] == [1, 2]
    error = capsys.readouterr().err
    assert error.startswith("run evercal-0, attempt 1 of 4: WorkerCrashedError: ")
    assert error.count("\n") == 1


class InProcessRay:
    """Runs tasks in this process when their results are requested.

    Args:
        shares_disk: Whether workers see the folder of results.
        crashes: Number of tasks that die before they start.
        gpus: GPUs of the cluster.
    """

    def __init__(self, shares_disk: bool = True, crashes: int = 0, gpus: int = 0) -> None:
        self.shares_disk, self.crashes, self.gpus = shares_disk, crashes, gpus
        self.requested_gpus = -1

    def init(self, **_: object) -> None: ...

    def shutdown(self) -> None: ...

    def put(self, value: object) -> object:
        return value

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": 2.0} | ({"GPU": float(self.gpus)} if self.gpus else {})

    def remote(self, max_retries: int, num_gpus: int) -> Callable[[Any], Any]:
        self.requested_gpus = num_gpus
        return _Remote

    def wait(self, tasks: list[Any], num_returns: int) -> tuple[list[Any], list[Any]]:
        return tasks[:1], tasks[1:]

    def get(self, task: Any) -> Any:
        scenes, job = task.arguments
        if self.crashes:
            self.crashes -= 1
            raise RuntimeError("The worker died.\nLogs above.\nIt ran out of memory.")
        if not self.shares_disk:
            (job.out / "runs" / "shared").unlink(missing_ok=True)
        return pickle.loads(pickle.dumps(task.function(scenes, job)))


@dataclass(eq=False)
class _Remote:
    function: Any
    arguments: tuple[Any, ...] = ()

    def remote(self, *arguments: object) -> _Remote:
        return _Remote(self.function, arguments)


class FailingFrame(Frame):
    """A test frame that cannot be read until `repaired` exists."""

    repaired: Path
    error: type[Exception] = RuntimeError

    def read_image(self) -> np.ndarray:
        if not self.repaired.exists():
            self.repaired.touch()
            raise self.error("first line\nthe disk is gone")
        return super().read_image()


def failing_once(scene: Recording, flag: Path, error: type[Exception]) -> Recording:
    first = scene.test[0]
    kind = type("Failing", (FailingFrame,), {"repaired": flag, "error": error})
    frame = kind(first.name, first.image, first.camera, first.base_from_camera)
    return replace(scene, test=(frame, *scene.test[1:]))


def test_failed_run_resumes_after_its_last_stage(
    scenes: list[Recording],
    options: BenchOptions,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(sys.modules, "ray", InProcessRay())
    failing = [scenes[0], failing_once(scenes[1], tmp_path / "flag", RuntimeError)]
    out = tmp_path / "out"
    steps = list(run_on_ray(failing, options, out, "local"))
    assert [step.done for step in steps] == [1, 2]
    assert capsys.readouterr().err == (
        "run evercal-0, attempt 1 of 4: RuntimeError: the disk is gone; resuming after its last"
        " stage\n"
    )
    list(run_bench(scenes, options, tmp_path / "plain"))
    pd.testing.assert_frame_equal(comparable(out), comparable(tmp_path / "plain"))


def test_workers_without_the_disk_are_refused(
    scenes: list[Recording],
    options: BenchOptions,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "ray", InProcessRay(shares_disk=False))
    with pytest.raises(InputError, match=r"a worker does not see .* on a shared disk"):
        list(run_on_ray(scenes, options, tmp_path, "local"))


def test_input_errors_are_not_retried(
    scenes: list[Recording],
    options: BenchOptions,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(sys.modules, "ray", InProcessRay())
    failing = [failing_once(scenes[0], tmp_path / "flag", InputError), scenes[1]]
    with pytest.raises(InputError, match=r"1 of 1 runs failed: evercal-0 \(InputError: first"):
        list(run_on_ray(failing, options, tmp_path / "out", "local"))
    assert "attempt 1 of 4" in capsys.readouterr().err
    # The same command resumes later.
    assert len(list(run_on_ray(failing, options, tmp_path / "out", "local"))) == 2


def test_run_is_given_up_after_four_crashes(
    scenes: list[Recording],
    options: BenchOptions,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(sys.modules, "ray", InProcessRay(crashes=4))
    with pytest.raises(InputError, match="RuntimeError: It ran out of memory"):
        list(run_on_ray(scenes, options, tmp_path, "local"))
    messages = capsys.readouterr().err.splitlines()
    actions = [message.rpartition("; ")[2] for message in messages]
    assert actions == [*["resuming after its last stage"] * 3, "given up"]


@pytest.mark.parametrize(
    ("device", "available", "requested"),
    [("auto", 2, 1), ("cuda", 1, 1), ("cpu", 2, 0), ("auto", 0, 0)],
)
def test_task_requests_a_gpu_if_it_may_use_one(
    scenes: list[Recording],
    options: BenchOptions,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    device: str,
    available: int,
    requested: int,
) -> None:
    ray = InProcessRay(crashes=4, gpus=available)
    monkeypatch.setitem(sys.modules, "ray", ray)
    with pytest.raises(InputError, match="out of memory"):
        list(run_on_ray(scenes, replace(options, device=device), tmp_path, "local"))
    assert ray.requested_gpus == requested


def test_missing_gpu_and_missing_extra_are_refused(
    scenes: list[Recording],
    options: BenchOptions,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "ray", InProcessRay())
    with pytest.raises(InputError, match="device 'cuda': the cluster has no GPU"):
        list(run_on_ray(scenes, replace(options, device="cuda"), tmp_path, "local"))
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"pip install 'ray>=2\.50'"):
        list(run_on_ray(scenes, options, tmp_path, "local"))
