"""`learn_networks`: its report, what it refuses, and what a killed call leaves."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from evercal.continual import threshold
from evercal.continual.learning.learn_networks import (
    NetworkLearnOptions,
    NetworkReport,
    learn_networks,
)
from evercal.continual.learning.stage import Part, StageOptions
from evercal.continual.networks.trainer import Progress
from evercal.continual.store import NetworkStore, head_bytes
from evercal.continual.strategies import STRATEGIES
from evercal.errors import InputError

from ..stages import Rooms, Tree


def noise(*_: object) -> list[np.ndarray]:
    """Negative images that need no rendering."""
    rng = np.random.default_rng(0)
    return [rng.integers(0, 256, (48, 64, 3)).astype(np.uint8) for _ in range(4)]


@pytest.fixture(scope="module")
def options(quick: StageOptions) -> Iterator[NetworkLearnOptions]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(threshold, "_negative_views", noise)
        yield NetworkLearnOptions(stage=quick, short_side=48)


@dataclass
class Learned:
    """A store after two scenes."""

    root: Path
    reports: list[NetworkReport]
    events: list[object]


@pytest.fixture(scope="module")
def learned(
    options: NetworkLearnOptions, rooms: Rooms, tmp_path_factory: pytest.TempPathFactory
) -> Learned:
    root = tmp_path_factory.mktemp("learned") / "store"
    events = []
    reports = [learn_networks(root, room, options, events.append) for room in rooms[:2]]
    return Learned(root, reports, events)


def test_reports_describe_the_store(learned: Learned) -> None:
    store = NetworkStore.open(learned.root)
    contents = store.contents
    assert [record.name for record in contents.scenes] == ["alpha", "beta"]
    reports = [json.loads(json.dumps(report.to_dict())) for report in learned.reports]
    assert reports == store.reports()
    for report, record, keyframes in zip(
        learned.reports, contents.scenes, contents.keyframes, strict=True
    ):
        assert keyframes is not None
        assert report.scene == record.name
        assert report.frames_kept == len(keyframes) <= 0.1 * 30
        assert report.train_frames == record.train_frames
        assert report.train_frames + report.held_out_frames == 30
        assert report.iterations == 8
        assert 0 < report.seconds < 600
        assert (report.landmarks, report.adjusted) == (0, None)
    first, last = learned.reports
    assert first.memory_bytes < last.memory_bytes == contents.memory_bytes
    assert last.head_bytes == head_bytes(contents.heads[0])
    assert {type(event) for event in learned.events} == {Part, Progress}


def test_bad_input_is_refused_and_leaves_the_store_unchanged(
    learned: Learned,
    rooms: Rooms,
    options: NetworkLearnOptions,
    tmp_path: Path,
    tree: Tree,
) -> None:
    def with_head(**change: object) -> StageOptions:
        head = replace(options.stage.head, **change)  # type: ignore[arg-type]
        return replace(options.stage, head=head)

    before = tree(learned.root)
    gamma = rooms[2]
    gripper = [
        replace(f, base_from_camera=None, base_from_gripper=f.base_from_camera)
        for f in gamma.train
    ]
    few = replace(gamma, train=gamma.train[:7])
    for recording, change, message in (
        (replace(gamma, name="alpha"), {}, "'alpha'.*`name`"),
        (gamma, {"strategy": STRATEGIES["finetune"]}, r"'finetune'.*'sars_pixels'"),
        (gamma, {"strategy": STRATEGIES["joint"]}, r"'joint'.*evercal bench"),
        (gamma, {"strategy": STRATEGIES["evercal"]}, r"'evercal'.*scene by scene"),
        (gamma, {"encoder": Path("encoder.onnx")}, "keeps the encoder"),
        (gamma, {"stage": with_head(centres_per_scene=5)}, "`centres`: .* made with"),
        (gamma, {"stage": with_head(offsets="shared")}, "`offsets`: .* made with"),
        (gamma, {"stage": with_head(condition="descriptor")}, "`backbone`: .* made"),
        (replace(gamma, train=tuple(gripper)), {}, "only gripper poses"),
        (few, {}, "'gamma': 7 training frames"),
    ):
        with pytest.raises(InputError, match=message):
            learn_networks(learned.root, recording, replace(options, **change))
    assert tree(learned.root) == before
    with pytest.raises(InputError, match="memory auto"):
        options.stage.with_memory("auto")
    with pytest.raises(InputError, match="7 training frames"):
        learn_networks(tmp_path / "new", few, options)
    assert not (tmp_path / "new").exists()
    (tmp_path / "thesis.tex").write_text("x")
    with pytest.raises(InputError, match="not an evercal store"):
        learn_networks(tmp_path, gamma, options)
    assert (tmp_path / "thesis.tex").read_text() == "x"


def test_second_writer_is_refused(
    rooms: Rooms, options: NetworkLearnOptions, tmp_path: Path
) -> None:
    store = tmp_path / "store"
    messages = []

    def intrude(_: object) -> None:
        if not messages:
            with pytest.raises(InputError, match="another process") as refusal:
                learn_networks(store, rooms[1], options)
            messages.append(str(refusal.value))

    learn_networks(store, rooms[0], options, intrude)
    assert len(messages) == 1
