"""One run: a strategy with a seed over a sequence of scenes, resumed where it was interrupted."""

import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path

import pandas as pd
from filelock import FileLock
from torch import nn

from evercal.continual.benchmark.results import (
    UNALIGNED,
    StageResults,
    frame_row,
    record_environment,
    scene_row,
)
from evercal.continual.learning.finish_scene import correct_lens, finished_stage
from evercal.continual.learning.learn import learn_jointly
from evercal.continual.learning.learn_networks import NetworkLearnOptions, learn_networks
from evercal.continual.learning.stage import StageOptions, unobserved
from evercal.continual.learning.stage_rows import encode_rows, scene_buffer, view_plan
from evercal.continual.localizer import NetworkLocalizeOptions, NetworkLocalizer
from evercal.continual.networks.atlas import combined_centres
from evercal.continual.networks.buffer import FeatureBuffer
from evercal.continual.networks.feature_cache import cache_features
from evercal.continual.scenes import LearnedScenes
from evercal.continual.store import NetworkStore, head_bytes
from evercal.continual.strategies import STRATEGIES, Strategy
from evercal.continual.threshold import fit_threshold
from evercal.evaluation.protocol import evaluate
from evercal.features.device import device_of
from evercal.learning.scene import learn_scene
from evercal.localization.learned import LearnedLocalizer
from evercal.localization.localizer import Localizer
from evercal.localization.query import LocalizeOptions
from evercal.mapping.keyframes import Keyframes
from evercal.mapping.store import MapStore
from evercal.recordings import Frame, Recording, stated_poses
from evercal.recordings.held_out import split_held_out
from evercal.storage.stages import is_store

NETWORK_LOCALIZE = NetworkLocalizeOptions(refuses=False)
"""Networks answer for every image, as published methods do. A refusal rule would favour methods
whose inliers stay above the threshold that was fitted when a scene was learned."""


@dataclass(frozen=True)
class RunOptions:
    """Options of a run."""

    stage: StageOptions
    """Options for learning a scene, with the seed of the run."""
    short_side: int
    """Working size of images, pixels."""
    out: Path
    """Folder of results; `runs` has the stores of runs in progress, `features` encoded views."""
    device: str = "cpu"
    """Device of the networks, see `features.device.device_of`."""


def run_strategy(
    strategy: Strategy, scenes: Sequence[Recording], options: RunOptions
) -> Iterator[StageResults]:
    """Learn the scenes in turn and evaluate all scenes learned so far after each.

    Yields:
        Results of the stages that were not complete before.
    """
    if strategy.method is None:
        return _MapRun(strategy, scenes, options).stages()
    run = _NetworkRun(strategy, scenes, options)
    return run.jointly() if strategy.jointly else run.stages()


class _Run:
    """A strategy over a sequence of scenes; the store of the run is removed at its end."""

    def __init__(self, strategy: Strategy, scenes: Sequence[Recording], options: RunOptions):
        self.strategy, self.scenes = strategy, scenes
        self.device = device_of(options.device)
        self.options, self.stage = options, _with_centres(options.stage, scenes)
        self.features = options.out.absolute() / "features"
        self.store = options.out / "runs" / f"{strategy.name}-{options.stage.seed}"

    def _remove(self) -> None:
        shutil.rmtree(self.store, ignore_errors=True)
        self.store.with_name(f".{self.store.name}.lock").unlink(missing_ok=True)

    def _evaluated(
        self,
        localizers: Mapping[str, LearnedLocalizer],
        number: int,
        newest: Keyframes | None,
        costs: Mapping[str, object],
    ) -> StageResults:
        """Evaluate all scenes learned so far by localizers, each by the name of its results."""
        results, frames = [], []
        environment = record_environment(self.options.out)
        costs = {**costs, "frames_kept": len(newest.images) if newest else 0}
        for name, localizer in localizers.items():
            run = {"strategy": name, "seed": self.stage.seed, "stage": number}
            evaluated = evaluate(localizer, {s.name: s for s in self.scenes[: number + 1]})
            for scene in self.scenes[: number + 1]:
                of_scene = [frame for frame in evaluated if frame.scene == scene.name]
                results.append({**run, **scene_row(of_scene), **costs, "environment": environment})
                frames += [{**run, **frame_row(frame)} for frame in of_scene]
        table = pd.DataFrame(frames).drop(columns="stage")
        last = number == len(self.scenes) - 1
        return StageResults(number, pd.DataFrame(results), table if last else table[:0])


class _MapRun(_Run):
    """Builds a map; it is also evaluated without alignment."""

    def stages(self) -> Iterator[StageResults]:
        """Learn scene after scene into a map; see `run_strategy`."""
        if not is_store(self.store):
            self._remove()  # left by an interrupted commit
        for number in range(max(0, len(self._opened().stages) - 1), len(self.scenes)):
            opened = self._opened()
            contents = opened.contents.to(self.device)
            assert isinstance(contents.encoder, nn.Module)
            cache_features(contents.encoder, self.features)
            if number >= len(opened.stages):
                memory = self.stage.memory
                size = memory.bytes or f"{100 * memory.share:g}%"
                scene, report = learn_scene(self.scenes[number], contents, size)
                opened.commit(scene, asdict(report))
            name, unaligned = self.strategy.name, LocalizeOptions(align=False)
            named = {name: Localizer(contents), name + UNALIGNED: Localizer(contents, unaligned)}
            seconds = float(opened.reports()[-1]["seconds"])
            costs = {"seconds": seconds, "memory_bytes": contents.memory_bytes, "head_bytes": 0}
            yield self._evaluated(named, number, contents.scenes[-1].keyframes, costs)
        self._remove()

    def _opened(self) -> MapStore:
        if is_store(self.store):
            return MapStore.open(self.store)
        return MapStore.create(self.store, short_side=self.options.short_side)


