"""`evercal learn` and `evercal info` with strategies that train a network."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evercal.cli import main
from evercal.recordings import generic

from ..box_world import box_room_scene


@pytest.fixture(scope="module", autouse=True)
def tiny() -> Iterator[None]:
    """A preset of four steps, and negative images that need no rendering."""
    from evercal.continual import threshold
    from evercal.continual.learning.presets import PRESETS

    bench, rng = PRESETS["bench"], np.random.default_rng(0)
    stage = replace(
        bench,
        head=replace(bench.head, width=16),
        fit=replace(bench.fit, iterations=4, batch=64, replay_batch=32),
    )
    noise = [rng.integers(0, 256, (240, 320, 3)).astype(np.uint8) for _ in range(2)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PRESETS, "bench", stage)
        patch.setattr(threshold, "_negative_views", lambda *_: noise)
        yield


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Folders of two recordings of 24 frames."""
    root = tmp_path_factory.mktemp("recordings")
    for seed, name in ((41, "alpha"), (42, "beta")):
        generic.write(root / name, replace(box_room_scene(seed, 24, 0), name=name))
    return root / "alpha", root / "beta"


@pytest.fixture(scope="module")
def er_store(
    tiny: None, recordings: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A store of strategy er with the scene alpha."""
    store = tmp_path_factory.mktemp("stores") / "er"
    assert evercal("learn", store, recordings[0], "--strategy", "er", "--preset", "bench") == 0
    return store


def evercal(*words: object) -> int:
    return main([str(word) for word in words])


def test_network_is_learned_and_described(
    recordings: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = tmp_path / "store"
    assert evercal("learn", store, recordings[0], "--strategy", "er", "--preset", "bench") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("alpha: 24 training frames")
    assert any(line.startswith("learned alpha: 20 images, 2 keyframes, 4 steps") for line in lines)
    assert lines[-1] == f"next: evercal localize {store} IMAGE"
    # A store keeps its strategy.
    assert evercal("learn", store, recordings[1], "--preset", "bench", "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["scene"], report["iterations"], report["frames_kept"]) == ("beta", 4, 2)
    assert report["head_bytes"] > 0
    assert evercal("info", store, "--json") == 0
    info = json.loads(capsys.readouterr().out)
    assert (info["strategy"], info["short_side"]) == ("er", 240)
    assert info["head_bytes"] == report["head_bytes"]
    assert [scene["name"] for scene in info["scenes"]] == ["alpha", "beta"]
    assert [scene["keyframes"] for scene in info["scenes"]] == [2, 2]
    assert 0 <= info["scenes"][0]["inlier_threshold"] <= 1
    assert info["memory_bytes"] + info["head_bytes"] < info["total_bytes"]
    assert evercal("info", store) == 0
    assert "2 scenes, strategy er" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--strategy", "evercal"], "was made with er"),
        (["--strategy", "finetune"], "was made with er"),
        (["--centres", "0"], "--centres 0"),
        (["--seed", "-1"], "--seed -1"),
        (["--memory", "auto"], "memory auto"),
        (["--encoder", "missing.safetensors"], "no such file"),
        (["--name", "alpha"], "a scene of this name exists"),
    ],
)
def test_bad_options_are_refused(
    options: list[str],
    message: str,
    er_store: Path,
    recordings: tuple[Path, Path],
    tree: Callable[[Path], dict[str, str]],
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = tree(er_store)
    assert evercal("learn", er_store, recordings[1], "--preset", "bench", *options) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert message in captured.err
    assert len(captured.err.splitlines()) == 1
    assert tree(er_store) == before


@pytest.mark.parametrize("options", [["--centres", "5"], ["--preset", "bench"], ["--seed", "1"]])
def test_options_of_networks_are_refused_for_a_map(
    options: list[str],
    recordings: tuple[Path, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert evercal("learn", tmp_path / "map", recordings[0], *options) == 2
    error = capsys.readouterr().err
    assert f"{options[0]} {options[1]}: a map is not trained" in error
    assert not (tmp_path / "map").exists()


@pytest.mark.parametrize("strategy", ["joint", "nonsense"])
def test_strategies_that_cannot_grow_a_store_are_refused(
    strategy: str,
    recordings: tuple[Path, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert evercal("learn", tmp_path / "new", recordings[0], "--strategy", strategy) == 2
    assert f"strategy '{strategy}'" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
