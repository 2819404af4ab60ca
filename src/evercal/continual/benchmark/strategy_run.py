"""One run: a strategy with a seed over a sequence of scenes, resumed where it was interrupted."""

import json
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evercal.continual.benchmark.results import NETWORK, UNALIGNED, SceneResult, scene_result
from evercal.continual.benchmark.scene_views import keep_views
from evercal.continual.finish_scene import Learned, correct_lens, finished_stage, memory_bytes
from evercal.continual.learn_jointly import learn_jointly
from evercal.continual.learn_scene import (
    LearnOptions,
    OnEvent,
    learn_scene,
    open_or_create,
    validation_split,
)
from evercal.continual.networks.atlas import combined_centres
from evercal.continual.networks.buffer import FeatureBuffer
from evercal.continual.networks.feature_cache import cache_features
from evercal.continual.stage import Stage, StageOptions
from evercal.continual.stage_rows import encoded, scene_buffer, view_plan
from evercal.continual.strategies import STRATEGIES, Strategy
from evercal.evaluation.protocol import evaluate
from evercal.features.device import device_of
from evercal.localization.acceptance import fitted_record
from evercal.localization.localizer import Localizer
from evercal.localization.query import LocalizeOptions
from evercal.mapping.build import finished
from evercal.mapping.keyframes import Keyframes
from evercal.mapping.scene_maps import SceneMaps, with_fit
from evercal.mapping.selection import covering_radius, smallest_pair
from evercal.mapping.stage_files import head_bytes
from evercal.mapping.store import Store
from evercal.recordings import Frame, Recording, stated_poses
from evercal.storage import MANIFEST, write_json


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


