"""Strategies over a sequence of scenes: run, kept on disk, compared with bounds."""

import copy
import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from tabulate import tabulate

from evercal.continual import strategies
from evercal.continual.candidates import Candidates
from evercal.continual.keeping import keep, plain_rows
from evercal.continual.knowledge import Knowledge
from evercal.continual.learn import Stage, StageOptions, learn
from evercal.continual.presets import preset
from evercal.continual.robot import head_bytes, with_fit
from evercal.continual.strategies import STRATEGIES as RULES
from evercal.datasets.frame import Scene
from evercal.evaluation.metrics import correct
from evercal.evaluation.protocol import evaluate
from evercal.evaluation.statistics import paired_difference
from evercal.localization.localizer import Localizer
from evercal.localization.teach import fit_threshold, hold_out
from evercal.models.descriptor import load_descriptor
from evercal.models.encoder import load_encoder
from evercal.storage import hold_settings
from evercal.training.buffer import FeatureBuffer

SHORT_SIDE = 240
PAPER_BACKBONE = ("sars_spdd",)
"""Strategies that run as the paper has them: descriptor in the input, all centres in advance."""


def stage_options(seed: int) -> StageOptions:
    """A short stage for scenes in a row: `fast` with 1,000 steps and half of its views."""
    options = preset("fast", seed)
    fill = replace(options.fill, passes=2)
    return replace(options, fit=replace(options.fit, iterations=1000), fill=fill)


@dataclass
class Outcome:
    """One strategy, one seed, one sequence."""

    correct: list[dict[str, list[bool]]]
    """After every stage, for each scene learned so far: which test frames are right."""
    seconds: list[float]
    """Wall time of every stage; a first stage that strategies share counts where it was run."""
    memory_bytes: int
    head_bytes: int
    frames_kept: list[int]
    wrong_scene: float
    """Share (%) of test frames located in another scene, at the end."""


# First stages by (what they depend on, scene, seed): strategies that differ only in what follows
# start from the same network.
_first_stages: dict[tuple[str, str, int, int], Knowledge] = {}


def _settings() -> dict[str, object]:
    """What decides the results, but for the code."""
    rules = {name: [rule.penalty_per_scene, rule.protection] for name, rule in RULES.items()}
    replay = [strategies.REPLAY_CLAMP_PX, strategies.TEACHER_LIMIT_PX]
    replay += [strategies.OUTPUT_WEIGHT_PX_PER_M, strategies.REPLAY_WEIGHT]
    return {**asdict(stage_options(0)), "rules": rules, "replay": replay}


