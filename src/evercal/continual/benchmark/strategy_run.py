"""One run: a strategy with a seed over a sequence of scenes, resumed where it was interrupted."""

import json
import math
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
from filelock import FileLock

from evercal.continual.benchmark.results import (
    NETWORK,
    UNALIGNED,
    StageResults,
    frame_row,
    record_environment,
    scene_row,
)
from evercal.continual.learning.finish_scene import (
    Learned,
    correct_lens,
    finished_stage,
    memory_bytes,
)
from evercal.continual.learning.learn_jointly import learn_jointly
from evercal.continual.learning.learn_scene import (
    NetworkLearnOptions,
    OnEvent,
    learn_networks,
    with_fitted_threshold,
)
from evercal.continual.learning.stage import Stage, StageOptions
from evercal.continual.learning.stage_rows import encoded, scene_buffer, view_plan
from evercal.continual.localizer import NetworkLocalizeOptions, NetworkLocalizer, localizer_of
from evercal.continual.networks.atlas import combined_centres
from evercal.continual.networks.buffer import FeatureBuffer
from evercal.continual.networks.feature_cache import cache_features
from evercal.continual.scenes import LearnedScenes
from evercal.continual.store import NetworkStore, head_bytes
from evercal.continual.strategies import STRATEGIES, Strategy
from evercal.continual.threshold import fit_threshold
from evercal.evaluation.protocol import evaluate
from evercal.features.device import device_of
from evercal.localization.learned import LearnedLocalizer
from evercal.localization.localizer import Localizer
from evercal.localization.query import LocalizeOptions
from evercal.mapping.keyframes import Keyframes
from evercal.mapping.selection import PoseSpace
from evercal.recordings import Frame, Recording, stated_poses
from evercal.recordings.held_out import split_held_out
from evercal.storage import write_json
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
    features: Path
    """Folder of encoded views, shared by all runs."""
    out: Path
    """Folder of results; its subfolder `runs` has the stores of runs in progress."""
    device: str = "cpu"
    """Device of the networks, see `features.device.device_of`."""


def run_strategy(
    strategy: Strategy, scenes: Sequence[Recording], options: RunOptions, on_event: OnEvent | None
) -> Iterator[StageResults]:
    """Learn the scenes in turn and evaluate all scenes learned so far after each.

    Args:
        strategy: Strategy to run.
        scenes: Scenes in order of learning.
        options: Options of the run.
        on_event: Called with every event while a scene is learned.

    Yields:
        Results of the stages that were not complete before.
    """
    run = _Run(strategy, scenes, options, on_event)
    return run.jointly() if strategy.jointly else run.stages()


