"""The benchmark runs what is missing, once, and an interruption does not change results."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import pytest

from evercal.continual import threshold
from evercal.continual.benchmark.bench import (
    BenchOptions,
    CompletedStage,
    begin_bench,
    in_order,
    run_bench,
)
from evercal.continual.benchmark.overlays import OVERLAYS, draw_overlays
from evercal.continual.benchmark.results import (
    FRAMES,
    KEY,
    RESULTS,
    SETTINGS,
    STRATEGIES,
    read,
)
from evercal.continual.learning.presets import on_paper_backbone
from evercal.continual.methods.replay import Replay
from evercal.continual.store import NetworkStore
from evercal.continual.strategies import Strategy, strategy_named
from evercal.errors import InputError
from evercal.localization import acceptance

if TYPE_CHECKING:
    from evercal.continual.learning.stage import StageOptions
    from evercal.recordings import Recording

    Arcs = tuple[Recording, Recording]


Complete = tuple[Path, list[CompletedStage]]


def named(*names: str) -> tuple[Strategy, ...]:
    return tuple(strategy_named(name) for name in names)


@pytest.fixture(scope="module")
def arcs(arcs: Arcs) -> Arcs:
    """The arcs with 18 of their training frames and three of their test frames."""
    one, two = (
        replace(scene, train=scene.train[:18], test=scene.test[:18:7]) for scene in arcs
    )
    return one, two


@pytest.fixture(scope="module", autouse=True)
def _few_negatives() -> Iterator[None]:
    """Negative images that need no rendering."""
    images = (
        np.random.default_rng(0).integers(0, 256, (2, 120, 160, 3)).astype(np.uint8)
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(threshold, "_negative_views", lambda *_: images)
        yield


@pytest.fixture(scope="module")
def options(arc_stage: StageOptions) -> BenchOptions:
    def stage(seed: int) -> StageOptions:
        fit = replace(arc_stage.fit, iterations=6, batch=64, replay_batch=32)
        encode = replace(arc_stage.encode, views_per_frame=1, seed=seed)
        return replace(
            arc_stage, fit=fit, encode=encode, replay_views_per_frame=1, seed=seed
        )

    return BenchOptions(
        stage, named("er", "finetune", "joint"), seeds=(0,), short_side=120
    )


def comparable(out: Path, *strategies: str) -> pd.DataFrame:
    """Results of some strategies without times, sorted."""
    results = read(out).drop(columns="seconds")
    if strategies:
        results = results[results["strategy"].isin(strategies)]
    return results.sort_values(KEY, ignore_index=True)


@pytest.fixture(scope="module")
def complete(
    arcs: Arcs, options: BenchOptions, tmp_path_factory: pytest.TempPathFactory
) -> Complete:
    """The folder of a complete benchmark, and its steps."""
    out = tmp_path_factory.mktemp("bench")
    return out, list(run_bench(arcs, options, out))


def test_all_learned_scenes_are_evaluated_after_every_stage(
    complete: Complete,
) -> None:
    out, steps = complete
    assert [(s.strategy, s.done, s.total) for s in steps] == [
        ("er", 1, 6),
        ("er", 2, 6),
        ("finetune", 3, 6),
        ("finetune", 4, 6),
        ("joint", 6, 6),
    ]
    stages = [(0, "one"), (1, "one"), (1, "two")]
    expected = [
        (name, stage, scene) for name in ("er", "finetune") for stage, scene in stages
    ]
    expected += [("joint", 1, "one"), ("joint", 1, "two")]
    results = read(out)
    frames = pd.read_csv(out / FRAMES)
    rows = results[["strategy", "stage", "scene"]]
    assert list(rows.itertuples(index=False, name=None)) == expected
    assert (results["frames"] == 3).all()
    assert set(frames.groupby(["strategy", "scene"]).size()) == {3}
    assert set(frames["strategy"]) == {"er", "finetune", "joint"}


def test_a_test_image_of_every_scene_is_drawn(complete: Complete) -> None:
    out, _ = complete
    pictures = sorted((out / "overlays").glob("*/*.png"))
    names = ["er.png", "finetune.png", "joint.png"]
    assert [path.name for path in pictures] == names * 2
    assert {path.parent.name for path in pictures} == {"one", "two"}
    assert draw_overlays(out, ("er", "joint", "other"))
    assert (out / OVERLAYS).exists()


def test_strategies_share_the_first_stage(
    complete: Complete,
) -> None:
    out, _ = complete
    first = read(out).query("stage == 0").set_index("strategy")
    errors = ["median_mm", "median_deg", "area_20cm"]
    assert first.loc["er", errors].equals(first.loc["finetune", errors])
    assert first.loc["er", "memory_bytes"] > first.loc["finetune", "memory_bytes"] == 0
    assert first["frames_kept"].to_dict() == {"er": 1, "finetune": 0}
    # Stores of complete runs are removed; the first scene stays for other strategies.
    stores = [path.name for path in (out / "runs").iterdir() if path.is_dir()]
    assert stores == ["first-one-0"]


def test_processes_share_the_runs(
    arcs: Arcs,
    options: BenchOptions,
    complete: Complete,
    tmp_path: Path,
) -> None:
    """While one process has a run, another takes the others; together they have all."""
    first = run_bench(arcs, options, tmp_path)
    assert next(first).strategy == "er"
    second = run_bench(arcs, options, tmp_path)
    assert next(second).strategy == "finetune"
    assert [step.strategy for step in first] == ["er", "joint"]
    assert [step.strategy for step in second] == ["finetune"]
    pd.testing.assert_frame_equal(comparable(tmp_path), comparable(complete[0]))


def test_options_that_decide_a_result_are_recorded(
    complete: Complete,
) -> None:
    settings = json.loads((complete[0] / SETTINGS).read_text())
    assert settings["fit"]["iterations"] == 6
    assert settings["localize"]["align"] is True
    assert settings["localize"]["pnp"]["threshold_px"] > 0
    assert 0 < settings["acceptance"]["FALSE_ACCEPTS"] < 1


@pytest.mark.parametrize(
    ("constant", "value"),
    [("CHANCE", (20.0, 300.0)), ("SAME_SURFACE", 4), ("FALSE_ACCEPTS", 1e-5)],
)
def test_results_of_another_law_of_acceptance_are_refused(
    constant: str,
    value: object,
    arcs: Arcs,
    options: BenchOptions,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    begin_bench(arcs, options, tmp_path)
    monkeypatch.setattr(acceptance, constant, value)
    with pytest.raises(InputError, match="other settings: acceptance"):
        begin_bench(arcs, options, tmp_path)


@pytest.mark.parametrize("stages", [0, 1, 2])
def test_interruption_does_not_change_results(
    arcs: Arcs,
    options: BenchOptions,
    complete: Complete,
    tmp_path: Path,
    stages: int,
) -> None:
    one = replace(options, strategies=named("er"))
    # A commit.
    (tmp_path / "runs" / "er-0" / "stages" / ".0001-one").mkdir(parents=True)
    steps = run_bench(arcs, one, tmp_path)
    for _ in range(stages):
        next(steps)
    steps.close()
    list(run_bench(arcs, one, tmp_path))
    pd.testing.assert_frame_equal(comparable(tmp_path), comparable(complete[0], "er"))


@pytest.fixture(scope="module")
def two_stages(
    arcs: Arcs, options: BenchOptions, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, BenchOptions]:
    """The folder of a map's benchmark, stopped after its last stage, and the options."""
    one = replace(options, strategies=named("evercal"))
    out = tmp_path_factory.mktemp("stages")
    steps = run_bench(arcs, one, out)
    next(steps)
    next(steps)
    steps.close()
    return out, one


