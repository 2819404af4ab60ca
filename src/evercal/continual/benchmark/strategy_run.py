"""One run: a strategy with a seed over a sequence of scenes, resumed where it was interrupted."""

import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import field, replace
from functools import cache
from pathlib import Path
from time import perf_counter
from typing import Literal

import pandas as pd
from filelock import FileLock

from evercal.classes import frozen
from evercal.continual.benchmark.overlays import record_overlay
from evercal.continual.benchmark.results import (
    CURVES,
    StageResults,
    frame_row,
    record_environment,
    scene_row,
)
from evercal.continual.learning.checkpoint import CHECKPOINT
from evercal.continual.learning.learn import finish_scene, learn_jointly
from evercal.continual.learning.learn_networks import (
    NetworkLearnOptions,
    learn_networks,
)
from evercal.continual.learning.stage import (
    OnEvent,
    Part,
    StageOptions,
    Watched,
    unobserved,
)
from evercal.continual.learning.stage_rows import StageRows
from evercal.continual.localizer import NetworkLocalizeOptions, NetworkLocalizer
from evercal.continual.networks.atlas import combined_centres
from evercal.continual.networks.buffer import FeatureBuffer
from evercal.continual.networks.device import device_of
from evercal.continual.networks.feature_cache import cache_features
from evercal.continual.scenes import LearnedScenes
from evercal.continual.store import NetworkStore, head_bytes
from evercal.continual.strategies import STRATEGIES, Strategy
from evercal.evaluation.protocol import evaluate
from evercal.learning.scene import learn_scene
from evercal.localization.localizer import Localizer
from evercal.localization.pictures import SceneLocalizer
from evercal.mapping.store import MapStore
from evercal.recordings import Recording, stated_poses
from evercal.recordings.frame import posed_recording
from evercal.storage.stages import is_store
from evercal.typing import JsonObject, Record

NETWORK_LOCALIZE = NetworkLocalizeOptions(refuses=False)
"""Networks answer for every image, as published methods do. A refusal rule would favour methods
whose inliers stay above the threshold that was fitted when a scene was learned."""

Order = Literal["given", "reversed", "shuffled", "balanced"]


@frozen
class BenchOptions:
    """Options of a benchmark."""

    stage: Callable[[int], StageOptions]
    """Options for learning a scene, given the seed. With `centres: fixed` and no given centres, the
    centres of all scenes are known from the start, in the paper's combined grid."""
    strategies: tuple[Strategy, ...]
    """Strategies to compare, each with a unique name."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds; every strategy runs once with each."""
    order: Order = "given"
    """Order of the scenes; `shuffled` and `balanced` depend on the seed."""
    short_side: int = 240
    """Working size of images, pixels."""
    settings: JsonObject = field(default_factory=dict)
    """Further settings that decide the results, for settings.json."""
    device: str = "auto"
    """Device of the networks, see `networks.device.device_of`."""
    on_event: OnEvent = unobserved
    """Called with every event of a training, for progress bars."""


def run_strategy(
    strategy: Strategy,
    scenes: Sequence[Recording],
    options: BenchOptions,
    seed: int,
    out: Path,
) -> Iterator[StageResults]:
    """Learn the scenes in turn and evaluate all scenes learned so far after each.

    Yields results of the stages that were not complete before. The folder `out` has the stores of
    runs in progress in `runs`, and encoded views in `features`.
    """
    if not strategy.method:
        return _MapRun(strategy, scenes, options, seed, out).stages()
    run = _NetworkRun(strategy, scenes, options, seed, out)
    if strategy.jointly:
        return run.jointly()
    return run.stages()


class _Run:
    """A strategy over a sequence of scenes; its store is removed at the end."""

    def __init__(
        self,
        strategy: Strategy,
        scenes: Sequence[Recording],
        options: BenchOptions,
        seed: int,
        out: Path,
    ):
        self.strategy = strategy
        self.scenes = list(map(posed_recording, scenes))
        self.out = out
        self.device = device_of(options.device)
        self.short_side = options.short_side
        self.on_event = options.on_event
        self.stage = _with_centres(options.stage(seed), self.scenes)
        self.features = out.absolute() / "features"
        self.curves = out / CURVES
        self.store = out / "runs" / f"{strategy.name}-{seed}"

    def _remove(self) -> None:
        shutil.rmtree(self.store, ignore_errors=True)
        self.store.with_name(f".{self.store.name}.lock").unlink(missing_ok=True)

    def _evaluated(
        self, localizer: SceneLocalizer, number: int, costs: Record
    ) -> StageResults:
        """Evaluate all scenes learned so far."""
        results = []
        frames = []
        costs = {**costs, "environment": record_environment(self.out)}
        run = {"strategy": self.strategy.name, "seed": self.stage.seed}
        learned = {scene.name: scene for scene in self.scenes[: number + 1]}

        def located(done: int, total: int) -> None:
            self.on_event(Part("locating", done, total))

        evaluated = evaluate(localizer, learned, on_frame=located)
        last = len(learned) == len(self.scenes)
        for name, scene in learned.items():
            of_scene = [frame for frame in evaluated if frame.scene == name]
            results.append({**run, "stage": number, **scene_row(of_scene), **costs})
            if last:
                frames += [run | frame_row(frame) for frame in of_scene]
                record_overlay(self.out, self.strategy.name, scene, of_scene)
        return StageResults(number, pd.DataFrame(results), pd.DataFrame(frames))


