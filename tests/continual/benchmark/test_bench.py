"""The benchmark runs what is missing, once, and an interruption does not change results."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from evercal.continual.benchmark.bench import BenchOptions, Step, begin_bench, in_order, run_bench
from evercal.continual.benchmark.comparison import runs_of
from evercal.continual.benchmark.environment import environment
from evercal.continual.benchmark.results import (
    NETWORK,
    RESULTS,
    SETTINGS,
    STRATEGIES,
    SceneResult,
    read,
    read_environments,
    read_strategies,
)
from evercal.continual.benchmark.suites import SUITES, load_suite, regions, tuning_split
from evercal.continual.learning.presets import on_paper_backbone
from evercal.continual.methods.replay import Replay
from evercal.continual.store import NetworkStore
from evercal.continual.strategies import Strategy, strategy_named
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings import Frame, Recording

if TYPE_CHECKING:
    from evercal.continual.learning.stage import StageOptions

Arcs = tuple[Recording, Recording]
CAMERA = Camera(4, 3, 4.0, 4.0, 1.5, 1.0)


def named(*names: str) -> tuple[Strategy, ...]:
    return tuple(strategy_named(name) for name in names)


@pytest.fixture(scope="module")
def arcs(arcs: Arcs) -> Arcs:
    """The arcs with eight of their test frames."""
    one, two = (replace(scene, test=scene.test[::3]) for scene in arcs)
    return one, two


@pytest.fixture(scope="module")
def options(arc_stage: StageOptions) -> BenchOptions:
    def stage(seed: int) -> StageOptions:
        fit = replace(arc_stage.fit, iterations=12, batch=128, replay_batch=64)
        encode = replace(arc_stage.encode, views_per_frame=1, seed=seed)
        return replace(arc_stage, fit=fit, encode=encode, replay_views_per_frame=1, seed=seed)

    return BenchOptions(stage, named("er", "finetune", "joint"), seeds=(0,), short_side=120)


def comparable(results: list[SceneResult]) -> list[SceneResult]:
    """Results without times, sorted."""
    plain = [replace(result, seconds=0.0) for result in results]
    return sorted(plain, key=lambda r: (r.strategy, r.stage, r.scene))


@pytest.fixture(scope="module")
def complete(
    arcs: Arcs, options: BenchOptions, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, list[Step]]:
    """The folder of a complete benchmark, and its steps."""
    out = tmp_path_factory.mktemp("bench")
    return out, list(run_bench(arcs, options, out))


def test_all_learned_scenes_are_evaluated_after_every_stage(
    complete: tuple[Path, list[Step]],
) -> None:
    out, steps = complete
    names = ["er", "er", "finetune", "finetune", "joint", "joint"]
    assert [(s.strategy, s.done, s.total) for s in steps] == [
        (name, i, 6) for i, name in enumerate(names, start=1)
    ]
    stages = [(0, "one"), (1, "one"), (1, "two")]
    expected = [(name, stage, scene) for name in ("er", "finetune") for stage, scene in stages]
    lines = [(r.strategy, r.stage, r.scene) for r in read(out)]
    assert lines == [*expected, ("joint", 1, "one"), ("joint", 1, "two")]
    assert {len(r.frames) for r in read(out)} == {8}
    runs = runs_of(read(out))
    assert [run.strategy for run in runs] == ["er", "finetune", "joint"]
    assert {run.scenes for run in runs} == {("one", "two")}


def test_strategies_share_the_first_stage(complete: tuple[Path, list[Step]]) -> None:
    out, _ = complete
    replay, control = (
        next(r for r in read(out) if r.strategy == name and r.stage == 0)
        for name in ("er", "finetune")
    )
    assert replay.translation_m == control.translation_m
    assert replay.memory_bytes > control.memory_bytes == 0
    assert replay.frames_kept == len(replay.keyframe_positions_m) == 2
    assert 0 < replay.min_spacing <= 2 * replay.covering_radius
    assert control.keyframe_positions_m == ()
    # Stores of complete runs are removed; the first scene stays for other strategies.
    stores = [path.name for path in (out / "runs").iterdir() if path.is_dir()]
    assert stores == ["first-one-0"]


def test_complete_runs_are_not_repeated(
    arcs: Arcs, options: BenchOptions, complete: tuple[Path, list[Step]]
) -> None:
    before = (complete[0] / RESULTS).read_bytes()
    assert list(run_bench(arcs, options, complete[0])) == []
    assert (complete[0] / RESULTS).read_bytes() == before


def test_processes_share_the_runs(
    arcs: Arcs, options: BenchOptions, complete: tuple[Path, list[Step]], tmp_path: Path
) -> None:
    """While one process has a run, another takes the others; together they have all."""
    first = run_bench(arcs, options, tmp_path)
    assert next(first).strategy == "er"
    second = run_bench(arcs, options, tmp_path)
    assert next(second).strategy == "finetune"
    assert [step.strategy for step in first] == ["er", "joint", "joint"]
    assert [step.strategy for step in second] == ["finetune"]
    assert comparable(read(tmp_path)) == comparable(read(complete[0]))


def test_every_line_names_commit_and_machine(complete: tuple[Path, list[Step]]) -> None:
    out, _ = complete
    records = read_environments(out)
    assert {line.environment for line in read(out)} == set(records)
    (record,) = records.values()
    assert record == environment()


def test_options_that_decide_a_result_are_recorded(complete: tuple[Path, list[Step]]) -> None:
    settings = json.loads((complete[0] / SETTINGS).read_text())
    assert settings["fit"]["iterations"] == 12
    assert settings["localize"]["align"] is True
    assert settings["localize"]["pnp"]["threshold_px"] > 0
    assert 0 < settings["acceptance"]["MIN_SUPPORT"] < 1


@pytest.mark.parametrize("stages", [1, 2])
def test_interruption_between_stages_does_not_change_results(
    arcs: Arcs,
    options: BenchOptions,
    complete: tuple[Path, list[Step]],
    tmp_path: Path,
    stages: int,
) -> None:
    one = replace(options, strategies=named("er"))
    steps = run_bench(arcs, one, tmp_path)
    for _ in range(stages):
        next(steps)
    steps.close()
    list(run_bench(arcs, one, tmp_path))
    expected = [r for r in read(complete[0]) if r.strategy == "er"]
    assert comparable(read(tmp_path)) == comparable(expected)


def test_interruption_inside_a_stage_does_not_change_results(
    arcs: Arcs, options: BenchOptions, complete: tuple[Path, list[Step]], tmp_path: Path
) -> None:
    one = replace(options, strategies=named("er"))
    # A folder that an interrupted commit leaves behind.
    (tmp_path / "runs" / "er-0" / "stages" / ".0001-one").mkdir(parents=True)

    def interrupt(event: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        list(run_bench(arcs, one, tmp_path, interrupt))
    assert read(tmp_path) == []
    list(run_bench(arcs, one, tmp_path))
    expected = [r for r in read(complete[0]) if r.strategy == "er"]
    assert comparable(read(tmp_path)) == comparable(expected)


@pytest.fixture(scope="module")
def two_stages(
    arcs: Arcs, options: BenchOptions, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, BenchOptions]:
    """The folder of a map's benchmark, stopped after its last stage, and the options."""
    one, out = replace(options, strategies=named("evercal")), tmp_path_factory.mktemp("stages")
    steps = run_bench(arcs, one, out)
    next(steps)
    next(steps)
    steps.close()
    return out, one


