"""`evercal bench`: tables, one JSON object, a folder of results, and refused input."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pandas as pd
import pytest
from filelock import FileLock

from evercal.cli import bench as verb
from evercal.continual.benchmark.results import FRAMES, STRATEGIES, read
from evercal.continual.learning.presets import short_side
from evercal.errors import InputError
from evercal.recordings import generic


@pytest.fixture
def small(monkeypatch, quick) -> None:
    """Tiny stages."""
    monkeypatch.setattr(
        verb.Bench, "_stage", lambda self, seed: replace(quick, seed=seed)
    )


@pytest.mark.slow("src/evercal/continual", "src/evercal/cli/bench.py")
def test_bench_and_its_tables(run, small, arcs, tmp_path):
    folders = []
    for scene in arcs:
        folders.append(tmp_path / scene.name)
        generic.write(
            folders[-1], replace(scene, train=scene.train[:18], test=scene.test[:4])
        )
    words = ["custom", *folders, "--strategies evercal,finetune --seeds 0"]
    (tmp_path / "out" / "runs").mkdir(parents=True)
    claims = [
        tmp_path / "out/runs" / f"{name}-0.claim" for name in ("evercal", "finetune")
    ]
    with FileLock(claims[0]), FileLock(claims[1]):
        shared = run("bench", *words, "--out", tmp_path / "out")
        assert shared.code == 0
        assert "other processes have all runs" in shared.out
    first = run("bench", *words, "--out", tmp_path / "out")
    assert first.code == 0, first.err
    assert "[4/4] finetune seed 0: one " in first.out
    assert "two 100.0 % at 5 cm and 5 deg (" in first.out
    assert "evercal - finetune" in first.out
    assert "BWT (backward transfer): mean change" in first.out
    again = run("bench", *words, "--out", tmp_path / "out", "--json")
    assert again.code == 0
    scores = again.json["runs"]
    assert [run["strategy"] for run in scores] == ["evercal", "finetune"]
    assert scores[0]["final %"] == 100.0
    printed = run("bench", tmp_path / "out", "--strategies finetune")
    assert printed.code == 0
    assert "finetune - evercal" in printed.out
    assert "finetune - evercal" in (tmp_path / "out" / "tables.md").read_text()
    assert (
        r"\multicolumn{3}{c}{finetune}" in (tmp_path / "out" / "tables.tex").read_text()
    )
    for name in ("figure.svg", "bars.svg"):
        assert "<svg" in (tmp_path / "out" / name).read_text()
    assert "![contours" in (tmp_path / "out" / "tables.md").read_text()


def test_held_out_frames_are_training_frames(run, small, arcs, tmp_path):
    folders = []
    for scene in arcs:
        folders.append(tmp_path / scene.name)
        generic.write(
            folders[-1], replace(scene, train=scene.train[:30], test=scene.test[:2])
        )
    plugin = tmp_path / "mine.py"
    plugin.write_text(
        "from evercal.continual.methods.replay import Replay\n"
        "from evercal.continual.strategies import Strategy\n"
        "STRATEGIES = {'er_3': Strategy('er_3', Replay(weight=0.9))}\n"
    )
    # Equal strategies run once.
    words = [
        "custom",
        *folders,
        "--strategies er_3,er_3 --seeds 0",
        "--held-out",
    ]
    ran = run("bench", *words, "--plugin", plugin, "--out", tmp_path / "out")
    assert ran.code == 0, ran.err
    train = {frame.name for scene in arcs for frame in scene.train}
    results = read(tmp_path / "out")
    frames = pd.read_csv(tmp_path / "out" / FRAMES, dtype={"frame": str})
    stages = results[["strategy", "stage", "scene"]].itertuples(index=False, name=None)
    assert list(stages) == [("er_3", 0, "one"), ("er_3", 1, "one"), ("er_3", 1, "two")]
    described = json.loads((tmp_path / "out" / STRATEGIES).read_text())
    assert described["er_3"]["method"]["weight"] == 0.9
    assert set(results["frames"]) == {6}
    assert set(frames["frame"]) <= train
    # Results on test frames are not mixed with these.
    refused = run("bench", *words[:-1], "--out", tmp_path / "out")
    assert refused.code == 2
    assert "now it is 'test frames'" in " ".join(refused.err)


def test_table4_stands_for_its_strategies():
    def names(strategies: str) -> list[str]:
        return [
            one.name
            for one in verb.Bench("sim-mini", strategies=strategies)._strategies()
        ]

    ablation = names("table4")
    assert {"icarl", "sars_old_output", "sars_spdd", "reservoir_spdd"} < set(ablation)
    assert names("joint,table4,er") == ["joint", *ablation]


def test_options_of_the_backbone_of_the_paper():
    ours, paper = (
        verb.Bench("sim-mini", backbone=b, steps=7) for b in ("evercal", "paper")
    )
    stage = paper._stage(3)
    assert (stage.seed, stage.fit.iterations) == (3, 7)
    assert stage.head.centres == "fixed"
    assert stage.head.width == ours._stage(3).head.width
    assert ours._stage(3).head.condition == "code"
    head = verb.Bench("sim-mini", backbone="paper_head", steps=7)._stage(3)
    assert (head.head, head.fit) == (stage.head, ours._stage(3).fit)
    whole, part = (
        verb.Bench("sim", preset="paper", batch=n)._stage(0) for n in (None, 2048)
    )
    assert (whole.fit.batch, whole.fit.replay_batch) == (40_960, 40_960)
    assert (whole.fit.peak_rate, whole.fit.matrix_rate) == (0.005, 0)
    assert whole.fit.iterations == 5_000
    assert verb.Bench("i7s", preset="paper")._stage(0).fit.iterations == 15_000
    changed = replace(whole.fit, batch=2048, replay_batch=2048)
    assert part == replace(whole, fit=changed)
    assert verb.Bench("sim-mini", batch=512)._stage(0).fit.replay_batch == 256
    twice = verb.Bench("sim-mini", batch=512, replay=2.0)._stage(0)
    assert (twice.fit.batch, twice.fit.replay_batch) == (512, 1024)
    for share in (0.0, -1.0, math.nan, 1e9):
        with pytest.raises(InputError, match="--replay"):
            verb.Bench("sim-mini", replay=share)._stage(0)
    shared = verb.Bench("sim-mini", backbone="paper", offsets="shared")._stage(0)
    assert (shared.head.offsets, shared.head.centres) == ("shared", "fixed")


def test_the_papers_working_images_are_not_larger_than_the_recorded(hall):
    def sides(factor: float) -> tuple[int, int]:
        frames = [
            replace(
                frame,
                camera=frame.camera.resized(round(320 * factor), round(240 * factor)),
            )
            for frame in hall.train[:2]
        ]
        return short_side("paper", frames), short_side("fast", frames)

    assert [sides(factor) for factor in (0.5, 1, 1.5, 3)] == [
        (s, 240) for s in (240, 240, 360, 480)
    ]


def test_a_folder_may_have_the_name_of_its_suite(run, monkeypatch, tmp_path):
    (tmp_path / "sim-mini").mkdir()
    monkeypatch.chdir(tmp_path)
    refused = run("bench sim-mini --strategies er --seeds x --out sim-mini")
    assert "--seeds x" in " ".join(refused.err), "the suite is run"
    refused = run("bench ./sim-mini")
    assert "no complete run" in " ".join(refused.err), "the folder is shown"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--memory auto", "only a map selects"),
        ("--preset paper --backbone paper_head", "omit the option"),
    ],
)
def test_options_that_contradict_are_refused(run, words, message):
    refused = run("bench sim-mini --strategies er --seeds 0", words)
    assert refused.code == 2
    assert message in " ".join(refused.err)
