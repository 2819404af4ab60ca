"""The same results from a cluster (Ray on this machine) as from a plain loop."""

from __future__ import annotations

import io
import os
import pickle
import sys
import tarfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest

from evercal.continual.benchmark import ray_runs as cluster
from evercal.continual.benchmark.bench import BenchOptions, run_bench
from evercal.continual.benchmark.ray_runs import run_on_ray
from evercal.continual.benchmark.results import SceneResult, append, read
from evercal.continual.strategies import Strategy, strategy_named
from evercal.errors import InputError
from tests.continual.benchmark.test_comparison import lines

if TYPE_CHECKING:
    from evercal.continual.stage import StageOptions
    from evercal.recordings import Recording


def told(folder: Path) -> list[SceneResult]:
    found = [replace(result, seconds=0.0) for result in read(folder)]
    return sorted(found, key=lambda o: (o.strategy, o.seed, o.stage, o.scene))


@pytest.mark.slow
def test_a_cluster_gives_what_a_loop_gives(
    arcs: tuple[Recording, Recording], arc_stage: StageOptions, tmp_path: Path
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


@pytest.mark.slow
def test_a_worker_of_a_cluster_that_dies_is_replaced(
    arcs: tuple[Recording, Recording], arc_stage: StageOptions, tmp_path: Path
) -> None:
    pytest.importorskip("ray", reason="the extra 'ray' is not installed")
    flag, here = tmp_path / "died", os.getpid()

    def stage(seed: int) -> StageOptions:
        if os.getpid() != here and not flag.exists():
            flag.touch()
            os._exit(1)
        fit = replace(arc_stage.fit, iterations=4, batch=64, replay_batch=32)
        return replace(arc_stage, fit=fit, seed=seed)

    few = [replace(scene, train=scene.train[:18], test=scene.test[:3]) for scene in arcs]
    options = BenchOptions(stage, (strategy_named("evercal"),), seeds=(0,), short_side=120)
    said: list[str] = []
    out = tmp_path / "out"
    steps = list(run_on_ray(few, options, out, "local", None, said.append))
    assert [step.done for step in steps] == [1, 2]
    (line,) = said
    assert line.startswith("run evercal-0, try 1 of 4: WorkerCrashedError: ")
    assert line.count("\n") == 0
    assert len(read(out)) == 3


class FakeRay:
    """Ray's functions that are used here; tasks run in this process, the newest first."""

    def __init__(self, crashes: int = 0, gpus: int = 0) -> None:
        self.crashes, self.ran = crashes, 0
        self.up, self.gpus, self.asked = False, gpus, -1

    def init(self, **_: object) -> None:
        self.up = True

    def shutdown(self) -> None:
        self.up = False

    def put(self, value: object) -> object:
        return value

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": 2.0} | ({"GPU": float(self.gpus)} if self.gpus else {})

    def remote(self, max_retries: int, num_gpus: int) -> Callable[[Any], Any]:
        assert max_retries == 0
        self.asked = num_gpus
        return lambda function: SimpleNamespace(remote=partial(_Task, function))

    def wait(self, tasks: list[Any], num_returns: int) -> tuple[list[Any], list[Any]]:
        assert num_returns == 1
        return [tasks[-1]], tasks[:-1]

    def get(self, task: Any) -> Any:
        self.ran += 1
        if self.ran <= self.crashes:
            raise RuntimeError("The worker died.\nLogs above.\nIt ran out of memory.")
        return pickle.loads(pickle.dumps(task.function(*task.arguments)))


class _Task:
    def __init__(self, function: Any, *arguments: object) -> None:
        self.function, self.arguments = function, arguments


SCENES: list[Any] = [SimpleNamespace(name=n, train=[], test=[]) for n in ("one", "two")]


@dataclass
class Bench:
    """Takes the place of `run_bench`: two stages that each add a line; fails where it is told."""

    fail: dict[str, list[int]]
    """By strategy: before which stage each of its next runs fails."""
    error: type[Exception] = RuntimeError
    began: list[tuple[str, int, bool]] = field(default_factory=list)
    """Strategy, stages that were there, and whether the folder lies in the folder of results."""

    def __call__(self, scenes: list[Any], options: BenchOptions, folder: Path) -> Iterator[Any]:
        (asked,), (seed,) = options.strategies, options.seeds
        strategy = asked.name
        there = len({o.stage for o in read(folder)})
        self.began.append((strategy, there, "ray" in folder.parts))
        stops = self.fail.get(strategy, [])
        stop = stops.pop(0) if stops else 2
        (folder / "views").mkdir(exist_ok=True)
        (folder / "features").mkdir(exist_ok=True)
        (folder / "features" / "large").write_bytes(bytes(1000))
        for stage in range(there, 2):
            if stage == stop:
                raise self.error(f"first line\nstage {stage} of {strategy}")
            append(folder, lines(strategy, seed, [[16], [14, 12]])[stage : 2 * stage + 1])
            (folder / "views" / f"{strategy}-{stage}.npz").write_bytes(b"view")
            yield stage


def start(
    monkeypatch: pytest.MonkeyPatch, ray: FakeRay, bench: Bench, shared: bool, device: str = "auto"
) -> Callable[[Path], tuple[list[str], list[str], str]]:
    """A run on the fake: names of the steps, lines of failures, the error at the end."""
    monkeypatch.setattr(cluster, "_ray", lambda: ray)
    monkeypatch.setattr(cluster, "run_bench", bench)
    monkeypatch.setattr(cluster, "begin_bench", lambda _s, o, _f: [(0, n) for n in o.strategies])
    if not shared:
        monkeypatch.setattr(cluster, "_reads", lambda _: None)

    def run(out: Path) -> tuple[list[str], list[str], str]:
        options = BenchOptions(lambda _: None, (Strategy("ours"), Strategy("theirs")), (0,))  # pyright: ignore[reportArgumentType]
        options = replace(options, device=device)
        said: list[str] = []
        steps, error = [], ""
        try:
            for step in run_on_ray(SCENES, options, out, "local", None, said.append):
                steps.append(f"{step.strategy} {step.done}/{step.total}")
        except InputError as raised:
            error = str(raised)
        assert not ray.up
        return steps, said, error

    return run


@pytest.mark.parametrize("shared", [True, False])
def test_a_failed_run_goes_on_inside_its_sequence(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, shared: bool
) -> None:
    bench = Bench({"ours": [1, 1]})
    steps, said, error = start(monkeypatch, FakeRay(), bench, shared)(tmp_path)
    assert steps == ["ours 1/4", "ours 2/4", "theirs 3/4", "theirs 4/4"] or steps == [
        "theirs 1/4",
        "theirs 2/4",
        "ours 3/4",
        "ours 4/4",
    ]
    assert error == ""
    assert said == [
        f"run ours-0, try {n} of 4: RuntimeError: stage 1 of ours; goes on from its last checkpoint"
        for n in (1, 2)
    ]
    # The second and third try find the first stage done.
    assert [b for b in bench.began if b[0] == "ours"] == [
        ("ours", there, shared) for there in (0, 1, 1)
    ]
    found = sorted(read(tmp_path), key=lambda o: (o.strategy, o.stage, o.scene))
    expected = lines("ours", 0, [[16], [14, 12]]) + lines("theirs", 0, [[16], [14, 12]])
    assert found == sorted(expected, key=lambda o: (o.strategy, o.stage, o.scene))
    assert {path.name for path in (tmp_path / "views").iterdir()} == {
        f"{name}-{stage}.npz" for name in ("ours", "theirs") for stage in (0, 1)
    }
    # Nothing of the work is left.
    assert [path.name for path in (tmp_path / "runs" / "ray").iterdir()] == ["shared"]


def test_what_is_sent_back_holds_no_features(tmp_path: Path) -> None:
    for name in ("features", "runs"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "data").write_bytes(bytes(10))
    with tarfile.open(fileobj=io.BytesIO(cluster._archive(tmp_path))) as archive:
        assert archive.getnames() == ["runs", "runs/data"]


def test_a_run_that_fails_for_good_is_told_after_the_others(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench = Bench({"theirs": [1] * 9})
    run = start(monkeypatch, FakeRay(), bench, shared=True)
    steps, said, error = run(tmp_path)
    assert steps == ["ours 1/4", "ours 2/4"]
    assert len(said) == 4
    assert said[-1].endswith("given up")
    assert error.startswith("1 of 2 runs failed: theirs-0 (RuntimeError: stage 1 of theirs);")
    assert "\n" not in error
    # The same command later goes on where it stood.
    bench.fail.clear()
    assert {o.strategy for o in read(tmp_path)} == {"ours"}
    run(tmp_path)
    assert ("theirs", 1, True) in bench.began[5:]


def test_what_would_fail_again_is_not_tried_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench = Bench({"theirs": [0] * 9}, InputError)
    steps, said, error = start(monkeypatch, FakeRay(), bench, shared=True)(tmp_path)
    assert steps == ["ours 1/4", "ours 2/4"]
    assert len(said) == 1
    assert "theirs-0 (InputError: stage 0 of theirs)" in error


def test_a_worker_that_dies_is_replaced(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    steps, said, error = start(monkeypatch, FakeRay(crashes=2), Bench({}), shared=True)(tmp_path)
    assert len(steps) == 4
    assert error == ""
    assert [line.split(": ", 1)[1] for line in said] == [
        "RuntimeError: It ran out of memory.; goes on from its last checkpoint"
    ] * 2


@pytest.mark.parametrize(
    ("device", "there", "asked"),
    [("auto", 2, 1), ("cuda", 1, 1), ("cpu", 2, 0), ("auto", 0, 0)],
)
def test_a_task_asks_for_a_gpu_where_it_may_use_one(
    device: str, there: int, asked: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    # Ray hides all GPUs from a task that asks for none.
    ray = FakeRay(gpus=there)
    start(monkeypatch, ray, Bench({}), True, device)(tmp_path)
    assert ray.asked == asked


def test_a_cluster_without_gpus_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    _, _, error = start(monkeypatch, FakeRay(), Bench({}), True, "cuda")(tmp_path)
    assert error == "device 'cuda': the cluster has no GPU; take auto or cpu"


def test_failures_go_to_stderr(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    start(monkeypatch, FakeRay(), Bench({"ours": [1]}), shared=True)
    options = BenchOptions(lambda _: None, (Strategy("ours"),), (0,))  # pyright: ignore[reportArgumentType]
    list(run_on_ray(SCENES, options, tmp_path, "local"))
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.startswith("run ours-0, try 1 of 4: RuntimeError: stage 1 of ours;")
    assert told.err.count("\n") == 1


def test_without_the_extra_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"pip install 'evercal\[ray\]'"):
        cluster._ray()