class Runner:
    """Runs strategies over one sequence of scenes; results are read from disk when they are there.

    Args:
        scenes: in order of learning.
        out: folder of results.

    Raises:
        InputError: the folder holds results of other settings.
    """

    def __init__(self, scenes: Sequence[Scene], out: Path):
        self.scenes, self.out = list(scenes), out
        hold_settings(out / "settings.json", _settings())
        self.lessons, self.held_out = [], []
        for scene in scenes:
            train, aside = hold_out(scene.train)
            self.lessons.append(replace(scene, train=train))
            self.held_out.append(aside)

    @property
    def names(self) -> list[str]:
        """Scene names in order."""
        return [scene.name for scene in self.scenes]

    def result(self, strategy: str, seed: int) -> Outcome:
        """The outcome of a strategy with a seed."""
        if strategy == "joint" and self.names != sorted(self.names):
            # All frames at once: the order of arrival plays no part.
            return Runner(sorted(self.scenes, key=lambda s: s.name), self.out).result("joint", seed)
        path = self.out / f"{'+'.join(self.names)}-{strategy}-{seed}.json"
        if not path.exists():
            path.write_text(json.dumps(asdict(self._run(strategy, seed))))
        return Outcome(**json.loads(path.read_text()))

    def _run(self, strategy: str, seed: int) -> Outcome:
        outcome = Outcome([], [], 0, 0, [], 0.0)
        known = Knowledge(load_encoder(), load_descriptor(), strategy, SHORT_SIDE)
        for number in range(len(self.scenes)):
            began = time.perf_counter()
            if strategy == "isolation":
                known = self._alone_beside(known, number, seed)
            elif number == 0 and strategy != "joint":
                known = self._first(strategy, number, seed)
            else:
                known = self._next(known, number, stage_options(seed)).knowledge
            outcome.seconds.append(time.perf_counter() - began)
            memory = known.memories[-1]
            outcome.frames_kept.append(len(memory.images) if memory else 0)
            skipped = strategy == "joint" and number < len(self.scenes) - 1
            outcome.correct.append({} if skipped else self._judge(known, number, outcome))
            shown = {name: f"{100 * np.mean(v):.1f}" for name, v in outcome.correct[-1].items()}
            print(f"{strategy} seed {seed}: {shown} {outcome.seconds[-1]:.0f} s", flush=True)
        outcome.memory_bytes = sum(m.bytes for m in known.memories if m is not None)
        outcome.head_bytes = sum(head_bytes(head) for head in known.heads)
        return outcome

    def _judge(self, known: Knowledge, number: int, outcome: Outcome) -> dict[str, list[bool]]:
        """Evaluates all scenes so far, thresholds as `learn_scene` fits them."""
        for i in range(number + 1):
            if known.scenes[i].inlier_threshold == 0.0 or i == number:
                alone = replace(known.scenes[i])
                known.scenes[i] = with_fit(alone, *fit_threshold(known, self.held_out[i], i))
        results = evaluate(Localizer(known), {s.name: s for s in self.scenes[: number + 1]})
        outcome.wrong_scene = 100 * float(np.mean([r.wrong_scene for r in results]))
        return {name: flags.tolist() for name, flags in correct(results).items()}

    def _next(self, known: Knowledge, number: int, options: StageOptions) -> Stage:
        rule = RULES[known.strategy]
        if rule.data == "all":
            # Joint training starts over with everything; the stages before only note the scene.
            last = number == len(self.scenes) - 1
            steps = options.fit.iterations * len(self.scenes) if last else 0
            fill = options.fill if last else replace(options.fill, passes=1)
            options = replace(options, fit=replace(options.fit, iterations=steps), fill=fill)
        if known.strategy in PAPER_BACKBONE:
            head = replace(options.head, condition="descriptor", centres="fixed")
            options = replace(options, head=head, fixed_centres_m=self._centres(known, options))
        earlier = self.lessons[:number]
        for event in learn(known, self.lessons[number], options, None, earlier):
            if isinstance(event, Stage):
                return event
        raise AssertionError("learn() ends with a Stage")

    def _centres(
        self, known: Knowledge, options: StageOptions
    ) -> tuple[tuple[float, float, float], ...]:
        """All centres in advance, as the paper has them: k-means in the cells of all scenes."""
        from scipy.cluster.vq import kmeans2

        atlas, found = known.fork().atlas, []
        atlas.cells.clear()
        for lesson in self.lessons:
            poses = [f.base_from_camera for f in lesson.train if f.base_from_camera is not None]
            positions = np.stack([pose.translation_m for pose in poses])
            shift = atlas.place(positions).atlas_from_base
            count = options.head.centres_per_scene
            means, _ = kmeans2(shift.apply(positions), count, minit="++", rng=options.seed)
            found += [tuple(float(value) for value in mean) for mean in means]
        return tuple(found)

    def _first(self, strategy: str, number: int, seed: int) -> Knowledge:
        """A scene learned by a fresh network, shared by all strategies that start the same way."""
        scene = self.lessons[number]
        # With centres known in advance the whole sequence matters.
        context = "+".join(self.names) if strategy in PAPER_BACKBONE else ""
        key = (context, scene.name, seed, len(scene.train))
        if key not in _first_stages:
            blank = Knowledge(load_encoder(), load_descriptor(), strategy, SHORT_SIDE)
            _first_stages[key] = self._next(blank, number, stage_options(seed)).knowledge
        known = _first_stages[key].fork()
        known.strategy = strategy
        refined = known.scenes[0].refined_camera

        def rows() -> FeatureBuffer:
            buffer = FeatureBuffer(0, known.scenes[0].cell.atlas_from_base)
            return plain_rows(buffer, scene.train, known)

        frames = Candidates(scene.train, known.heads[0], rows, seed)
        capacity = stage_options(seed).capacity(scene.train, SHORT_SIDE)
        known.memories = [keep(known, scene.train, frames, capacity, refined)]
        known.notes = [{}]
        return known

    def _alone_beside(self, known: Knowledge, number: int, seed: int) -> Knowledge:
        """Adds a scene with a head of its own: learned alone, then moved to its cell."""
        alone = self._first("isolation", number, seed)
        after = known.fork()
        poses = [f.base_from_camera for f in self.lessons[number].train]
        positions = np.stack([pose.translation_m for pose in poses if pose is not None])
        old, cell = alone.scenes[0].cell, after.atlas.place(positions)
        head = copy.deepcopy(alone.heads[0])
        # Points are centre plus offset: moving the centres moves the scene, exactly.
        head.centres += torch.from_numpy(np.subtract(cell.centre_m, old.centre_m)).float()
        after.heads.append(head)
        after.scenes.append(replace(alone.scenes[0], cell=cell))
        after.memories.append(None)
        after.notes.append({})
        return after