class _Run:
    def __init__(
        self,
        strategy: Strategy,
        scenes: Sequence[Recording],
        options: RunOptions,
        on_event: OnEvent | None,
    ):
        self.strategy, self.scenes = strategy, scenes
        self.on_event: OnEvent = on_event or (lambda _: None)
        self.device = device_of(options.device)
        self.options, self.stage = options, _with_centres(options.stage, scenes)
        self.store = options.out / "runs" / f"{strategy.name}-{options.stage.seed}"
        self._network_fits = self.store.with_name(f"{self.store.name}.network.json")

    def stages(self) -> Iterator[StageResults]:
        """Learn scene after scene into a store; see `run_strategy`."""
        self._begin()
        for number in range(len(NetworkStore.open(self.store).stages) - 1, len(self.scenes)):
            if number >= len(NetworkStore.open(self.store).stages):
                self._learn(self.store, self.scenes[number], self.strategy)
            opened = NetworkStore.open(self.store)
            seconds = float(opened.reports()[-1]["seconds"])
            scenes = self._prepared(opened.contents)
            yield self._evaluated(scenes, number, seconds)
        self._remove()

    def jointly(self) -> Iterator[StageResults]:
        """Learn all scenes at once; see `run_strategy`. An interrupted run starts again."""
        self._remove()
        learned = self._prepared(self._new_store().contents)
        splits = [split_held_out(scene.train) for scene in self.scenes]
        train = [replace(s, train=t.train) for s, t in zip(self.scenes, splits, strict=True)]
        began = time.perf_counter()
        for event in learn_jointly(learned, self.strategy, train, self.stage):
            if isinstance(event, Stage):
                learned = event.scenes
            else:
                self.on_event(event)
        for number, split in enumerate(splits):
            learned.scenes[number] = with_fitted_threshold(learned, split.held_out, number)
        seconds = time.perf_counter() - began
        last = len(self.scenes) - 1
        nothing = pd.DataFrame()
        yield from (StageResults(number, nothing, nothing) for number in range(last))
        yield self._evaluated(learned, last, seconds)
        self._remove()

    def _remove(self) -> None:
        shutil.rmtree(self.store, ignore_errors=True)
        self.store.with_name(f".{self.store.name}.lock").unlink(missing_ok=True)
        self._network_fits.unlink(missing_ok=True)

    def _learn(self, store: Path, scene: Recording, strategy: Strategy) -> None:
        options = NetworkLearnOptions(
            strategy=strategy,
            stage=self.stage,
            short_side=self.options.short_side,
            device=str(self.device),
            cache=self.options.features,
        )
        learn_networks(store, scene, options, self.on_event)

    def _new_store(self) -> NetworkStore:
        return NetworkStore.create(self.store, self.strategy.name, self.options.short_side)

    def _prepared(self, scenes: LearnedScenes) -> LearnedScenes:
        """Move to the device of the run and share encoded views with other runs."""
        scenes.to(self.device)
        cache_features(scenes.encoder, self.options.features)  # pyright: ignore[reportArgumentType]
        scenes.cache = self.options.features
        return scenes

    def _begin(self) -> None:
        """Learn the first scene, unless the store has it.

        Strategies that learn the first scene alike share its network. Each selects the frames to
        remember from the same head.
        """
        if is_store(self.store):
            return
        self._remove()  # left by an interrupted commit
        scene, method = self.scenes[0], self.strategy.method
        # Beside a map, the network learns frames with the poses and camera that the map adjusted.
        if self.strategy.builds_map or method is None or not method.first_scene_alike:
            self._learn(self.store, scene, self.strategy)
            return
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
        learned = Learned(train, self._rows(scenes, train))
        stage = finished_stage(scenes, method, learned, self.stage)
        report = first.reports()[-1]
        report["seconds"] = float(report["seconds"]) + time.perf_counter() - began
        report["frames_kept"] = stage.frames_kept
        self._new_store().commit(scenes, report)

    def _rows(self, scenes: LearnedScenes, train: Sequence[Frame]) -> Callable[[], FeatureBuffer]:
        """Return a function that encodes the training rows of the first scene, once."""

        @cache
        def rows() -> FeatureBuffer:
            buffer = scene_buffer(0, scenes.scenes[0].cell, train, scenes.device)
            for _ in encoded(buffer, train, view_plan(self.stage, scenes.short_side), scenes):
                pass
            correct_lens(buffer, scenes.scenes[0])
            return buffer

        return rows

    def _evaluated(self, scenes: LearnedScenes, number: int, seconds: float) -> StageResults:
        """Evaluate all scenes learned so far.

        A map is also evaluated without alignment. A network beside a map is also evaluated alone.
        """
        name = self.strategy.name
        judged: list[tuple[str, LearnedLocalizer, LearnedScenes]] = [
            (name, localizer_of(scenes, NETWORK_LOCALIZE), scenes)
        ]
        if self.strategy.builds_map and self.strategy.method is None:
            unaligned = Localizer(scenes.map_contents(), LocalizeOptions(align=False))
            judged.append((name + UNALIGNED, unaligned, scenes))
        elif self.strategy.builds_map and self.strategy.method is not None:
            network = self._without_map(scenes, self.strategy.method.replays)
            alone = NetworkLocalizer(network, NETWORK_LOCALIZE)
            judged.append((name + NETWORK, alone, network))
        results, frames = [], []
        for judged_name, localizer, learned in judged:
            run = {"strategy": judged_name, "seed": self.stage.seed, "stage": number}
            costs = self._costs(learned, number, seconds)
            evaluated = evaluate(localizer, {s.name: s for s in self.scenes[: number + 1]})
            for scene in self.scenes[: number + 1]:
                of_scene = [frame for frame in evaluated if frame.scene == scene.name]
                newest = learned.keyframes[number] if scene is self.scenes[number] else None
                coverage = _coverage(newest, scene)
                results.append({**run, **scene_row(of_scene), **costs, **coverage})
                frames += [{**run, **frame_row(frame)} for frame in of_scene]
        table = pd.DataFrame(frames).drop(columns="stage")
        last = number == len(self.scenes) - 1
        return StageResults(number, pd.DataFrame(results), table if last else table[:0])

    def _costs(self, learned: LearnedScenes, number: int, seconds: float) -> dict[str, object]:
        keyframes = learned.keyframes[number]
        return {
            "seconds": seconds,
            "memory_bytes": memory_bytes(learned, self.strategy),
            "head_bytes": sum(head_bytes(head) for head in learned.heads),
            "frames_kept": len(keyframes.images) if keyframes else 0,
            "environment": record_environment(self.options.out),
        }

    def _without_map(self, scenes: LearnedScenes, replays: bool) -> LearnedScenes:
        """Return the network without maps; a method that replays keeps the keyframe images.

        As without a map, thresholds are fitted once, when a scene is learned.
        """
        network, path = scenes.copy_for_training(), self._network_fits
        for i, keyframes in enumerate(network.keyframes):
            assert keyframes is not None, "a map has keyframes"
            images = Keyframes(keyframes.images, keyframes.cameras, keyframes.base_from_camera)
            network.keyframes[i] = images if replays else None
            record = network.scenes[i]
            # Training took the camera that the map adjusted.
            network.scenes[i] = replace(record, map=None, refined_camera=record.adjusted_camera)
        fits: list[list[float]] = json.loads(path.read_text()) if path.exists() else []
        for i in range(len(fits), len(network.scenes)):
            held_out = split_held_out(self.scenes[i].train).held_out
            record = fit_threshold(network, held_out, i)
            fits.append([record.inlier_threshold, record.covariance_scale])
        path.parent.mkdir(parents=True, exist_ok=True)  # joint training commits no store
        write_json(path, fits)
        network.scenes = [
            replace(record, inlier_threshold=threshold, covariance_scale=scale)
            for record, (threshold, scale) in zip(network.scenes, fits, strict=True)
        ]
        return network


