"""The benchmark: strategies over a sequence of scenes, what is missing is run, what is done kept.

    OUT/settings.json             what decides the results; a folder of other settings is refused
    OUT/results.jsonl             see `benchmark.results`
    OUT/views/                    see `benchmark.scene_views`; of each strategy's first run
    OUT/features/                 encoded views, shared by all runs; may be deleted
    OUT/runs/STRATEGY-SEED/       a store under way, gone when its sequence is done
    OUT/runs/first-SCENE-SEED/    the first scene, which all strategies learn alike

A run that is killed goes on from the checkpoint inside its stage, as `evercal learn` does.
"""

import shutil
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np

from evercal.benchmark import results
from evercal.benchmark.results import SceneResult, scene_result
from evercal.benchmark.scene_views import keep_views
from evercal.continual import strategies as rules
from evercal.continual.finish_scene import (
    mapped_record,
    method_state_of,
    plain_rows,
    select_keyframes,
)
from evercal.continual.frame_statistics import FrameStatistics
from evercal.continual.learn import Stage, StageOptions, learn
from evercal.continual.learn_scene import (
    LearnOptions,
    OnEvent,
    learn_scene,
    open_or_create,
    validation_split,
)
from evercal.continual.methods import penalties
from evercal.continual.strategies import STRATEGIES
from evercal.datasets import Frame, Scene, known_poses
from evercal.errors import InputError
from evercal.evaluation.protocol import evaluate
from evercal.features.descriptor import DESCRIPTOR_FILE
from evercal.features.encoder import ENCODER_FILE
from evercal.features.feature_cache import cache_features
from evercal.localization.acceptance import fitted_record
from evercal.localization.localizer import Localizer
from evercal.mapping.atlas import combined_centres
from evercal.mapping.build import finished
from evercal.mapping.keyframes import Keyframes
from evercal.mapping.scene_maps import SceneMaps, SceneRecord
from evercal.mapping.selection import covering_radius, smallest_pair
from evercal.mapping.stage_files import head_bytes
from evercal.mapping.store import Store
from evercal.networks.buffer import FeatureBuffer
from evercal.storage import MANIFEST, lock_settings, sha256_file

Order = Literal["given", "reversed", "shuffled"]


@dataclass(frozen=True)
class BenchOptions:
    """What is compared."""

    stage: Callable[[int], StageOptions]
    """How a scene is learned, given the seed. With `centres: fixed` and none given, those of all
    scenes are there from the start, in the paper's combined grid."""
    strategies: tuple[str, ...]
    """Keys of STRATEGIES."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Runs of each."""
    order: Order = "given"
    """In which the scenes come; `shuffled` differs from seed to seed."""
    short_side: int = 240
    """Working size of images, pixels."""
    settings: dict[str, object] = field(default_factory=dict)
    """What else decides the results, for settings.json."""
    features: Path | None = None
    """Where encoded views are kept; in the folder of results when None."""


@dataclass(frozen=True)
class Step:
    """A stage that is done."""

    strategy: str
    """Which strategy."""
    seed: int
    """Which run."""
    results: tuple[SceneResult, ...]
    """One per scene learned so far; none for the stages before the last of joint training."""
    done: int
    """Stages done so far, those of earlier calls included."""
    total: int
    """Stages of the whole benchmark."""


def run_bench(
    scenes: Sequence[Scene], options: BenchOptions, out: Path, on_event: OnEvent | None = None
) -> Generator[Step, None, None]:
    """Runs what is missing.

    Args:
        scenes: two or more, in the order `given`.
        options: what is compared.
        out: folder of results; made when missing.
        on_event: called with everything that happens while a scene is learned.

    Raises:
        InputError: fewer than two scenes, an unknown strategy, or a folder of other settings.

    Yields:
        A `Step` after every stage that was run.
    """
    total = len(options.seeds) * len(options.strategies) * len(scenes)
    missing = begin_bench(scenes, options, out)
    found = {(o.strategy, o.seed, o.stage) for o in results.read(out)}
    done = total - len(missing) * len(scenes)
    for seed, strategy in missing:
        ordered = in_order(scenes, options.order, seed)
        for stage, these in _Run(ordered, options, out, strategy, seed).stages(on_event):
            if (strategy, seed, stage) not in found:
                results.append(out, these)
            yield Step(strategy, seed, these, done + stage + 1, total)
        done += len(scenes)


