"""One strategy with one seed over a sequence of scenes, going on where it was interrupted."""

import json
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

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
    """How a run is done."""

    stage: StageOptions
    """How a scene is learned; its seed is the run's."""
    short_side: int
    """Working size of images, pixels."""
    features: Path
    """Folder of encoded views, shared by all runs."""
    out: Path
    """Folder of results; stores under way are in its folder `runs`."""
    device: str = "cpu"
    """What the networks run on, see `features.device.device_of`."""


def run_strategy(
    strategy: Strategy, scenes: Sequence[Recording], options: RunOptions, on_event: OnEvent | None
) -> Iterator[tuple[int, tuple[SceneResult, ...]]]:
    """Learns the scenes in turn and judges all that are known after each.

    Args:
        strategy: what is learned.
        scenes: in order of learning.
        options: how.
        on_event: called with everything that happens while a scene is learned.

    Yields:
        (number, results) of the stages that were not done before, a result for each scene known;
        no results for the stages before the last of joint training.
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

    def stages(self) -> Iterator[tuple[int, tuple[SceneResult, ...]]]:
        """See `run_strategy`."""
        self._begin()
        for number in range(len(Store.open(self.store).stages) - 1, len(self.scenes)):
            if number >= len(Store.open(self.store).stages):
                learn_scene(self.store, self.scenes[number], self._how(), self.on_event)
            opened = Store.open(self.store)
            opened.maps.to(self.device)
            self._cached(opened.maps)
            seconds = float(opened.report()["seconds"])
            yield number, self._judge(opened.maps, number, seconds)
        self._remove()

    def _remove(self) -> None:
        shutil.rmtree(self.store, ignore_errors=True)
        self._network_fits.unlink(missing_ok=True)

    def _how(self, strategy: Strategy | None = None) -> LearnOptions:
        return LearnOptions(
            self.stage,
            strategy or self.strategy,
            short_side=self.options.short_side,
            device=self.device,
            cache=self.options.features,
        )

    def _begin(self) -> None:
        """The first scene, learned once for all strategies that learn it alike.

        What differs between them, the frames that stay, is chosen by each from the same head.
        """
        if (self.store / MANIFEST).exists():
            return
        self._remove()  # left by a commit that was killed
        scene, method = self.scenes[0], self.strategy.method
        # Beside a map the network learns frames as the map adjusted them.
        if self.strategy.builds_map or method is None or not method.first_scene_alike:
            learn_scene(self.store, scene, self._how(), self.on_event)
            return
        shared = self.store.with_name(f"first-{scene.name}-{self.stage.seed}")
        if not (shared / MANIFEST).exists():
            learn_scene(shared, scene, self._how(STRATEGIES["finetune"]), self.on_event)
        first = Store.open(shared)
        began = time.perf_counter()
        maps = first.maps.copy_for_training().to(self.device)
        maps.strategy, maps.keyframes, maps.method_states = self.strategy.name, [], []
        self._cached(maps)
        train, _ = validation_split(scene.train)
        learned = Learned(train, self._rows(maps, train))
        stage = finished_stage(maps, method, learned, self.stage)
        report = first.report()
        report["seconds"] = float(report["seconds"]) + time.perf_counter() - began
        report["frames_kept"] = stage.frames_kept
        open_or_create(self.store, self._how()).commit(maps, report)

    def _rows(self, maps: SceneMaps, train: Sequence[Frame]) -> Callable[[], FeatureBuffer]:
        """Rows of the first scene as it was trained on, encoded when they are first asked for."""

        @cache
        def rows() -> FeatureBuffer:
            buffer = scene_buffer(0, maps.scenes[0].cell, train, maps.device)
            finished(encoded(buffer, train, view_plan(self.stage, maps.short_side), maps))
            correct_lens(buffer, maps.scenes[0])
            return buffer

        return rows

    def _cached(self, maps: SceneMaps) -> None:
        cache_features(maps.encoder, self.options.features)  # pyright: ignore[reportArgumentType]

    def jointly(self) -> Iterator[tuple[int, tuple[SceneResult, ...]]]:
        """See `run_strategy`; a killed run begins anew."""
        self._remove()
        maps = open_or_create(self.store, self._how()).maps.to(self.device)
        self._cached(maps)
        split = [validation_split(scene.train) for scene in self.scenes]
        train_splits = [replace(s, train=t) for s, (t, _) in zip(self.scenes, split, strict=True)]
        began = time.perf_counter()
        for event in learn_jointly(maps, self.strategy, train_splits, self.stage):
            if isinstance(event, Stage):
                maps = event.maps
            elif self.on_event is not None:
                self.on_event(event)
        for number, (_, aside) in enumerate(split):
            maps.scenes[number] = fitted_record(maps, aside, number)
        seconds = time.perf_counter() - began
        last = len(self.scenes) - 1
        for number in range(last):
            yield number, ()
        yield last, self._judge(maps, last, seconds)
        self._remove()  # nothing was committed to it

    def _judge(self, maps: SceneMaps, number: int, seconds: float) -> tuple[SceneResult, ...]:
        """Results of all scenes known; of what answers alone, too, where several things answer."""
        name, localizer = self.strategy.name, Localizer(maps)
        found = self._results(name, localizer, number, seconds)
        if number == len(self.scenes) - 1:
            keep_views(self.options.out, name, localizer, self.scenes)
        if not self.strategy.builds_map:
            return found
        if self.strategy.method is None:
            localizer = Localizer(maps, LocalizeOptions(align=False))
            return found + self._results(name + UNALIGNED, localizer, number, seconds)
        alone = self._network_alone(maps, self.strategy.method.replays)
        return found + self._results(name + NETWORK, Localizer(alone), number, seconds)

    def _network_alone(self, maps: SceneMaps, replays: bool) -> SceneMaps:
        """What the network of the same training knows; keyframes stay where it replays them.

        Its thresholds are fitted when a scene is learned and then stay, as without a map.
        """
        alone, path = maps.copy_for_training(), self._network_fits
        path.parent.mkdir(parents=True, exist_ok=True)  # joint training commits no store
        for i, keyframes in enumerate(alone.keyframes):
            assert keyframes is not None, "a map has keyframes"
            images = Keyframes(keyframes.images, keyframes.cameras, keyframes.base_from_camera)
            alone.keyframes[i] = images if replays else None
        fits: list[list[float]] = json.loads(path.read_text()) if path.exists() else []
        for i in range(len(fits), len(alone.scenes)):
            _, aside = validation_split(self.scenes[i].train)
            record = fitted_record(alone, aside, i)
            fits.append([record.inlier_threshold, record.covariance_scale])
            write_json(path, fits)
        alone.scenes = [with_fit(r, *fit) for r, fit in zip(alone.scenes, fits, strict=True)]
        return alone

    def _results(
        self, name: str, localizer: Localizer, number: int, seconds: float
    ) -> tuple[SceneResult, ...]:
        maps = localizer.maps
        found = evaluate(localizer, {s.name: s for s in self.scenes[: number + 1]})
        size, keyframes = sum(head_bytes(head) for head in maps.heads), maps.keyframes[number]
        newest = self.scenes[number].name
        return tuple(
            scene_result(
                [r for r in found if r.scene == scene.name],
                strategy=name,
                seed=self.stage.seed,
                stage=number,
                seconds=seconds,
                memory_bytes=memory_bytes(maps, self.strategy),
                head_bytes=size,
                frames_kept=len(keyframes.images) if keyframes else 0,
                **(_spread(maps, number, self.scenes) if scene.name == newest else {}),
            )
            for scene in self.scenes[: number + 1]
        )


def _with_centres(stage: StageOptions, scenes: Sequence[Recording]) -> StageOptions:
    """The options with the centres of all scenes, where they are to be known in advance."""
    if stage.head.centres != "fixed" or stage.fixed_centres_m:
        return stage
    places = [stated_poses(validation_split(scene.train)[0]).translation_m for scene in scenes]
    found = combined_centres(places, stage.head.centres_per_scene, stage.seed)
    return replace(stage, grid_scenes=len(scenes), fixed_centres_m=found)


def _spread(maps: SceneMaps, number: int, scenes: Sequence[Recording]) -> dict[str, object]:
    """How the frames kept of a stage's scene lie among those learned."""
    keyframes = maps.keyframes[number]
    if keyframes is None or not keyframes.images:
        return {}
    train, _ = validation_split(scenes[number].train)
    poses = stated_poses(train)
    stood = keyframes.base_from_camera.translation_m
    gaps = np.linalg.norm(poses.translation_m[:, None] - stood[None], axis=-1)
    places = poses.translation_m, poses.rotation_wxyz, gaps.argmin(0)
    return {
        "keyframe_positions_m": tuple(tuple(round(float(v), 4) for v in row) for row in stood),
        "covering_radius": covering_radius(*places),
        "min_spacing": smallest_pair(*places),
    }
