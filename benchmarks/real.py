"""Accuracy and time of one real scene alone with preset `fast`; resumable."""

import json
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
from tabulate import tabulate

from evercal.continual.learn_scene import LearnOptions, learn_scene
from evercal.continual.presets import preset
from evercal.evaluation.metrics import scores
from evercal.evaluation.protocol import evaluate
from evercal.localization.localizer import Localizer
from evercal.recordings import load_recording

REAL = ("redkitchen", "fr1_rpy")
COLUMNS = (
    "frames",
    "accuracy_5cm_5deg",
    "median_translation_cm",
    "median_rotation_deg",
    "near_training_frame",
    "unknown",
    "seconds",
    "ms",
)


def run(data: Path, out: Path, seed: int) -> None:
    """Learns each scene alone, a cold store each, and prints the table."""
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for name in REAL:
        scene = load_recording(data / name)
        store, record = out / f"fast-{name}-{seed}", out / f"fast-{name}-{seed}.json"
        if not record.exists():
            began = time.perf_counter()
            report = learn_scene(store, scene, LearnOptions(stage=preset("fast", seed)))
            seconds = time.perf_counter() - began
            results = evaluate(Localizer.open(store), {name: scene})
            table = asdict(scores(results).scenes[name])
            ms = float(np.mean([r.milliseconds for r in results]))
            kept = report.memory_bytes + report.head_bytes
            record.write_text(json.dumps(table | {"seconds": seconds, "ms": ms, "bytes": kept}))
        found = json.loads(record.read_text())
        rows.append([name, *[found[key] for key in COLUMNS]])
    print("\nOne scene, preset fast\n")
    print(tabulate(rows, ["scene", *COLUMNS], "github", floatfmt=".1f"))