def begin_bench(scenes: Sequence[Scene], options: BenchOptions, out: Path) -> list[tuple[int, str]]:
    """Checks what is asked against the folder of results.

    Returns:
        (seed, strategy) of the runs whose last stage is not there yet, in order.

    Raises:
        InputError: see `run_bench`.
    """
    if len(scenes) < 2:
        raise InputError(f"{len(scenes)} scene: forgetting takes two or more; give more scenes")
    for name in options.strategies:
        rules.compose(name)
    lock_settings(out / results.SETTINGS, _settings(scenes, options))
    found = {(o.strategy, o.seed) for o in results.read(out) if o.stage == len(scenes) - 1}
    runs = [(seed, strategy) for seed in options.seeds for strategy in options.strategies]
    return [(seed, strategy) for seed, strategy in runs if (strategy, seed) not in found]


def in_order(scenes: Sequence[Scene], order: Order, seed: int) -> list[Scene]:
    """The scenes as a run meets them."""
    if order == "reversed":
        return list(scenes)[::-1]
    if order == "shuffled":
        return [scenes[i] for i in np.random.default_rng([seed, 11]).permutation(len(scenes))]
    return list(scenes)


def _settings(scenes: Sequence[Scene], options: BenchOptions) -> dict[str, object]:
    stage = options.stage(0)
    replay = [penalties.REPLAY_CLAMP_PX, penalties.TEACHER_LIMIT_PX]
    replay += [penalties.OUTPUT_WEIGHT_PX_PER_M, penalties.REPLAY_WEIGHT, rules.PRECONDITIONING]
    return {
        **asdict(replace(stage, seed=0, encode=replace(stage.encode, seed=0))),
        "replay": replay,
        "weights": {cost.__name__: weight for cost, weight in rules.WEIGHTS.items()},
        "networks": [sha256_file(file)[:12] for file in (ENCODER_FILE, DESCRIPTOR_FILE)],
        "order": options.order,
        "short_side": options.short_side,
        "scenes": [[scene.name, len(scene.train), len(scene.test)] for scene in scenes],
        **options.settings,
    }