class _MapRun(_Run):
    """Builds a map."""

    def stages(self) -> Iterator[StageResults]:
        if not is_store(self.store):
            self._remove()  # left by an interrupted commit
        for number in range(max(0, len(self._opened().stages) - 1), len(self.scenes)):
            opened = self._opened()
            cache_features(opened.contents.encoder, self.features)
            if number >= len(opened.stages):
                memory = self.stage.memory
                size = f"{100 * memory.share:g}%"
                if memory.bytes:
                    size = f"{memory.bytes}B"
                scene, report = learn_scene(self.scenes[number], opened.contents, size)
                opened.commit(scene, report.to_dict())
            contents = opened.contents
            costs = {
                "seconds": float(opened.reports()[-1]["seconds"]),
                "memory_bytes": contents.memory_bytes,
                "head_bytes": 0,
                "frames_kept": len(contents.scenes[-1].keyframes),
            }
            yield self._evaluated(Localizer(contents), number, costs)
        self._remove()

    def _opened(self) -> MapStore:
        if is_store(self.store):
            return MapStore.open(self.store)
        return MapStore.create(self.store, short_side=self.short_side)


class _NetworkRun(_Run):
    """Trains a network."""

    def stages(self) -> Iterator[StageResults]:
        self._begin()
        complete = len(NetworkStore.open(self.store).stages)
        for number in range(complete - 1, len(self.scenes)):
            if number >= complete:
                self._learn(self.store, self.scenes[number], self.strategy)
            opened = NetworkStore.open(self.store)
            seconds = float(opened.reports()[-1]["seconds"])
            yield self._located(self._prepared(opened.contents), number, seconds)
        self._remove()

    def jointly(self) -> Iterator[StageResults]:
        folder = self.curves / self.store.name
        folder.mkdir(parents=True, exist_ok=True)
        empty = self._prepared(self._new_store().contents)
        watched = Watched(self.on_event)
        began = perf_counter()
        learned = learn_jointly(empty, self.scenes, self.stage, watched, folder)
        seconds = watched.last.earlier_s + perf_counter() - began
        yield self._located(learned, len(self.scenes) - 1, seconds)
        (folder / CHECKPOINT).unlink(missing_ok=True)

    def _learn(self, store: Path, scene: Recording, strategy: Strategy) -> None:
        options = NetworkLearnOptions(
            strategy=strategy,
            stage=self.stage,
            short_side=self.short_side,
            device=str(self.device),
            cache=self.features,
            holds_out=False,
            folder=self.curves / f"{store.name}-{scene.name}",
        )
        learn_networks(store, scene, options, self.on_event)

    def _new_store(self) -> NetworkStore:
        return NetworkStore.create(self.store, self.strategy.name, self.short_side)

    def _prepared(self, scenes: LearnedScenes) -> LearnedScenes:
        scenes.to(self.device)
        scenes.cache = self.features
        return scenes

    def _begin(self) -> None:
        """Learn the first scene, unless the store has it.

        All strategies share its network. Each selects the frames to remember from the same head.
        """
        if is_store(self.store):
            return
        self._remove()  # left by an interrupted commit
        scene = self.scenes[0]
        method = self.strategy.method
        assert method, "a network has a method"
        shared = self.store.with_name(f"first-{scene.name}-{self.stage.seed}")
        # Another process may be learning it.
        with FileLock(shared.with_name(f"{shared.name}.claim")):
            if not is_store(shared) or not NetworkStore.open(shared).stages:
                self._learn(shared, scene, STRATEGIES["finetune"])
        first = NetworkStore.open(shared)
        began = perf_counter()
        scenes = self._prepared(first.contents.copy_for_training())
        scenes.strategy = self.strategy.name
        scenes.keyframes = []
        scenes.method_states = []

        @cache
        def rows() -> FeatureBuffer:
            [record] = scenes.scenes
            return StageRows(scenes, self.stage).of_scene(0, record.cell, scene.train)

        finish_scene(scenes, method, scene.train, rows, self.stage)
        report = first.reports()[-1]
        report["seconds"] = float(report["seconds"]) + perf_counter() - began
        report["frames_kept"] = scenes.frames_kept
        self._new_store().commit(scenes, report)

    def _located(
        self, scenes: LearnedScenes, number: int, seconds: float
    ) -> StageResults:
        costs = {
            "seconds": seconds,
            "memory_bytes": scenes.memory_bytes,
            "head_bytes": sum(map(head_bytes, scenes.heads)),
            "frames_kept": scenes.frames_kept,
        }
        cache_features(scenes.encoder, self.features)  # test frames are located often
        localizer = NetworkLocalizer(scenes, NETWORK_LOCALIZE)
        return self._evaluated(localizer, number, costs)


def _with_centres(stage: StageOptions, scenes: Sequence[Recording]) -> StageOptions:
    if stage.head.centres != "fixed" or stage.fixed_centres_m:
        return stage
    positions = [stated_poses(scene.train).translation_m for scene in scenes]
    centres = combined_centres(positions, stage.head.centres_per_scene, stage.seed)
    return replace(stage, grid_scenes=len(scenes), fixed_centres_m=centres)
