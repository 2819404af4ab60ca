"""The benchmark: strategies over a sequence of scenes, what is missing is run, what is done kept.

    OUT/settings.json             what decides the results; a folder of other settings is refused
    OUT/results.jsonl             see `evaluation.outcomes`
    OUT/views/                    see `evaluation.views`; of each strategy's first run
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

from evercal.continual import penalties
from evercal.continual import strategies as rules
from evercal.continual.atlas import combined_centres
from evercal.continual.candidates import Candidates
from evercal.continual.keeping import keep, note_of, plain_rows
from evercal.continual.knowledge import Knowledge
from evercal.continual.learn import Stage, StageOptions, learn
from evercal.continual.memory import Memory
from evercal.continual.robot import Robot, head_bytes, with_fit
from evercal.continual.selection import covering_radius, smallest_pair
from evercal.continual.strategies import STRATEGIES
from evercal.datasets import Frame, Scene, known_poses
from evercal.errors import InputError
from evercal.evaluation import outcomes
from evercal.evaluation.outcomes import Outcome, outcome_of
from evercal.evaluation.protocol import evaluate
from evercal.evaluation.views import keep_views
from evercal.localization.localizer import Localizer
from evercal.localization.teach import (
    LearnOptions,
    OnEvent,
    fit_threshold,
    hold_out,
    learn_scene,
    open_or_create,
)
from evercal.models.descriptor import DESCRIPTOR_FILE
from evercal.models.encoder import ENCODER_FILE
from evercal.models.feature_cache import cache_features
from evercal.storage import MANIFEST, hold_settings, sha256_file
from evercal.training.buffer import FeatureBuffer

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
    outcomes: tuple[Outcome, ...]
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
    found = {(o.strategy, o.seed, o.stage) for o in outcomes.read(out)}
    done = total - len(missing) * len(scenes)
    for seed, strategy in missing:
        ordered = in_order(scenes, options.order, seed)
        for stage, these in _Run(ordered, options, out, strategy, seed).stages(on_event):
            if (strategy, seed, stage) not in found:
                outcomes.append(out, these)
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
    hold_settings(out / outcomes.SETTINGS, _settings(scenes, options))
    found = {(o.strategy, o.seed) for o in outcomes.read(out) if o.stage == len(scenes) - 1}
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
    replay += [penalties.OUTPUT_WEIGHT_PX_PER_M, penalties.REPLAY_WEIGHT, rules.PROTECTION]
    return {
        **asdict(replace(stage, seed=0, fill=replace(stage.fill, seed=0))),
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
            places = [known_poses(hold_out(scene.train)[0]).translation_m for scene in scenes]
            found = combined_centres(places, self.stage.head.centres_per_scene, seed)
            self.stage = replace(self.stage, grid_scenes=len(scenes), fixed_centres_m=found)

    def stages(self, on_event: OnEvent | None) -> Iterator[tuple[int, tuple[Outcome, ...]]]:
        """(number, outcomes) of the stages that were not done before."""
        if self.rule.data == "all":
            yield from self._joint(on_event)
            return
        self._begin(on_event)
        for number in range(len(Robot.open(self.store).stages) - 1, len(self.scenes)):
            if number >= len(Robot.open(self.store).stages):
                learn_scene(self.store, self.scenes[number], self._how(self.strategy), on_event)
            robot = Robot.open(self.store)
            self._cached(robot.known)
            seconds = float(robot.report()["seconds"])
            yield number, self._judge(robot.known, number, seconds)
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
        shared = self.out / "runs" / f"first-{scene.name}-{self.seed}"
        if not (shared / MANIFEST).exists():
            learn_scene(shared, scene, self._how("finetune"), on_event)
        first = Robot.open(shared)
        began = time.perf_counter()
        known = first.known.fork()
        known.strategy = self.strategy
        train, aside = hold_out(scene.train)
        self._cached(known)
        rows = self._rows(known, 0, train)
        memory = self._kept(known, 0, train, rows)
        known.memories, known.notes = [memory], []  # not those of who learned it
        known.notes = [note_of(known, rows())] if self.rule.note else [{}]
        if self.rule.recall:  # more cells agree, so more must
            known.scenes[0] = with_fit(known.scenes[0], *fit_threshold(known, aside))
        report = first.report()
        report["seconds"] = float(report["seconds"]) + time.perf_counter() - began
        report["frames_kept"] = len(memory.images) if memory else 0
        open_or_create(self.store, self._how(self.strategy)).commit(known, report)

    def _rows(
        self, known: Knowledge, number: int, train: Sequence[Frame]
    ) -> Callable[[], FeatureBuffer]:
        """Rows of a scene's training frames as they are, encoded when they are first asked for."""

        @cache
        def rows() -> FeatureBuffer:
            _, local = known.head_for(number)
            buffer = FeatureBuffer(local, known.scenes[number].cell.atlas_from_base)
            return plain_rows(buffer, train, known)

        return rows

    def _kept(
        self,
        known: Knowledge,
        number: int,
        train: Sequence[Frame],
        rows: Callable[[], FeatureBuffer],
    ) -> Memory | None:
        """What the strategy remembers of a scene, with the head as it is now."""
        head, _ = known.head_for(number)
        frames = Candidates(train, head, rows, self.seed)
        capacity = self.stage.capacity(train, known.short_side)
        return keep(known, train, frames, capacity, known.scenes[number].refined_camera)

    def _cached(self, known: Knowledge) -> None:
        cache_features(known.encoder, self.features)  # pyright: ignore[reportArgumentType]

    def _joint(self, on_event: OnEvent | None) -> Iterator[tuple[int, tuple[Outcome, ...]]]:
        """All scenes at once, with the steps of all stages; the stages before only note a scene."""
        how = self._how(self.strategy)
        known = Robot.create(self.store, self.strategy, self.options.short_side).known
        self._cached(known)
        split = [hold_out(scene.train) for scene in self.scenes]
        lessons = [replace(s, train=t) for s, (t, _) in zip(self.scenes, split, strict=True)]
        began = time.perf_counter()
        for number, lesson in enumerate(lessons):
            last = number == len(lessons) - 1
            steps = how.stage.fit.iterations * len(lessons) if last else 0
            stage = replace(how.stage, fit=replace(how.stage.fit, iterations=steps))
            if not last:
                stage = replace(stage, fill=replace(stage.fill, passes=1))
            for event in learn(known, lesson, stage, None, lessons[:number]):
                if isinstance(event, Stage):
                    known = event.knowledge
                elif on_event is not None:
                    on_event(event)
            if not last:
                yield number, ()
        for i, (train, aside) in enumerate(split):
            known.memories[i] = self._kept(known, i, train, self._rows(known, i, train))
            known.scenes[i] = with_fit(known.scenes[i], *fit_threshold(known, aside, i))
        seconds = time.perf_counter() - began
        yield len(lessons) - 1, self._judge(known, len(lessons) - 1, seconds)

    def _judge(self, known: Knowledge, number: int, seconds: float) -> tuple[Outcome, ...]:
        learned = {scene.name: scene for scene in self.scenes[: number + 1]}
        localizer = Localizer(known)
        results = evaluate(localizer, learned)
        if number == len(self.scenes) - 1:
            keep_views(self.out, self.strategy, localizer, self.scenes)
        size, memory = sum(head_bytes(head) for head in known.heads), known.memories[number]
        return tuple(
            outcome_of(
                [r for r in results if r.scene == name],
                strategy=self.strategy,
                seed=self.seed,
                stage=number,
                seconds=seconds,
                memory_bytes=known.memory_bytes,
                head_bytes=size,
                frames_kept=len(memory.images) if memory else 0,
                **(self._spread(known, number) if name == self.scenes[number].name else {}),
            )
            for name in learned
        )

    def _spread(self, known: Knowledge, number: int) -> dict[str, object]:
        """How the frames kept of a stage's scene lie among those learned."""
        memory = known.memories[number]
        if memory is None or not memory.images:
            return {}
        train, _ = hold_out(self.scenes[number].train)
        poses = known_poses(train)
        stood = memory.base_from_camera.translation_m
        gaps = np.linalg.norm(poses.translation_m[:, None] - stood[None], axis=-1)
        places = poses.translation_m, poses.rotation_wxyz, gaps.argmin(0)
        return {
            "kept_m": tuple(tuple(round(float(v), 4) for v in row) for row in stood),
            "covering": covering_radius(*places),
            "closest": smallest_pair(*places),
        }