@pytest.mark.parametrize("cut", [1, 3])
def test_missing_lines_of_a_stage_are_added(
    cut: int, arcs: Arcs, two_stages: tuple[Path, BenchOptions], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    shutil.copytree(two_stages[0], out)
    whole = comparable(read(out))
    path = out / RESULTS
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:-cut]))
    list(run_bench(arcs, two_stages[1], out))
    assert comparable(read(out)) == whole
    assert len(whole) == 6


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"order": "reversed"}, "order 'given', now it is 'reversed'"),
        (
            {"strategies": (replace(strategy_named("er"), method=Replay("sars", weight=0.3)),)},
            "strategy 'er' was .*reservoir.*now it is .*sars.*give it another name",
        ),
        ({"settings": {"suite": "other"}}, "suite None, now it is 'other'"),
    ],
)
def test_other_settings_and_strategies_are_refused(
    arcs: Arcs,
    options: BenchOptions,
    complete: tuple[Path, list[Step]],
    change: dict[str, object],
    message: str,
) -> None:
    before = (complete[0] / STRATEGIES).read_bytes()
    with pytest.raises(InputError, match=message):
        next(run_bench(arcs, replace(options, **change), complete[0]))  # pyright: ignore[reportArgumentType]
    assert (complete[0] / STRATEGIES).read_bytes() == before


