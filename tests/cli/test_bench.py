"""`evercal bench` and `bench-report`: tables, one JSON object, and refused input."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from evercal.cli import bench as verb
from evercal.continual.benchmark.results import RESULTS, STRATEGIES
from evercal.continual.learning.presets import short_side
from evercal.recordings import generic

if TYPE_CHECKING:
    from evercal.continual.learning.stage import StageOptions
    from evercal.recordings import Recording


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, quick: StageOptions) -> None:
    """Tiny stages."""
    monkeypatch.setattr(verb.Bench, "_stage", lambda self, seed: replace(quick, seed=seed))


def test_bench_and_its_report(
    run: Any, small: None, arcs: tuple[Recording, Recording], tmp_path: Path
) -> None:
    folders = []
    for scene in arcs:
        folders.append(tmp_path / scene.name)
        generic.write(folders[-1], replace(scene, train=scene.train[:20], test=scene.test[:8]))
    words = ["custom", *folders, "--strategies", "evercal,finetune", "--seeds", "0"]
    first = run("bench", *words, "--out", tmp_path / "out")
    assert first.code == 0, first.err
    assert "[4/4] finetune seed 0: one " in first.out
    # A map is also evaluated without alignment, under its own name.
    line = next(line for line in first.out.splitlines() if line.startswith("[2/4] evercal"))
    assert "evercal:unaligned seed 0: one " in line
    assert "evercal - finetune" in first.out
    assert "BWT (backward transfer): mean change" in first.out
    again = run("bench", *words, "--out", tmp_path / "out", "--json")
    assert again.code == 0
    (summary,) = json.loads(again.out)["strategies"]["evercal"]
    assert summary["scenes"] == ["one", "two"]
    assert summary["accuracy_5cm_5deg"][0][1] is None
    report = run("bench-report", tmp_path / "out")
    assert report.code == 0
    assert "| evercal " in (tmp_path / "out" / "tables.md").read_text()
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count("<img ") == 12
    assert "Scenes at the estimated poses" in page
    assert "<dt>TFR</dt>" in page
    assert "evercal - finetune" in page
    assert r"\multicolumn{3}{c}{finetune}" in (tmp_path / "out" / "table.tex").read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["attic"], "suite 'attic': unknown; choose one of sim-mini"),
        (["custom"], "suite custom: give scene folders for the suites custom and regions only"),
        (["sim-mini", "somewhere"], "suite sim-mini: give scene folders for the suites custom"),
        (["sim-mini", "--strategies", "evercal,magic"], "strategy 'magic': unknown; choose one of"),
        (["sim-mini", "--seeds", "0,one"], "--seeds 0,one: give comma-separated numbers"),
        (["sim-mini", "--seeds", ","], "--seeds ,: give comma-separated numbers"),
        (["sim-mini", "--strategies", "er@3"], "strategy 'er@3': unknown; choose one of"),
        (["sim-mini", "--rows", "table5"], "rows table5: give spdd-sweep, table4, with-map"),
        (["sim-mini", "--rows", "nowhere.json"], "rows nowhere.json: no such file"),
        (["sim-mini", "--steps", "0"], "--steps 0: give a number >= 1"),
        (["sim-mini", "--batch", "63"], "--batch 63: give a number >= 64"),
        (["sim-mini", "--memory", "all"], "--memory all: give a share"),
        (["sim-mini", "--scenes", "bedroom"], "two or more"),
        (["real2"], "--data"),
    ],
)
def test_unusable_input_is_refused(
    run: Any, words: list[str], message: str, tmp_path: Path
) -> None:
    ran = run("bench", *words, "--out", tmp_path / "out")
    assert ran.code == 2
    assert message in " ".join(" ".join(ran.err).split())
    assert not (tmp_path / "out").exists()


def test_folder_without_results_is_refused(run: Any, tmp_path: Path) -> None:
    ran = run("bench-report", tmp_path)
    assert ran.code == 2
    assert "no results here" in ran.err[0]


def test_held_out_frames_are_training_frames(
    run: Any, small: None, arcs: tuple[Recording, Recording], tmp_path: Path
) -> None:
    folders = []
    for scene in arcs:
        folders.append(tmp_path / scene.name)
        generic.write(folders[-1], replace(scene, train=scene.train[:30], test=scene.test[:2]))
    rows = tmp_path / "rows.json"
    # Equal strategies run once.
    rows.write_text(
        '[{"name": "er", "of": "er"}, {"name": "er_3", "of": "er", "with": {"weight": 0.9}}]'
    )
    words = ["custom", *folders, "--strategies", "er", "--rows", rows, "--seeds", "0", "--held-out"]
    assert run("bench", *words, "--out", tmp_path / "out").code == 0
    lines = [json.loads(line) for line in (tmp_path / "out" / RESULTS).read_text().splitlines()]
    train = {frame.name for scene in arcs for frame in scene.train}
    ran = [(line["strategy"], line["stage"], line["scene"]) for line in lines]
    stages = [(0, "one"), (1, "one"), (1, "two")]
    assert ran == [(name, *stage) for name in ("er", "er_3") for stage in stages]
    described = json.loads((tmp_path / "out" / STRATEGIES).read_text())
    assert [described[name]["method"]["weight"] for name in ("er", "er_3")] == [0.3, 0.9]
    assert {len(line["frames"]) for line in lines} == {6}
    assert {name for line in lines for name in line["frames"]} <= train
    # Results on test frames are not mixed with these.
    refused = run("bench", *words[:-1], "--out", tmp_path / "out")
    assert refused.code == 2
    assert "now it is 'test frames'" in " ".join(refused.err)


def test_rows_replace_the_default_strategies() -> None:
    def names(rows: str | None = None, strategies: str | None = None) -> list[str]:
        bench = verb.Bench("sim-mini", rows=rows, strategies=strategies)
        return [one.name for one in bench._strategies()]

    alone = names(rows="table4")
    assert "sars_spdd" in alone
    assert not {"evercal", "joint", "finetune"} & set(alone)
    assert names(rows="table4", strategies="joint") == ["joint", *alone]
    assert names() == ["evercal", "joint", "finetune", "er", "sars_spdd"]


def test_options_of_the_backbone_of_the_paper() -> None:
    ours, paper = (verb.Bench("sim-mini", backbone=b, steps=7) for b in ("evercal", "paper"))
    stage = paper._stage(3)
    assert (stage.seed, stage.fit.iterations) == (3, 7)
    assert stage.head.centres == "fixed"
    assert stage.head.width == ours._stage(3).head.width
    assert ours._stage(3).head.condition == "code"
    head = verb.Bench("sim-mini", backbone="paper_head", steps=7)._stage(3)
    assert (head.head, head.fit) == (stage.head, ours._stage(3).fit)
    whole, part = (verb.Bench("sim", preset="paper", batch=n)._stage(0) for n in (None, 2048))
    assert (whole.fit.batch, whole.fit.replay_batch) == (40_960, 40_960)
    changed = replace(whole.fit, batch=2048, replay_batch=2048)
    assert part == replace(whole, fit=changed)
    assert verb.Bench("sim-mini", batch=512)._stage(0).fit.replay_batch == 256
    shared = verb.Bench("sim-mini", backbone="paper", offsets="shared")._stage(0)
    assert (shared.head.offsets, shared.head.centres) == ("shared", "fixed")


def test_the_papers_working_images_are_not_larger_than_the_recorded(hall: Recording) -> None:
    def sides(factor: float) -> tuple[int, int]:
        frames = [
            replace(frame, camera=frame.camera.resized(round(320 * factor), round(240 * factor)))
            for frame in hall.train[:2]
        ]
        return short_side("paper", frames), short_side("fast", frames)

    assert [sides(factor) for factor in (0.5, 1, 1.5, 3)] == [
        (s, 240) for s in (240, 240, 360, 480)
    ]
