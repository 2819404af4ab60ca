"""`evercal learn` and `evercal info` with a strategy that trains a network."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np


def test_a_network_learns_a_second_scene(
    run,
    network_store,
    rooms,
    tmp_path,
    monkeypatch,
):
    """With four steps, and negative images that need no rendering. A store keeps its strategy."""
    from evercal.continual import threshold
    from evercal.continual.learning.presets import PRESETS

    demo = PRESETS["demo"]
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 256, (240, 320, 3)).astype(np.uint8) for _ in range(2)]
    fit = replace(demo.fit, iterations=4, batch=64, replay_batch=32)
    encode = replace(demo.encode, views_per_frame=1)
    small = replace(demo, head=replace(demo.head, width=32), fit=fit, encode=encode)
    monkeypatch.setitem(PRESETS, "demo", small)
    monkeypatch.setattr(threshold, "_negative_views", lambda *_: noise)
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