def test_strategies_are_described_beside_the_results(
    arcs: Arcs, options: BenchOptions, complete: tuple[Path, list[Step]], tmp_path: Path
) -> None:
    described = read_strategies(complete[0])
    assert described == {s.name: s.description() for s in options.strategies}
    runs = {run.strategy: run for run in runs_of(read(complete[0]), described)}
    assert np.isfinite(runs["er"].memory_mb)
    assert np.isnan(runs["joint"].memory_mb)
    # More strategies can be added.
    row = Strategy("er_3", Replay(weight=0.9))
    more = replace(options, strategies=(*named("er"), row))
    out = tmp_path / "out"
    shutil.copytree(complete[0], out, ignore=shutil.ignore_patterns("features"))
    assert begin_bench(arcs, more, out) == [(0, row)]
    assert list(read_strategies(out)) == ["er", "finetune", "joint", "er_3"]


def test_single_scene_is_refused(arcs: Arcs, options: BenchOptions, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="two or more"):
        next(run_bench(arcs[:1], options, tmp_path / "new"))
    assert not (tmp_path / "new").exists()


def test_orders() -> None:
    scenes = [Recording(str(i), (), ()) for i in range(6)]
    assert in_order(scenes, "given", 3) == scenes
    assert in_order(scenes, "reversed", 3) == scenes[::-1]
    drawn = [[s.name for s in in_order(scenes, "shuffled", seed)] for seed in range(20)]
    assert all(sorted(order) == [s.name for s in scenes] for order in drawn)
    assert len({tuple(order) for order in drawn}) > 15
    assert drawn[3] == [s.name for s in in_order(scenes, "shuffled", 3)]
    for count in (3, 5):
        orders = [in_order(scenes[:count], "balanced", seed) for seed in range(2 * count)]
        assert orders[0] == scenes[:count]
        assert len({tuple(scene.name for scene in order) for order in orders}) == 2 * count
        for begun in (0, count):
            for place in range(count):
                learned = {order[place].name for order in orders[begun : begun + count]}
                assert len(learned) == count, "each scene once in each place"


def test_suites_load_their_scenes_in_order() -> None:
    assert [scene.name for scene in load_suite("sim-mini")] == ["bedroom", "kitchen", "living"]
    some = load_suite("sim-mini", None, ["living", "bedroom"])
    assert [scene.name for scene in some] == ["bedroom", "living"]
    sizes = [len(SUITES[name].scenes) for name in ("sim-7", "sim-12", "sim-repeat", "i7s", "i12s")]
    assert sizes == [7, 12, 3, 7, 12]


@pytest.mark.parametrize(
    ("load", "message"),
    [
        (lambda _: load_suite("nonsense"), "suite 'nonsense': unknown; choose one of sim-mini"),
        (lambda _: load_suite("sim-mini", None, ["attic"]), "scene 'attic': not in suite sim-mini"),
        (lambda _: load_suite("real2"), "--data"),
        (lambda data: load_suite("i7s", data), "chess is missing; get it from https://www.micro"),
        (lambda data: load_suite("sim-mini", poses=data), "--poses are for i7s and i12s"),
        (lambda data: load_suite("sim", data), "bedroom is missing; get it from python -m rooms"),
    ],
)
def test_unavailable_suites_are_refused(
    load: Callable[[Path], object], message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=message):
        load(tmp_path)


def frame(name: str, x: float | None = 0.0) -> Frame:
    """A tiny frame at x, without a pose if x is None."""
    pose = None if x is None else SE3(np.array([1.0, 0, 0, 0]), np.array([x, 0, 0]))
    return Frame(name, np.zeros((3, 4, 3), np.uint8), CAMERA, pose)


def test_tuning_split_uses_training_frames_only() -> None:
    train = (frame("-1", None), *(frame(str(i)) for i in range(30)))
    scene = tuning_split(Recording("hall", train, (frame("99"),)))
    test = [6, 7, 8, 21, 22, 23]
    assert [int(f.name) for f in scene.test] == test
    assert [int(f.name) for f in scene.train] == [i for i in range(30) if i not in test]
    with pytest.raises(InputError, match=r"hall: 12 of 15 .* omit --held-out"):
        tuning_split(Recording("hall", train[:16], ()))


