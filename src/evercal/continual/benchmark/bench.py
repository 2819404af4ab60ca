"""The benchmark: strategies over a sequence of scenes, what is missing is run, what is done kept.

    OUT/settings.json             what decides the results; a folder of other settings is refused
    OUT/strategies.json           what each strategy is: method, hyper-parameters, map
    OUT/results.jsonl             see `benchmark.results`
    OUT/views/                    see `benchmark.scene_views`; of each strategy's first run
    OUT/features/                 encoded views, shared by all runs; may be deleted
    OUT/runs/STRATEGY-SEED/       a store under way, gone when its sequence is done
    OUT/runs/STRATEGY-SEED.network.json    thresholds of its network where a map answers beside it
    OUT/runs/first-SCENE-SEED/    the first scene, which all strategies learn alike

A run that is killed goes on from the checkpoint inside its stage, as `evercal learn` does.
"""

import json
from collections import Counter
from collections.abc import Callable, Generator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from evercal.continual.benchmark import results
from evercal.continual.benchmark.results import SceneResult
from evercal.continual.benchmark.strategy_run import RunOptions, run_strategy
from evercal.continual.learn_scene import OnEvent
from evercal.continual.networks.descriptor import DESCRIPTOR_FILE
from evercal.continual.stage import StageOptions
from evercal.continual.strategies import Strategy
from evercal.errors import InputError
from evercal.features.encoder import ENCODER_FILE
from evercal.recordings import Recording
from evercal.storage import lock_settings, sha256_file, write_json

Order = Literal["given", "reversed", "shuffled"]


@dataclass(frozen=True)
class BenchOptions:
    """What is compared."""

    stage: Callable[[int], StageOptions]
    """How a scene is learned, given the seed. With `centres: fixed` and none given, those of all
    scenes are there from the start, in the paper's combined grid."""
    strategies: tuple[Strategy, ...]
    """What is compared, each under a name of its own."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Runs of each."""
    order: Order = "given"
    """In which the scenes come; `shuffled` differs from seed to seed."""
    short_side: int = 240
    """Working size of images, pixels."""
    settings: dict[str, object] = field(default_factory=dict)
    """What else decides the results, for settings.json."""
    device: str = "auto"
    """What the networks run on, see `features.device.device_of`."""
    features: Path | None = None
    """Where encoded views are kept; in the folder of results when None."""


@dataclass(frozen=True)
class Step:
    """A stage that is done."""

    strategy: str
    """Name of the strategy."""
    seed: int
    """Which run."""
    results: tuple[SceneResult, ...]
    """One per scene learned so far; none for the stages before the last of joint training."""
    done: int
    """Stages done so far, those of earlier calls included."""
    total: int
    """Stages of the whole benchmark."""


def run_bench(
    scenes: Sequence[Recording], options: BenchOptions, out: Path, on_event: OnEvent | None = None
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
    found = {(o.strategy, o.seed, o.stage, o.scene) for o in results.read(out)}
    done = total - len(missing) * len(scenes)
    features = options.features or out / "features"
    for seed, strategy in missing:
        ordered = in_order(scenes, options.order, seed)
        how = RunOptions(options.stage(seed), options.short_side, features, out, options.device)
        for stage, these in run_strategy(strategy, ordered, how, on_event):
            # A kill may have left a part of the lines of a stage.
            new = [o for o in these if (o.strategy, seed, stage, o.scene) not in found]
            results.append(out, new)
            yield Step(strategy.name, seed, these, done + stage + 1, total)
        done += len(scenes)


def begin_bench(
    scenes: Sequence[Recording], options: BenchOptions, out: Path
) -> list[tuple[int, Strategy]]:
    """Checks what is asked against the folder of results.

    Returns:
        (seed, strategy) of the runs whose last stage is not there yet, in order.

    Raises:
        InputError: see `run_bench`.
    """
    if len(scenes) < 2:
        raise InputError(f"{len(scenes)} scene: forgetting takes two or more; give more scenes")
    lock_settings(out / results.SETTINGS, _settings(scenes, options))
    _note_strategies(out, options.strategies)
    found = results.read(out)
    runs = [(seed, strategy) for seed in options.seeds for strategy in options.strategies]
    return [run for run in runs if not _done(run, found, len(scenes))]


def _done(run: tuple[int, Strategy], found: Sequence[SceneResult], scenes: int) -> bool:
    """Whether the last stage of a run has every line, also of what is judged alone beside it."""
    seed, strategy = run
    of = [o for o in found if o.seed == seed and o.strategy.partition(":")[0] == strategy.name]
    last = Counter(o.strategy for o in of if o.stage == scenes - 1)
    return bool(of) and all(last[name] == scenes for name in {o.strategy for o in of})


def _note_strategies(out: Path, strategies: Sequence[Strategy]) -> None:
    """Adds what the strategies are to those of the folder, or refuses a name that means another."""
    noted = results.read_strategies(out)
    for strategy in strategies:
        now = json.loads(json.dumps(strategy.description()))
        before = noted.setdefault(strategy.name, now)
        if before != now:
            raise InputError(
                f"{out}: strategy {strategy.name!r} was {before}, now it is {now}; give it another"
                " name or another --out"
            )
    write_json(out / results.STRATEGIES, noted)


def in_order(scenes: Sequence[Recording], order: Order, seed: int) -> list[Recording]:
    """The scenes as a run meets them."""
    if order == "reversed":
        return list(scenes)[::-1]
    if order == "shuffled":
        return [scenes[i] for i in np.random.default_rng([seed, 11]).permutation(len(scenes))]
    return list(scenes)


def _settings(scenes: Sequence[Recording], options: BenchOptions) -> dict[str, object]:
    stage = options.stage(0)
    return {
        **asdict(replace(stage, seed=0, encode=replace(stage.encode, seed=0))),
        "networks": [sha256_file(file)[:12] for file in (ENCODER_FILE, DESCRIPTOR_FILE)],
        "order": options.order,
        "short_side": options.short_side,
        "scenes": [[scene.name, len(scene.train), len(scene.test)] for scene in scenes],
        **options.settings,
    }
