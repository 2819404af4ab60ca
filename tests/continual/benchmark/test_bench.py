"""The benchmark runs what is missing, once, and a stop in between does not show."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from evercal.mapping.scene_maps import SceneMaps, SceneRecord

from evercal.continual.benchmark import bench, strategy_run
from evercal.continual.benchmark.bench import BenchOptions, begin_bench, in_order, run_bench
from evercal.continual.benchmark.comparison import runs_of
from evercal.continual.benchmark.results import (
    NETWORK,
    RESULTS,
    STRATEGIES,
    SceneResult,
    read,
    read_strategies,
)
from evercal.continual.benchmark.strategy_run import RunOptions
from evercal.continual.benchmark.suites import SUITES, load_suite, regions, tuning_split
from evercal.continual.methods.replay import Replay
from evercal.continual.presets import PRESETS, on_paper_backbone
from evercal.continual.strategies import Strategy, strategy_named
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.mapping.store import Store
from evercal.recordings import Frame, Recording

if TYPE_CHECKING:
    from evercal.continual.stage import StageOptions

Arcs = tuple[Recording, Recording]
CAMERA = Camera(4, 3, 4.0, 4.0, 1.5, 1.0)


def named(*names: str) -> tuple[Strategy, ...]:
    return tuple(strategy_named(name) for name in names)


@pytest.fixture(scope="module")
def options(arc_stage: StageOptions) -> BenchOptions:
    def stage(seed: int) -> StageOptions:
        fit = replace(arc_stage.fit, iterations=12, batch=128, replay_batch=64)
        encode = replace(arc_stage.encode, views_per_frame=1, seed=seed)
        return replace(arc_stage, fit=fit, encode=encode, replay_views_per_frame=1, seed=seed)

    return BenchOptions(stage, named("er", "finetune", "joint"), seeds=(0,), short_side=120)


def told(results: list[SceneResult]) -> list[SceneResult]:
    """What must be the same in every run."""
    return [replace(result, seconds=0.0) for result in results]


@pytest.fixture(scope="module")
def done(
    arcs: Arcs, options: BenchOptions, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, list[bench.Step]]:
    """A whole benchmark and its steps."""
    out = tmp_path_factory.mktemp("bench")
    return out, list(run_bench(arcs, options, out))


def test_every_strategy_is_judged_after_every_stage(done: tuple[Path, list[bench.Step]]) -> None:
    out, steps = done
    assert [(s.strategy, s.done, s.total) for s in steps] == [
        ("er", 1, 6),
        ("er", 2, 6),
        ("finetune", 3, 6),
        ("finetune", 4, 6),
        ("joint", 5, 6),
        ("joint", 6, 6),
    ]
    found = [(o.strategy, o.stage, o.scene) for o in read(out)]
    rows = [(0, "one"), (1, "one"), (1, "two")]
    expected = [(s, stage, scene) for s in ("er", "finetune") for stage, scene in rows]
    assert found == [*expected, ("joint", 1, "one"), ("joint", 1, "two")]
    assert {len(o.frames) for o in read(out)} == {24}


def test_strategies_start_from_the_same_first_stage(done: tuple[Path, list[bench.Step]]) -> None:
    out, _ = done
    ours, control = (
        next(o for o in read(out) if o.strategy == name and o.stage == 0)
        for name in ("er", "finetune")
    )
    assert ours.translation_m == control.translation_m
    assert ours.memory_bytes > control.memory_bytes == 0
    assert ours.frames_kept == len(ours.keyframe_positions_m) == 2
    assert 0 < ours.min_spacing <= 2 * ours.covering_radius
    assert control.keyframe_positions_m == ()
    # Stores of finished runs are gone, the first scene and the features stay for other strategies.
    assert [path.name for path in (out / "runs").iterdir()] == ["first-one-0"]


def test_what_is_done_is_not_run_again(
    arcs: Arcs,
    options: BenchOptions,
    done: tuple[Path, list[bench.Step]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out, _ = done
    before = (out / RESULTS).read_bytes()
    monkeypatch.setattr(strategy_run, "learn_scene", None)
    monkeypatch.setattr(strategy_run, "learn_jointly", None)
    assert list(run_bench(arcs, options, out)) == []
    assert (out / RESULTS).read_bytes() == before


@pytest.mark.parametrize("stop", [1, 2])
def test_a_stop_between_stages_does_not_show(
    arcs: Arcs,
    options: BenchOptions,
    done: tuple[Path, list[bench.Step]],
    tmp_path: Path,
    stop: int,
) -> None:
    alone = replace(options, strategies=named("er"))
    steps = run_bench(arcs, alone, tmp_path)
    for _ in range(stop):
        next(steps)
    steps.close()
    list(run_bench(arcs, alone, tmp_path))
    expected = [o for o in read(done[0]) if o.strategy == "er"]
    assert told(read(tmp_path)) == told(expected)


def test_a_stop_inside_a_stage_resumes_it(
    arcs: Arcs, options: BenchOptions, done: tuple[Path, list[bench.Step]], tmp_path: Path
) -> None:
    alone = replace(options, strategies=named("er"))
    # What a kill inside the first commit leaves behind.
    (tmp_path / "runs" / "er-0" / "stages" / ".0001-one").mkdir(parents=True)

    def stop(event: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        list(run_bench(arcs, alone, tmp_path, stop))
    assert read(tmp_path) == []
    list(run_bench(arcs, alone, tmp_path))
    expected = [o for o in read(done[0]) if o.strategy == "er"]
    assert told(read(tmp_path)) == told(expected)


def test_results_make_runs(done: tuple[Path, list[bench.Step]]) -> None:
    runs = runs_of(read(done[0]))
    assert [run.strategy for run in runs] == ["er", "finetune", "joint"]
    assert {run.scenes for run in runs} == {("one", "two")}


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
def test_other_settings_and_names_that_change_their_meaning_are_refused(
    arcs: Arcs,
    options: BenchOptions,
    done: tuple[Path, list[bench.Step]],
    change: dict[str, object],
    message: str,
) -> None:
    before = (done[0] / STRATEGIES).read_bytes()
    with pytest.raises(InputError, match=message):
        next(run_bench(arcs, replace(options, **change), done[0]))  # pyright: ignore[reportArgumentType]
    assert (done[0] / STRATEGIES).read_bytes() == before


def test_what_each_strategy_is_stands_beside_the_results(
    arcs: Arcs, options: BenchOptions, done: tuple[Path, list[bench.Step]], tmp_path: Path
) -> None:
    told = read_strategies(done[0])
    assert told == {s.name: s.description() for s in options.strategies}
    runs = {run.strategy: run for run in runs_of(read(done[0]), told)}
    assert runs["er"].description == strategy_named("er").description()
    assert np.isfinite(runs["er"].memory_mb)
    assert np.isnan(runs["joint"].memory_mb)  # it needs every frame again
    # More may join, and what is there stays.
    row = Strategy("er_3", Replay(weight=0.9))
    asked = replace(options, strategies=(*named("er"), row))
    shutil.copytree(done[0], tmp_path / "out", ignore=shutil.ignore_patterns("features"))
    assert begin_bench(arcs, asked, tmp_path / "out") == [(0, row)]
    assert list(read_strategies(tmp_path / "out")) == ["er", "finetune", "joint", "er_3"]


def test_one_scene_cannot_be_forgotten(arcs: Arcs, options: BenchOptions, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="two or more"):
        next(run_bench(arcs[:1], options, tmp_path / "new"))
    assert not (tmp_path / "new").exists()


def test_orders(arcs: Arcs) -> None:
    several = [*arcs, *arcs, *arcs]
    assert in_order(several, "given", 3) == several
    assert in_order(several, "reversed", 3) == several[::-1]
    drawn = [in_order(range(6), "shuffled", seed) for seed in range(20)]  # pyright: ignore[reportArgumentType]
    assert all(sorted(order) == list(range(6)) for order in drawn)  # pyright: ignore[reportArgumentType]
    assert len({tuple(order) for order in drawn}) > 15
    assert drawn[3] == in_order(range(6), "shuffled", 3)  # pyright: ignore[reportArgumentType]


def test_suites(tmp_path: Path) -> None:
    assert [scene.name for scene in load_suite("sim-mini")] == ["bedroom", "kitchen", "living"]
    assert [scene.name for scene in load_suite("sim-mini", None, ["living", "bedroom"])] == [
        "bedroom",
        "living",
    ]
    sizes = [len(SUITES[name].scenes) for name in ("sim-7", "sim-12", "i7s", "i12s")]
    assert sizes == [7, 12, 7, 12]
    refused: list[tuple[Callable[[], object], str]] = [
        (lambda: load_suite("nonsense"), "suite 'nonsense': unknown; choose one of sim-mini"),
        (lambda: load_suite("sim-mini", None, ["attic"]), "scene 'attic': not in suite sim-mini"),
        (lambda: load_suite("real2"), "--data"),
        (lambda: load_suite("i7s", tmp_path), "chess is missing; get it from https://www.micro"),
        (lambda: load_suite("sim-mini", poses=tmp_path), "--poses are for i7s and i12s"),
        (lambda: load_suite("sim", tmp_path), "bedroom is missing; get it from evercal simulate"),
    ]
    for call, message in refused:
        with pytest.raises(InputError, match=message):
            call()


def test_what_is_held_out_to_choose_settings_is_training_frames() -> None:
    def look(i: int, posed: bool = True) -> Frame:
        pose = SE3(np.array([1.0, 0, 0, 0]), np.zeros(3)) if posed else None
        return Frame(str(i), np.zeros((3, 4, 3), np.uint8), CAMERA, pose)

    train = (look(-1, posed=False), *(look(i) for i in range(30)))
    scene = tuning_split(Recording("hall", train, (look(99),)))
    assert [int(f.name) for f in scene.test] == [6, 7, 8, 21, 22, 23]
    assert [f.name for f in scene.train] == [
        str(i) for i in range(30) if i not in (6, 7, 8, 21, 22, 23)
    ]
    with pytest.raises(InputError, match=r"hall: 12 of 15 .* leave out --held-out"):
        tuning_split(Recording("hall", train[:16], ()))


def test_the_paper_knows_all_centres_from_the_start(
    arcs: Arcs, options: BenchOptions, tmp_path: Path
) -> None:
    def stage(seed: int) -> StageOptions:
        few = options.stage(seed)
        made = on_paper_backbone(replace(few, head=replace(few.head, width=24)))
        return replace(made, head=replace(made.head, centres_per_scene=5))

    asked = replace(options, stage=stage, strategies=named("sars_spdd", "joint", "evercal"))
    how = RunOptions(stage(0), 120, tmp_path / "features", tmp_path)
    run = strategy_run._Run(asked.strategies[0], list(arcs), how, None)
    assert (run.stage.grid_scenes, len(run.stage.fixed_centres_m)) == (2, 5)
    assert run.stage.head.width == 24
    assert run.stage.head.condition == "descriptor"
    assert run.stage.fit.iterations == options.stage(0).fit.iterations
    assert run.stage.fit.peak_rate == PRESETS["paper"].fit.peak_rate
    steps = list(run_bench(arcs, asked, tmp_path))
    assert [s.strategy for s in steps] == [s.name for s in asked.strategies for _ in arcs]
    first = Store.open(tmp_path / "runs" / "first-one-0").maps
    # No scene brings any of its own.
    assert len(first.heads[0].centres) == 5
    assert first.scenes[0].cell.side_m == 5.0
    ends = {o.strategy: o for o in read(tmp_path) if (o.stage, o.scene) == (1, "two")}
    # Twelve steps teach this network nothing, but what is remembered answers all the same.
    assert ends["evercal"].correct().sum() > ends["joint"].correct().sum() == 0


def test_a_running_note_begins_with_the_first_scene(
    arcs: Arcs, options: BenchOptions, tmp_path: Path
) -> None:
    steps = list(run_bench(arcs, replace(options, strategies=named("ewc_online")), tmp_path))
    sizes = [step.results[0].memory_bytes for step in steps]
    # One anchor and one sum of importances of the whole head, which grows by what a scene adds.
    assert 0 < sizes[0] < sizes[1] < 1.2 * sizes[0]


def test_joint_training_may_build_maps_too(
    arcs: Arcs, options: BenchOptions, done: tuple[Path, list[bench.Step]], tmp_path: Path
) -> None:
    list(run_bench(arcs, replace(options, strategies=named("joint_map")), tmp_path))
    found = read(tmp_path)
    ours = {o.scene: o for o in found if o.strategy == "joint_map"}
    # Its network alone is judged beside both together, and remembers nothing.
    alone = [o for o in found if o.strategy == "joint_map" + NETWORK]
    assert {o.scene for o in alone} == {"one", "two"}
    plain = {o.scene: o for o in read(done[0]) if o.strategy == "joint"}
    assert ours.keys() == plain.keys() == {"one", "two"}
    assert ours["two"].frames_kept == len(ours["two"].keyframe_positions_m) == 2
    assert ours["one"].memory_bytes > plain["one"].memory_bytes == 0
    # The memory is of both scenes, and answers for both.
    for scene in ours:
        assert ours[scene].correct().sum() > plain[scene].correct().sum()


def test_thresholds_of_a_network_beside_a_map_are_fitted_once(
    arcs: Arcs, options: BenchOptions, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fitted, fit = [], strategy_run.fitted_record

    def noted(maps: SceneMaps, held_out: Sequence[Frame], scene: int = -1) -> SceneRecord:
        keyframes = maps.keyframes[scene]
        if keyframes is not None and not keyframes.landmarks:
            fitted.append(scene)
        return fit(maps, held_out, scene)

    monkeypatch.setattr(strategy_run, "fitted_record", noted)
    both = replace(options, strategies=(replace(strategy_named("er"), name="a", builds_map=True),))
    steps = run_bench(arcs, both, tmp_path)
    next(steps)
    steps.close()  # as if killed: what was fitted for the first scene is still known
    assert fitted == [0]
    assert len(list(run_bench(arcs, both, tmp_path))) == 2
    assert fitted == [0, 1]
    assert {o.strategy for o in read(tmp_path)} == {"a", "a" + NETWORK}
    # Beside a map the network learns other frames, so the first scene is not that of the others.
    assert list((tmp_path / "runs").iterdir()) == []


@pytest.mark.parametrize("lines", [1, 2, 3])
def test_a_stage_whose_lines_a_power_cut_tore_is_made_whole(
    lines: int, arcs: Arcs, options: BenchOptions, tmp_path: Path
) -> None:
    strategy = replace(strategy_named("evercal"), name="a")
    few = replace(options, strategies=(strategy,))
    steps = run_bench(arcs, few, tmp_path)
    next(steps)
    next(steps)
    steps.close()
    whole = told(read(tmp_path))
    path = tmp_path / RESULTS
    kept = path.read_bytes().splitlines(keepends=True)[:-lines]
    path.write_bytes(b"".join(kept))
    list(run_bench(arcs, few, tmp_path))
    again = told(read(tmp_path))
    assert len(again) == len(whole) == 6

    def order(result: SceneResult) -> tuple[str, int, str]:
        return result.strategy, result.stage, result.scene

    assert sorted(again, key=order) == sorted(whole, key=order)
    runs_of(again)


def test_regions_share_the_base_frame_and_split_every_frame() -> None:
    def look(x: float, name: str) -> Frame:
        return Frame(
            name,
            np.zeros((3, 4, 3), np.uint8),
            CAMERA,
            SE3(np.array([1.0, 0, 0, 0]), np.array([x, 0, 0])),
        )

    # Three places; the recording goes to the middle one first.
    xs = [5.0] * 20 + [0.0] * 20 + [9.0] * 20
    train = tuple(look(x + 0.001 * i, f"train-{i}") for i, x in enumerate(xs))
    test = tuple(look(x, f"test-{x}") for x in (0.2, 8.7, 5.1, 0.1))
    found = regions(Recording("hall", train, test), 3)
    assert [scene.name for scene in found] == ["hall-1", "hall-2", "hall-3"]
    assert {scene.base for scene in found} == {"hall"}
    assert [scene.train for scene in found] == [train[:20], train[20:40], train[40:]]
    assert [len(scene.test) for scene in found] == [1, 2, 1]
    assert found[0].test == test[2:3]
    for parts, message in ((1, "--parts 1"), (4, "are too few")):
        with pytest.raises(InputError, match=message):
            regions(Recording("hall", train, test), parts)