def test_regions_share_the_base_frame_and_split_every_frame() -> None:
    # Three positions; the recording starts at the middle one.
    xs = [5.0] * 20 + [0.0] * 20 + [9.0] * 20
    train = tuple(frame(f"train-{i}", x + 0.001 * i) for i, x in enumerate(xs))
    test = tuple(frame(f"test-{x}", x) for x in (0.2, 8.7, 5.1, 0.1))
    parts = regions(Recording("hall", train, test), 3)
    assert [scene.name for scene in parts] == ["hall-1", "hall-2", "hall-3"]
    assert {scene.base for scene in parts} == {"hall"}
    assert [scene.train for scene in parts] == [train[:20], train[20:40], train[40:]]
    assert [len(scene.test) for scene in parts] == [1, 2, 1]
    assert parts[0].test == test[2:3]
    for count, message in ((1, "--parts 1"), (4, "are too few"), (61, "too few for --parts 61")):
        with pytest.raises(InputError, match=message):
            regions(Recording("hall", train, test), count)


def test_backbone_of_the_paper_gets_all_centres_in_advance(
    arcs: Arcs, options: BenchOptions, tmp_path: Path
) -> None:
    def stage(seed: int) -> StageOptions:
        few = options.stage(seed)
        paper = on_paper_backbone(replace(few, head=replace(few.head, width=24)))
        return replace(paper, head=replace(paper.head, centres_per_scene=5))

    paper = replace(options, stage=stage, strategies=named("sars_spdd", "joint", "evercal"))
    steps = list(run_bench(arcs, paper, tmp_path))
    assert [s.strategy for s in steps] == [s.name for s in paper.strategies for _ in arcs]
    first = NetworkStore.open(tmp_path / "runs" / "first-one-0").contents
    assert len(first.heads[0].centres) == 5
    assert first.scenes[0].cell.side_m == 5.0
    ends = {r.strategy: r for r in read(tmp_path) if (r.stage, r.scene) == (1, "two")}
    # Twelve steps are too few for this network; the map does not need any.
    assert ends["evercal"].correct().sum() > ends["joint"].correct().sum() == 0


def test_running_state_counts_once_as_memory(
    arcs: Arcs, options: BenchOptions, tmp_path: Path
) -> None:
    steps = list(run_bench(arcs, replace(options, strategies=named("ewc_online")), tmp_path))
    sizes = [step.results[0].memory_bytes for step in steps]
    # One anchor and one importance per weight; a scene adds a few weights.
    assert 0 < sizes[0] < sizes[1] < 1.2 * sizes[0]


def test_joint_training_can_build_maps(
    arcs: Arcs, options: BenchOptions, complete: tuple[Path, list[Step]], tmp_path: Path
) -> None:
    list(run_bench(arcs, replace(options, strategies=named("joint_map")), tmp_path))
    results = read(tmp_path)
    maps = {r.scene: r for r in results if r.strategy == "joint_map"}
    alone = [r for r in results if r.strategy == "joint_map" + NETWORK]
    assert {r.scene for r in alone} == {"one", "two"}
    plain = {r.scene: r for r in read(complete[0]) if r.strategy == "joint"}
    assert maps["two"].frames_kept == len(maps["two"].keyframe_positions_m) == 2
    assert maps["one"].memory_bytes > plain["one"].memory_bytes == 0
    for scene in ("one", "two"):
        assert maps[scene].correct().sum() > plain[scene].correct().sum()


def test_thresholds_of_a_network_beside_a_map_are_fitted_once(
    arcs: Arcs, options: BenchOptions, tmp_path: Path
) -> None:
    strategy = replace(strategy_named("er"), name="a", builds_map=True)
    both, fits = replace(options, strategies=(strategy,)), tmp_path / "runs" / "a-0.network.json"
    steps = run_bench(arcs, both, tmp_path)
    next(steps)
    steps.close()
    # A marked threshold of the first scene survives the interruption.
    ((_, scale),) = json.loads(fits.read_text())
    fits.write_text(json.dumps([[0.125, scale]]))
    steps = run_bench(arcs, both, tmp_path)
    next(steps)
    assert len(json.loads(fits.read_text())) == 1
    next(steps)
    first, second = json.loads(fits.read_text())
    assert first == [0.125, scale]
    assert second[0] != 0.125
    assert list(steps) == []
    assert {r.strategy for r in read(tmp_path)} == {"a", "a" + NETWORK}
    # Beside a map, the first scene is not shared with other strategies.
    assert [path for path in (tmp_path / "runs").iterdir() if path.is_dir()] == []