class _NetworkRun(_Run):
    """Trains a network."""

    def stages(self) -> Iterator[StageResults]:
        """Learn scene after scene into a store; see `run_strategy`."""
        self._begin()
        for number in range(len(NetworkStore.open(self.store).stages) - 1, len(self.scenes)):
            if number >= len(NetworkStore.open(self.store).stages):
                self._learn(self.store, self.scenes[number], self.strategy)
            opened = NetworkStore.open(self.store)
            seconds = float(opened.reports()[-1]["seconds"])
            yield self._located(self._prepared(opened.contents), number, seconds)
        self._remove()

    def jointly(self) -> Iterator[StageResults]:
        """Learn all scenes at once; see `run_strategy`. An interrupted run starts again."""
        self._remove()
        empty = self._prepared(self._new_store().contents)
        splits = [split_held_out(scene.train) for scene in self.scenes]
        train = [replace(s, train=t.train) for s, t in zip(self.scenes, splits, strict=True)]
        began = time.perf_counter()
        learned = learn_jointly(empty, train, self.stage, unobserved).scenes
        for number, split in enumerate(splits):
            learned.scenes[number] = fit_threshold(learned, split.held_out, number)
        seconds = time.perf_counter() - began
        last = len(self.scenes) - 1
        nothing = pd.DataFrame()
        yield from (StageResults(number, nothing, nothing) for number in range(last))
        yield self._located(learned, last, seconds)

    def _learn(self, store: Path, scene: Recording, strategy: Strategy) -> None:
        options = NetworkLearnOptions(
            strategy=strategy,
            stage=self.stage,
            short_side=self.options.short_side,
            device=str(self.device),
            cache=self.features,
        )
        learn_networks(store, scene, options, unobserved)

    def _new_store(self) -> NetworkStore:
        return NetworkStore.create(self.store, self.strategy.name, self.options.short_side)

    def _prepared(self, scenes: LearnedScenes) -> LearnedScenes:
        scenes.to(self.device)
        cache_features(scenes.encoder, self.features)  # pyright: ignore[reportArgumentType]
        scenes.cache = self.features
        return scenes

    def _begin(self) -> None:
        """Learn the first scene, unless the store has it.

        All strategies share its network. Each selects the frames to remember from the same head.
        """
        if is_store(self.store):
            return
        self._remove()  # left by an interrupted commit
        scene, method = self.scenes[0], self.strategy.method
        assert method is not None, "a network has a method"
        shared = self.store.with_name(f"first-{scene.name}-{self.stage.seed}")
        # Another process may be learning it.
        with FileLock(shared.with_name(f"{shared.name}.claim")):
            if not is_store(shared) or not NetworkStore.open(shared).stages:
                self._learn(shared, scene, STRATEGIES["finetune"])
        first = NetworkStore.open(shared)
        began = time.perf_counter()
        scenes = self._prepared(first.contents.copy_for_training())
        scenes.strategy, scenes.keyframes, scenes.method_states = self.strategy.name, [], []
        train = split_held_out(scene.train).train
        stage = finished_stage(scenes, method, train, self._rows(scenes, train), self.stage)
        report = first.reports()[-1]
        report["seconds"] = float(report["seconds"]) + time.perf_counter() - began
        report["frames_kept"] = stage.frames_kept
        self._new_store().commit(scenes, report)

    def _rows(self, scenes: LearnedScenes, train: Sequence[Frame]) -> Callable[[], FeatureBuffer]:
        @cache
        def rows() -> FeatureBuffer:
            buffer = scene_buffer(0, scenes.scenes[0].cell, train, scenes.device)
            encode_rows(buffer, train, view_plan(self.stage, scenes.short_side), scenes)
            correct_lens(buffer, scenes.scenes[0])
            return buffer

        return rows

    def _located(self, scenes: LearnedScenes, number: int, seconds: float) -> StageResults:
        costs = {
            "seconds": seconds,
            "memory_bytes": scenes.memory_bytes,
            "head_bytes": sum(head_bytes(head) for head in scenes.heads),
        }
        localizer = NetworkLocalizer(scenes, NETWORK_LOCALIZE)
        named = {self.strategy.name: localizer}
        return self._evaluated(named, number, scenes.keyframes[number], costs)


def _with_centres(stage: StageOptions, scenes: Sequence[Recording]) -> StageOptions:
    if stage.head.centres != "fixed" or stage.fixed_centres_m:
        return stage
    positions = [stated_poses(split_held_out(scene.train).train).translation_m for scene in scenes]
    centres = combined_centres(positions, stage.head.centres_per_scene, stage.seed)
    return replace(stage, grid_scenes=len(scenes), fixed_centres_m=centres)