class _Run:
    """One strategy, one seed."""

    def __init__(
        self, scenes: list[Scene], options: BenchOptions, out: Path, strategy: str, seed: int
    ):
        self.scenes, self.options, self.out = scenes, options, out
        self.strategy, self.seed, self.rule = strategy, seed, STRATEGIES[strategy]
        self.features = options.features or out / "features"
        self.store = out / "runs" / f"{strategy}-{seed}"
        self.stage = options.stage(seed)
        if self.stage.head.centres == "fixed" and not self.stage.fixed_centres_m:
            places = [
                known_poses(validation_split(scene.train)[0]).translation_m for scene in scenes
            ]
            found = combined_centres(places, self.stage.head.centres_per_scene, seed)
            self.stage = replace(self.stage, grid_scenes=len(scenes), fixed_centres_m=found)

    def stages(self, on_event: OnEvent | None) -> Iterator[tuple[int, tuple[SceneResult, ...]]]:
        """(number, outcomes) of the stages that were not done before."""
        if self.rule.data == "all":
            yield from self._joint(on_event)
            return
        self._begin(on_event)
        for number in range(len(Store.open(self.store).stages) - 1, len(self.scenes)):
            if number >= len(Store.open(self.store).stages):
                learn_scene(self.store, self.scenes[number], self._how(self.strategy), on_event)
            opened = Store.open(self.store)
            self._cached(opened.maps)
            seconds = float(opened.report()["seconds"])
            yield number, self._judge(opened.maps, number, seconds)
        shutil.rmtree(self.store)

    def _how(self, strategy: str) -> LearnOptions:
        return LearnOptions(
            self.stage,
            strategy,
            short_side=self.options.short_side,
            cache=self.features,
        )

    def _begin(self, on_event: OnEvent | None) -> None:
        """The first scene, learned once for all strategies that learn it alike.

        What differs between them, the frames that stay, is chosen by each from the same head.
        """
        if (self.store / MANIFEST).exists():
            return
        shutil.rmtree(self.store, ignore_errors=True)  # left by a commit that was killed
        scene = self.scenes[0]
        if not self.rule.network:
            learn_scene(self.store, scene, self._how(self.strategy), on_event)
            return
        shared = self.out / "runs" / f"first-{scene.name}-{self.seed}"
        if not (shared / MANIFEST).exists():
            learn_scene(shared, scene, self._how("finetune"), on_event)
        first = Store.open(shared)
        began = time.perf_counter()
        maps = first.maps.copy_for_training()
        maps.strategy = self.strategy
        train, aside = validation_split(scene.train)
        self._cached(maps)
        rows = self._rows(maps, 0, train)
        keyframes, maps.scenes[0] = self._kept(maps, 0, train, rows)
        maps.keyframes, maps.method_states = [keyframes], []  # not those of who learned it
        maps.method_states = [method_state_of(maps, rows())] if self.rule.after_scene else [{}]
        if self.rule.build_map:  # another threshold than the network's alone
            maps.scenes[0] = fitted_record(maps, aside, 0)
        report = first.report()
        report["seconds"] = float(report["seconds"]) + time.perf_counter() - began
        report["frames_kept"] = len(keyframes.images) if keyframes else 0
        open_or_create(self.store, self._how(self.strategy)).commit(maps, report)

    def _rows(
        self, maps: SceneMaps, number: int, train: Sequence[Frame]
    ) -> Callable[[], FeatureBuffer]:
        """Rows of a scene's training frames as they are, encoded when they are first asked for."""

        @cache
        def rows() -> FeatureBuffer:
            _, local = maps.head_for(number)
            buffer = FeatureBuffer(local, maps.scenes[number].cell.atlas_from_base)
            return plain_rows(buffer, train, maps)

        return rows

    def _kept(
        self,
        maps: SceneMaps,
        number: int,
        train: Sequence[Frame],
        rows: Callable[[], FeatureBuffer],
    ) -> tuple[Keyframes | None, SceneRecord]:
        """The keyframes of a scene, chosen with the head as it is now, and the scene's record."""
        head, _ = maps.head_for(number)
        frames = FrameStatistics(train, head, rows, self.seed)
        capacity = self.stage.capacity(train, maps.short_side)
        record = maps.scenes[number]
        keyframes, scene_map = finished(
            select_keyframes(maps, train, frames, capacity, record.refined_camera, self.stage.map)
        )
        return keyframes, mapped_record(record, scene_map)

    def _cached(self, maps: SceneMaps) -> None:
        cache_features(maps.encoder, self.features)  # pyright: ignore[reportArgumentType]

    def _joint(self, on_event: OnEvent | None) -> Iterator[tuple[int, tuple[SceneResult, ...]]]:
        """All scenes at once, with the steps of all stages; the stages before only note a scene."""
        how = self._how(self.strategy)
        maps = Store.create(self.store, self.strategy, self.options.short_side).maps
        self._cached(maps)
        split = [validation_split(scene.train) for scene in self.scenes]
        train_splits = [replace(s, train=t) for s, (t, _) in zip(self.scenes, split, strict=True)]
        began = time.perf_counter()
        for number, train_split in enumerate(train_splits):
            last = number == len(train_splits) - 1
            steps = how.stage.fit.iterations * len(train_splits) if last else 0
            stage = replace(how.stage, fit=replace(how.stage.fit, iterations=steps))
            if not last:
                stage = replace(stage, encode=replace(stage.encode, views_per_frame=1))
            for event in learn(maps, train_split, stage, None, train_splits[:number]):
                if isinstance(event, Stage):
                    maps = event.maps
                elif on_event is not None:
                    on_event(event)
            if not last:
                yield number, ()
        for i, (train, aside) in enumerate(split):
            kept = self._kept(maps, i, train, self._rows(maps, i, train))
            maps.keyframes[i], maps.scenes[i] = kept
            maps.scenes[i] = fitted_record(maps, aside, i)
        seconds = time.perf_counter() - began
        yield len(train_splits) - 1, self._judge(maps, len(train_splits) - 1, seconds)

    def _judge(self, maps: SceneMaps, number: int, seconds: float) -> tuple[SceneResult, ...]:
        learned = {scene.name: scene for scene in self.scenes[: number + 1]}
        localizer = Localizer(maps)
        found = evaluate(localizer, learned)
        if number == len(self.scenes) - 1:
            keep_views(self.out, self.strategy, localizer, self.scenes)
        size, keyframes = sum(head_bytes(head) for head in maps.heads), maps.keyframes[number]
        return tuple(
            scene_result(
                [r for r in found if r.scene == name],
                strategy=self.strategy,
                seed=self.seed,
                stage=number,
                seconds=seconds,
                memory_bytes=maps.memory_bytes,
                head_bytes=size,
                frames_kept=len(keyframes.images) if keyframes else 0,
                **(self._spread(maps, number) if name == self.scenes[number].name else {}),
            )
            for name in learned
        )

    def _spread(self, maps: SceneMaps, number: int) -> dict[str, object]:
        """How the frames kept of a stage's scene lie among those learned."""
        keyframes = maps.keyframes[number]
        if keyframes is None or not keyframes.images:
            return {}
        train, _ = validation_split(self.scenes[number].train)
        poses = known_poses(train)
        stood = keyframes.base_from_camera.translation_m
        gaps = np.linalg.norm(poses.translation_m[:, None] - stood[None], axis=-1)
        places = poses.translation_m, poses.rotation_wxyz, gaps.argmin(0)
        return {
            "keyframe_positions_m": tuple(tuple(round(float(v), 4) for v in row) for row in stood),
            "covering_radius": covering_radius(*places),
            "min_spacing": smallest_pair(*places),
        }