@pytest.mark.parametrize("cut", [1, 2])
def test_missing_rows_of_a_stage_are_added(
    cut: int, arcs: Arcs, two_stages: tuple[Path, BenchOptions], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    shutil.copytree(two_stages[0], out)
    whole = comparable(out)
    path = out / RESULTS
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:-cut]))
    list(run_bench(arcs, two_stages[1], out))
    # Four decimals are kept, and answers of a stored map differ from the sixth digit on.
    pd.testing.assert_frame_equal(comparable(out), whole, rtol=1e-5, atol=1.01e-4)
    assert len(whole) == 3


def test_other_settings_and_strategies_are_refused(
    arcs: Arcs, options: BenchOptions, complete: Complete
) -> None:
    other = replace(strategy_named("er"), method=Replay("sars", weight=0.3))
    for change, message in (
        (replace(options, order="reversed"), "order 'given', now it is 'reversed'"),
        (
            replace(options, strategies=(other,)),
            "strategy 'er' was .*reservoir.*now it is .*sars.*give it another name",
        ),
        (
            replace(options, settings={"suite": "other"}),
            "suite None, now it is 'other'",
        ),
    ):
        with pytest.raises(InputError, match=message):
            next(run_bench(arcs, change, complete[0]))
    described = json.loads((complete[0] / STRATEGIES).read_text())
    assert described == {s.name: s.description() for s in options.strategies}


