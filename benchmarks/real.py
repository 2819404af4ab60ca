"""Accuracy on real scenes: one scene, two in a row, four in a row; resumable."""

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from tabulate import tabulate

from benchmarks.sequence import Runner, comparison
from evercal.continual.presets import preset
from evercal.datasets import load_scene
from evercal.datasets.frame import Scene
from evercal.evaluation.metrics import scores
from evercal.evaluation.protocol import evaluate
from evercal.localization.localizer import Localizer
from evercal.localization.teach import LearnOptions, learn_scene
from evercal.simulation.box_room import box_room_scene

REAL = ("redkitchen", "fr1_rpy")
BOX_SEEDS = (51, 52)
TWO_STRATEGIES = ("evercal", "isolation", "joint", "finetune", "sars_spdd")
FOUR_STRATEGIES = ("evercal", "isolation", "joint", "finetune")


def run(data: Path, out: Path, seeds: Sequence[int], tables: Sequence[str]) -> None:
    """Makes and prints the tables asked for."""
    out.mkdir(parents=True, exist_ok=True)
    real = {name: load_scene(data / name) for name in REAL}
    if "fast" in tables:
        fast_table(real, out, seeds[0])
    if "two" in tables:
        orders = [[real[name] for name in order] for order in (REAL, REAL[::-1])]
        runners = [Runner(order, out) for order in orders]
        for runner in runners:
            print(comparison(runner, TWO_STRATEGIES, seeds, ("sars_spdd",)))
    if "four" in tables:
        rooms = [box_room_scene(seed, 200, 60) for seed in BOX_SEEDS]
        runner = Runner([real[REAL[0]], rooms[0], real[REAL[1]], rooms[1]], out)
        print(comparison(runner, FOUR_STRATEGIES, seeds, ("finetune",)))


def fast_table(real: Mapping[str, Scene], out: Path, seed: int) -> None:
    """One scene each, preset `fast`, a cold store each; the time is that of the same run."""
    rows = []
    for name, scene in real.items():
        store, record = out / f"fast-{name}-{seed}", out / f"fast-{name}-{seed}.json"
        if not record.exists():
            began = time.perf_counter()
            report = learn_scene(store, scene, LearnOptions(stage=preset("fast", seed)))
            seconds = time.perf_counter() - began
            results = evaluate(Localizer.open(store), {name: scene})
            table = asdict(scores(results).scenes[name])
            ms = float(np.mean([r.milliseconds for r in results]))
            record.write_text(
                json.dumps(table | {"seconds": seconds, "ms": ms, "bytes": report.head_bytes})
            )
        found = json.loads(record.read_text())
        rows.append([name, *[found[key] for key in FAST_COLUMNS]])
    print("\nOne scene, preset fast\n")
    print(tabulate(rows, ["scene", *FAST_COLUMNS], "github", floatfmt=".1f"))


FAST_COLUMNS = (
    "frames",
    "accuracy_5cm_5deg",
    "median_translation_cm",
    "median_rotation_deg",
    "near_training_frame",
    "unknown",
    "seconds",
    "ms",
)