def comparison(
    runner: Runner, strategies: Sequence[str], seeds: Sequence[int], once: Sequence[str]
) -> str:
    """Runs what is missing and compares.

    Args:
        runner: of the sequence.
        strategies: the first is compared with the others.
        seeds: each strategy is run with each.
        once: strategies so far from the others that the first seed shows it.

    Returns:
        Markdown tables: accuracy by strategy, and paired differences with bounds.
    """
    outcomes = {s: [] for s in strategies}
    for seed in seeds:
        for strategy in strategies:
            if strategy not in once or seed == seeds[0]:
                outcomes[strategy].append(runner.result(strategy, seed))
    names = runner.names

    def final(strategy: str) -> list[np.ndarray]:
        return [np.array([o.correct[-1][n] for o in outcomes[strategy]], float) for n in names]

    def learned(strategy: str, i: int) -> np.ndarray:
        """Scene i right after its own stage (of `joint`: at the end)."""
        runs = outcomes[strategy]
        return np.array([(o.correct[i] or o.correct[-1])[names[i]] for o in runs], float)

    rows = []
    for strategy in strategies:
        ends = final(strategy)
        drops = [
            100 * float((learned(strategy, i).mean(1) - ends[i].mean(1)).max())
            for i in range(len(names) - 1)
        ]
        runs = outcomes[strategy]
        rows.append(
            [
                strategy if len(runs) == len(seeds) else f"{strategy} (seed {seeds[0]})",
                *[
                    f"{100 * learned(strategy, i).mean():.1f} -> {100 * ends[i].mean():.1f}"
                    for i in range(len(names))
                ],
                100 * float(np.mean([e.mean() for e in ends])),
                max(drops),
                float(np.mean([o.wrong_scene for o in runs])),
                runs[0].head_bytes / 1e6,
                runs[0].memory_bytes / 1e6,
                float(np.mean([sum(o.seconds) for o in runs])),
            ]
        )
    columns = [
        "strategy",
        *[f"{name}: learned -> end" for name in names],
        "mean",
        "worst drop",
        "wrong scene %",
        "heads MB",
        "memory MB",
        "s",
    ]
    text = f"\n{' -> '.join(names)}, seeds {list(seeds)}\n\n"
    text += tabulate(rows, columns, "github", floatfmt=".1f") + "\n\n"
    ours, pairs = final(strategies[0]), []
    for other in strategies[1:]:
        theirs = final(other)
        d = paired_difference([a[: len(b)] for a, b in zip(ours, theirs, strict=True)], theirs)
        pairs.append([f"evercal - {other}", 100 * d.mean, 100 * d.low, 100 * d.high])
    for i, name in enumerate(names):
        alone = np.array([o.correct[i][name] for o in outcomes["isolation"]], float)
        d = paired_difference([ours[i]], [alone])
        pairs.append(
            [f"{name}: evercal at the end - alone", *(100 * v for v in (d.mean, d.low, d.high))]
        )
        d = paired_difference([ours[i]], [learned("evercal", i)])
        pairs.append(
            [
                f"{name}: evercal at the end - when learned",
                *(100 * v for v in (d.mean, d.low, d.high)),
            ]
        )
    header = ["difference in points", "mean", "95 % low", "95 % high"]
    return text + tabulate(pairs, header, "github", floatfmt=".1f") + "\n"