class StageResults(NamedTuple):
    """Results after one stage."""

    stage: int
    """Number of the stage, from 0."""
    results: tuple[SceneResult, ...]
    """Results of all scenes learned so far; empty before the last stage of joint training."""


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
        self.strategy, self.scenes, self.on_event = strategy, scenes, on_event
        self.device = device_of(options.device)
        self.options, self.stage = options, _with_centres(options.stage, scenes)
        self.store = options.out / "runs" / f"{strategy.name}-{options.stage.seed}"
        self._network_fits = self.store.with_name(f"{self.store.name}.network.json")

    def stages(self) -> Iterator[StageResults]:
        """Learn scene after scene into a store; see `run_strategy`."""
        self._begin()
        for number in range(len(Store.open(self.store).stages) - 1, len(self.scenes)):
            if number >= len(Store.open(self.store).stages):
                learn_scene(self.store, self.scenes[number], self._learn_options(), self.on_event)
            opened = Store.open(self.store)
            maps = self._prepared(opened.maps)
            yield StageResults(
                number, self._evaluated(maps, number, float(opened.report()["seconds"]))
            )
        self._remove()

    def jointly(self) -> Iterator[StageResults]:
        """Learn all scenes at once; see `run_strategy`. An interrupted run starts again."""
        self._remove()
        maps = self._prepared(open_or_create(self.store, self._learn_options()).maps)
        splits = [validation_split(scene.train) for scene in self.scenes]
        train = [replace(s, train=t) for s, (t, _) in zip(self.scenes, splits, strict=True)]
        began = time.perf_counter()
        for event in learn_jointly(maps, self.strategy, train, self.stage):
            if isinstance(event, Stage):
                maps = event.maps
            elif self.on_event is not None:
                self.on_event(event)
        for number, (_, held_out) in enumerate(splits):
            maps.scenes[number] = fitted_record(maps, held_out, number)
        seconds = time.perf_counter() - began
        last = len(self.scenes) - 1
        yield from (StageResults(number, ()) for number in range(last))
        yield StageResults(last, self._evaluated(maps, last, seconds))
        self._remove()

    def _remove(self) -> None:
        shutil.rmtree(self.store, ignore_errors=True)
        self._network_fits.unlink(missing_ok=True)

    def _learn_options(self, strategy: Strategy | None = None) -> LearnOptions:
        return LearnOptions(
            self.stage,
            strategy or self.strategy,
            short_side=self.options.short_side,
            device=self.device,
            cache=self.options.features,
        )

    def _prepared(self, maps: SceneMaps) -> SceneMaps:
        """Move to the device of the run and share encoded views with other runs."""
        maps.to(self.device)
        cache_features(maps.encoder, self.options.features)  # pyright: ignore[reportArgumentType]
        return maps

    def _begin(self) -> None:
        """Learn the first scene, unless the store has it.

        Strategies that learn the first scene alike share its network. Each selects the frames to
        remember from the same head.
        """
        if (self.store / MANIFEST).exists():
            return
        self._remove()  # left by an interrupted commit
        scene, method = self.scenes[0], self.strategy.method
        # Beside a map, the network learns frames with the poses and camera that the map adjusted.
        if self.strategy.builds_map or method is None or not method.first_scene_alike:
            learn_scene(self.store, scene, self._learn_options(), self.on_event)
            return
        shared = self.store.with_name(f"first-{scene.name}-{self.stage.seed}")
        if not (shared / MANIFEST).exists():
            learn_scene(shared, scene, self._learn_options(STRATEGIES["finetune"]), self.on_event)
        first = Store.open(shared)
        began = time.perf_counter()
        maps = self._prepared(first.maps.copy_for_training())
        maps.strategy, maps.keyframes, maps.method_states = self.strategy.name, [], []
        train, _ = validation_split(scene.train)
        stage = finished_stage(maps, method, Learned(train, self._rows(maps, train)), self.stage)
        report = first.report()
        report["seconds"] = float(report["seconds"]) + time.perf_counter() - began
        report["frames_kept"] = stage.frames_kept
        open_or_create(self.store, self._learn_options()).commit(maps, report)

    def _rows(self, maps: SceneMaps, train: Sequence[Frame]) -> Callable[[], FeatureBuffer]:
        """Return a function that encodes the training rows of the first scene, once."""

        @cache
        def rows() -> FeatureBuffer:
            buffer = scene_buffer(0, maps.scenes[0].cell, train, maps.device)
            finished(encoded(buffer, train, view_plan(self.stage, maps.short_side), maps))
            correct_lens(buffer, maps.scenes[0])
            return buffer

        return rows

    def _evaluated(self, maps: SceneMaps, number: int, seconds: float) -> tuple[SceneResult, ...]:
        """Evaluate all scenes learned so far.

        A map is also evaluated without alignment. A network beside a map is also evaluated alone.
        """
        name, localizer = self.strategy.name, Localizer(maps)
        results = self._results(name, localizer, number, seconds)
        if number == len(self.scenes) - 1:
            keep_views(self.options.out, name, localizer, self.scenes)
        if not self.strategy.builds_map:
            return results
        if self.strategy.method is None:
            suffix, other = UNALIGNED, Localizer(maps, LocalizeOptions(align=False))
        else:
            network = self._without_map(maps, self.strategy.method.replays)
            suffix, other = NETWORK, Localizer(network)
        return results + self._results(name + suffix, other, number, seconds)

    def _without_map(self, maps: SceneMaps, replays: bool) -> SceneMaps:
        """Return the network without landmarks; a method that replays keeps the keyframe images.

        As without a map, thresholds are fitted once, when a scene is learned.
        """
        network, path = maps.copy_for_training(), self._network_fits
        for i, keyframes in enumerate(network.keyframes):
            assert keyframes is not None, "a map has keyframes"
            images = Keyframes(keyframes.images, keyframes.cameras, keyframes.base_from_camera)
            network.keyframes[i] = images if replays else None
        fits: list[list[float]] = json.loads(path.read_text()) if path.exists() else []
        for i in range(len(fits), len(network.scenes)):
            _, held_out = validation_split(self.scenes[i].train)
            record = fitted_record(network, held_out, i)
            fits.append([record.inlier_threshold, record.covariance_scale])
        path.parent.mkdir(parents=True, exist_ok=True)  # joint training commits no store
        write_json(path, fits)
        network.scenes = [with_fit(r, *fit) for r, fit in zip(network.scenes, fits, strict=True)]
        return network

    def _results(
        self, name: str, localizer: Localizer, number: int, seconds: float
    ) -> tuple[SceneResult, ...]:
        maps, scenes = localizer.maps, self.scenes[: number + 1]
        frames = evaluate(localizer, {scene.name: scene for scene in scenes})
        keyframes = maps.keyframes[number]
        return tuple(
            scene_result(
                [frame for frame in frames if frame.scene == scene.name],
                strategy=name,
                seed=self.stage.seed,
                stage=number,
                seconds=seconds,
                memory_bytes=memory_bytes(maps, self.strategy),
                head_bytes=sum(head_bytes(head) for head in maps.heads),
                frames_kept=len(keyframes.images) if keyframes else 0,
                **(_coverage(keyframes, scene) if scene is scenes[-1] else {}),
            )
            for scene in scenes
        )


def _with_centres(stage: StageOptions, scenes: Sequence[Recording]) -> StageOptions:
    """Add the centres of all scenes to options that need them in advance."""
    if stage.head.centres != "fixed" or stage.fixed_centres_m:
        return stage
    positions = [stated_poses(validation_split(scene.train)[0]).translation_m for scene in scenes]
    centres = combined_centres(positions, stage.head.centres_per_scene, stage.seed)
    return replace(stage, grid_scenes=len(scenes), fixed_centres_m=centres)


def _coverage(keyframes: Keyframes | None, scene: Recording) -> dict[str, object]:
    """Measure how the remembered frames of a scene cover its training frames."""
    if keyframes is None or not keyframes.images:
        return {}
    train, _ = validation_split(scene.train)
    poses = stated_poses(train)
    positions = keyframes.base_from_camera.translation_m
    distances = np.linalg.norm(poses.translation_m[:, None] - positions[None], axis=-1)
    selection = poses.translation_m, poses.rotation_wxyz, distances.argmin(0)
    return {
        "keyframe_positions_m": tuple(tuple(round(float(v), 4) for v in p) for p in positions),
        "covering_radius": covering_radius(*selection),
        "min_spacing": smallest_pair(*selection),
    }