def _with_centres(stage: StageOptions, scenes: Sequence[Recording]) -> StageOptions:
    """Add the centres of all scenes to options that need them in advance."""
    if stage.head.centres != "fixed" or stage.fixed_centres_m:
        return stage
    positions = [stated_poses(split_held_out(scene.train).train).translation_m for scene in scenes]
    centres = combined_centres(positions, stage.head.centres_per_scene, stage.seed)
    return replace(stage, grid_scenes=len(scenes), fixed_centres_m=centres)


def _coverage(keyframes: Keyframes | None, scene: Recording) -> dict[str, float]:
    """Measure how the remembered frames of a scene cover its training frames, in SARS's metric.

    Returns:
        The largest distance from a training frame to a remembered one, and the smallest distance
        between two remembered frames; NaN without remembered frames.
    """
    if keyframes is None or not keyframes.images:
        return {"covering_radius": math.nan, "min_spacing": math.nan}
    poses = stated_poses(split_held_out(scene.train).train)
    positions = keyframes.base_from_camera.translation_m
    distances = np.linalg.norm(poses.translation_m[:, None] - positions[None], axis=-1)
    selected = distances.argmin(0)
    space = PoseSpace.of(poses.translation_m, poses.rotation_wxyz)
    gaps = np.stack([space.distances(int(i)) for i in selected])
    pairs = gaps[:, selected][np.triu_indices(len(selected), 1)]
    smallest = float(pairs.min()) if len(pairs) else math.nan
    return {"covering_radius": float(gaps.min(0).max()), "min_spacing": smallest}
