"""`evercal learn` and `evercal info` with a strategy that trains a network."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evercal.cli.learn import NetworkOptions

MINE = Path(__file__).parents[2] / "examples" / "my_strategy.py"


@pytest.fixture
def small(monkeypatch) -> None:
    """Four steps of preset `demo`, and negative images that need no rendering."""
    from evercal.continual import threshold
    from evercal.continual.learning.presets import PRESETS

    demo = PRESETS["demo"]
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 256, (240, 320, 3)).astype(np.uint8) for _ in range(2)]
    fit = replace(demo.fit, iterations=4, batch=64, replay_batch=32)
    encode = replace(demo.encode, views_per_frame=1)
    few = replace(demo, head=replace(demo.head, width=32), fit=fit, encode=encode)
    monkeypatch.setitem(PRESETS, "demo", few)
    monkeypatch.setattr(threshold, "_negative_views", lambda *_: noise)


@pytest.fixture
def without_mine(monkeypatch):
    """Forgets the strategies of a plugin, as a new process does."""
    from evercal.continual.strategies import STRATEGIES

    yield lambda: STRATEGIES.pop("spread", None)
    STRATEGIES.pop("spread", None)


def test_a_network_learns_a_second_scene(
    run,
    network_store,
    rooms,
    tmp_path,
    small,
):
    """A store keeps its strategy."""
    store = Path(shutil.copytree(network_store, tmp_path / "store"))
    ran = run("learn", store, rooms[1], "--preset demo")
    assert ran.code == 0, ran.err
    first, second, *_, last = ran.out.splitlines()
    assert first.startswith("box-room-42: 24 training frames")
    assert second.startswith("learned box-room-42: 20 images, 0 keyframes, 4 steps")
    assert last.startswith("next: evercal evaluate ")
    info = run.json("info", store)
    assert (info["strategy"], info["short_side"]) == ("finetune", 240)
    assert [scene["name"] for scene in info["scenes"]] == ["box-room-41", "box-room-42"]
    assert all(0 <= scene["inlier_threshold"] <= 1 for scene in info["scenes"])
    assert info["head_bytes"] > 0
    assert info["memory_bytes"] + info["head_bytes"] < info["total_bytes"]
    text = run("info", store).out
    assert "2 scenes, strategy finetune" in text
    assert "% inliers" in text
    assert "landmarks" not in text


def test_a_strategy_of_a_plugin_is_learned_and_answers_without_it(
    run, rooms, tmp_path, small, without_mine
):
    store = tmp_path / "mine.evercal"
    words = ("--preset demo", "--plugin", MINE)
    first = run("learn", store, rooms[0], "--strategy spread --weight 0.5", *words)
    assert first.code == 0, first.err
    without_mine()
    answered = run("evaluate", store, rooms[0], "--json")
    assert answered.code in (0, 1), answered.err
    assert run.json("info", store)["strategy"] == "spread"
    refused = run("learn", store, rooms[1], "--preset demo")
    assert refused.code == 2
    assert "strategy 'spread': unknown" in " ".join(refused.err)
    assert "--plugin" in " ".join(refused.err)
    second = run("learn", store, rooms[1], *words)
    assert second.code == 0, second.err


def test_options_of_a_training():
    paper = NetworkOptions(
        preset="demo", backbone="paper", offsets="shared", centres=7, steps=9, batch=128
    )
    stage = paper.stage(3, "5MB")
    assert (stage.seed, stage.memory.bytes) == (3, 5_000_000)
    assert (stage.fit.iterations, stage.fit.batch, stage.fit.replay_batch) == (
        9,
        128,
        64,
    )
    head = stage.head
    assert (head.condition, head.offsets, head.centres_per_scene) == (
        "descriptor",
        "shared",
        7,
    )
    # Later scenes are unknown, unless their centres are given.
    assert head.centres == "grow"
    assert paper.stage(3, "5MB", "fixed").head.centres == "fixed"
    assert NetworkOptions(preset="paper").stage(0, "10%").head.centres == "grow"