def test_strategies_can_be_added(
    arcs: Arcs,
    options: BenchOptions,
    complete: Complete,
    tmp_path: Path,
) -> None:
    row = Strategy("er_3", Replay(weight=0.9))
    more = replace(options, strategies=(*named("er"), row))
    shutil.copytree(complete[0], tmp_path, dirs_exist_ok=True)
    assert begin_bench(arcs, more, tmp_path) == [(0, row)]
    assert [*json.loads((tmp_path / STRATEGIES).read_text())] == [
        "er",
        "finetune",
        "joint",
        "er_3",
    ]


def test_single_scene_is_refused(
    arcs: Arcs, options: BenchOptions, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match="two or more"):
        next(run_bench(arcs[:1], options, tmp_path / "new"))
    assert not (tmp_path / "new").exists()


def test_orders() -> None:
    from evercal.recordings import Recording

    scenes = [Recording(str(i), (), ()) for i in range(6)]
    assert in_order(scenes, "given", 3) == scenes
    assert in_order(scenes, "reversed", 3) == scenes[::-1]
    drawn = [
        tuple(s.name for s in in_order(scenes, "shuffled", seed)) for seed in range(20)
    ]
    assert all(sorted(order) == [s.name for s in scenes] for order in drawn)
    assert len(set(drawn)) > 15
    for count in (3, 5):
        orders = [
            in_order(scenes[:count], "balanced", seed) for seed in range(2 * count)
        ]
        assert orders[0] == scenes[:count]
        assert (
            len({tuple(scene.name for scene in order) for order in orders}) == 2 * count
        )
        for begun in (0, count):
            for place in range(count):
                learned = {order[place].name for order in orders[begun : begun + count]}
                assert len(learned) == count, "each scene once in each place"


def test_backbone_of_the_paper_gets_all_centres_in_advance(
    arcs: Arcs, options: BenchOptions, tmp_path: Path
) -> None:
    def stage(seed: int) -> StageOptions:
        few = options.stage(seed)
        paper = on_paper_backbone(replace(few, head=replace(few.head, width=24)))
        return replace(paper, head=replace(paper.head, centres_per_scene=5))

    paper = replace(options, stage=stage, strategies=named("sars_spdd", "joint"))
    steps = list(run_bench(arcs, paper, tmp_path))
    names = ["sars_spdd", "sars_spdd", "joint"]
    assert [step.strategy for step in steps] == names
    first = NetworkStore.open(tmp_path / "runs" / "first-one-0").contents
    assert len(first.heads[0].centres) == 5
    assert first.scenes[0].cell.side_m == 5.0


def test_a_map_has_the_memory_of_the_networks(
    arcs: Arcs, arc_stage: StageOptions, tmp_path: Path
) -> None:
    """In bytes, too: a few keyframes of a few kB, and not as many keyframes as bytes."""
    few_bytes = BenchOptions(
        lambda seed: arc_stage.with_memory("30kB"),
        named("evercal"),
        (0,),
        short_side=120,
    )
    list(run_bench(arcs, few_bytes, tmp_path))
    results = read(tmp_path)
    assert (results["frames_kept"] < 18).all()
    assert results["memory_bytes"].max() < 2 * 30_000 + 20_000
