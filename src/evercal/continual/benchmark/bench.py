"""The benchmark: strategies over a sequence of scenes. Complete runs are kept, others are run.

    OUT/settings.json             options that decide the results; other options are refused
    OUT/environments.json         commit, versions and processor of the runs
    OUT/strategies.json           description of each strategy: method, hyper-parameters, map
    OUT/results.csv, frames.csv   see `benchmark.results`
    OUT/overlays/                 pictures, see `benchmark.overlays`
    OUT/training/RUN/             curve of a training, and its checkpoint until it is complete
    OUT/features/                 encoded views, shared by all runs; may be deleted
    OUT/runs/STRATEGY-SEED/       store of a run in progress, removed when the run is complete
    OUT/runs/first-SCENE-SEED/    the first scene, shared by all networks

An interrupted run goes on where it was, a minute earlier at most. Several processes may work in
one folder: each takes runs that no other has.
"""

from collections.abc import Generator, Sequence
from dataclasses import asdict
from itertools import product
from pathlib import Path

import numpy as np
from filelock import FileLock, Timeout

from evercal.classes import frozen
from evercal.continual.benchmark import results
from evercal.continual.benchmark.results import Table
from evercal.continual.benchmark.strategy_run import (
    NETWORK_LOCALIZE,
    BenchOptions,
    Order,
    run_strategy,
)
from evercal.continual.networks.descriptor import DESCRIBED_ENCODER, DESCRIPTOR_FILE
from evercal.continual.strategies import Strategy
from evercal.errors import InputError
from evercal.features.encoder import ENCODER_FILE
from evercal.localization import acceptance
from evercal.localization.options import LocalizeOptions
from evercal.recordings import Recording
from evercal.storage import sha256_file, write_json
from evercal.storage.settings import lock_settings
from evercal.typing import JsonObject


@frozen
class CompletedStage:
    """A complete stage; joint training has the last one only."""

    strategy: str
    """Name of the strategy."""
    seed: int
    """Seed of the run."""
    results: Table
    """Rows of results.csv."""
    done: int
    """Complete stages, including those of earlier calls."""
    total: int
    """Stages of the whole benchmark."""


def run_bench(
    scenes: Sequence[Recording], options: BenchOptions, out: Path
) -> Generator[CompletedStage, None, None]:
    """Run all runs of two or more scenes that are not complete; yields after every stage.

    `out`, the folder of results, is created if missing.
    """
    total = len(options.seeds) * len(options.strategies) * len(scenes)
    missing = begin_bench(scenes, options, out)
    done = total - len(missing) * len(scenes)
    runs = out / "runs"
    runs.mkdir(exist_ok=True)
    for seed, strategy in missing:
        ordered = in_order(scenes, options.order, seed)
        try:
            claim = FileLock(runs / f"{strategy.name}-{seed}.claim")
            claim.acquire(blocking=False)
        except Timeout:  # another process has this run
            continue
        try:
            stored = results.read(out)  # another process may have added some
            if _is_complete(stored, strategy, seed, len(scenes)):
                continue
            for stage in run_strategy(strategy, ordered, options, seed, out):
                results.append(out, stage)
                yield CompletedStage(
                    strategy=strategy.name,
                    seed=seed,
                    results=stage.results,
                    done=done + stage.stage + 1,
                    total=total,
                )
            done += len(scenes)
        finally:
            claim.release()


def begin_bench(
    scenes: Sequence[Recording], options: BenchOptions, out: Path
) -> list[tuple[int, Strategy]]:
    """Check the options against the folder of results, and return the runs that are missing."""
    if len(scenes) < 2:
        raise InputError(f"{len(scenes)} scene: give two or more to measure forgetting")
    settings = _settings(scenes, options)  # bad options leave no folder behind
    with results.locked(out):
        lock_settings(out / results.SETTINGS, settings)
        _record_strategies(out, options.strategies)
    stored = results.read(out)
    count = len(scenes)
    runs = product(options.seeds, options.strategies)
    return [run for run in runs if not _is_complete(stored, run[1], run[0], count)]


def _is_complete(stored: Table, strategy: Strategy, seed: int, scenes: int) -> bool:
    rows = stored[stored["strategy"] == strategy.name]
    last = (rows["seed"] == seed) & (rows["stage"] == scenes - 1)
    return bool(last.sum() == scenes)


def _record_strategies(out: Path, strategies: Sequence[Strategy]) -> None:
    path = out / results.STRATEGIES
    recorded = results.read_records(path)
    for strategy in strategies:
        now = strategy.description()
        before = recorded.setdefault(strategy.name, now)
        if before != now:
            raise InputError(
                f"{out}: strategy {strategy.name!r} was {before}, now it is {now}; give it another"
                " name or another `out`"
            )
    write_json(path, recorded)


def in_order(scenes: Sequence[Recording], order: Order, seed: int) -> list[Recording]:
    """Return the scenes in order of learning."""
    ordered = list(scenes)
    if order == "reversed":
        ordered.reverse()
    elif order == "balanced":
        # Over N seeds each scene is learned in each place once. Six seeds are all orders of three.
        rounds, places = divmod(seed, len(scenes))
        ordered = ordered[places:] + ordered[:places]
        if rounds % 2:
            ordered.reverse()
    elif order == "shuffled":
        rng = np.random.default_rng([seed, 11])
        ordered = [scenes[i] for i in rng.permutation(len(scenes))]
    return ordered


def _settings(scenes: Sequence[Recording], options: BenchOptions) -> JsonObject:
    networks = (ENCODER_FILE, DESCRIBED_ENCODER, DESCRIPTOR_FILE)
    return {
        **asdict(options.stage(0)),
        "networks": [sha256_file(file)[:12] for file in networks],
        "localize": asdict(LocalizeOptions()),
        "localize_networks": asdict(NETWORK_LOCALIZE),
        "acceptance": {
            name: value for name, value in vars(acceptance).items() if name.isupper()
        },
        "order": options.order,
        "short_side": options.short_side,
        "scenes": [[scene.name, len(scene.train), len(scene.test)] for scene in scenes],
        **options.settings,
    }
