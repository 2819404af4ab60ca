"""The gate: accuracy, speed and size against a committed baseline.

Times are ratios to a reference kernel timed in the same run, so that they compare between machines
of one kind. Accuracy is on the test frames of one packaged room, learned with the preset `bench`.
"""

import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from evercal.continual.learning.learn_scene import NetworkLearnOptions, learn_networks
from evercal.continual.localizer import open_networks
from evercal.continual.networks.descriptor import encode, load_descriptor
from evercal.evaluation import evaluate, scores
from evercal.evaluation.metrics import FINEST, correct
from evercal.evaluation.tables import table
from evercal.features.views import ViewOptions, frame_view
from evercal.localization.localizer import Localizer
from evercal.map import Map
from evercal.mapping.selection import SarsOptions, select_sars
from evercal.recordings.samples import sample_rooms

BASELINE = Path(__file__).parent / "baseline.json"


@dataclass(frozen=True)
class Metric:
    """One line of the contract."""

    unit: str
    """Unit of the number."""
    better: Literal["higher", "lower"]
    """Direction of improvement."""
    tolerance: float
    """Allowed loss: points if the unit is `%`, otherwise a share of the baseline."""

    def holds(self, baseline: float, now: float) -> bool:
        """Check that `now` is within the tolerance."""
        slack = self.tolerance if self.unit == "%" else self.tolerance * baseline
        return now >= baseline - slack if self.better == "higher" else now <= baseline + slack


CONTRACT: dict[str, Metric] = {
    "accuracy, 1 cm 1 deg": Metric("%", "higher", 3.0),
    "accuracy, 5 mm 0.5 deg": Metric("%", "higher", 6.0),
    "accuracy of the network alone, 5 cm 5 deg": Metric("%", "higher", 16.0),
    "memory of a frame": Metric("kB", "lower", 0.05),
    "head": Metric("kB", "lower", 0.02),
    "learning a map": Metric("kernels", "lower", 0.5),
    "learning a network": Metric("kernels", "lower", 0.5),
    "encoding an image": Metric("kernels", "lower", 0.5),
    "localizing an image": Metric("kernels", "lower", 0.5),
    "SARS, 4,000 poses": Metric("kernels", "lower", 0.5),
}


def measure() -> dict[str, float]:
    """Measure all numbers of the contract, in about a minute on two cores."""
    room = sample_rooms()[0].scene
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        report = Map.open(Path(folder) / "store").learn(room)
        learning = time.perf_counter() - began
        localizer = Localizer.open(Path(folder) / "store")
        options = NetworkLearnOptions("evercal_network", preset="bench")
        began = time.perf_counter()
        trained = learn_networks(Path(folder) / "network", room, options)
        training = time.perf_counter() - began
        network = scores(evaluate(open_networks(Path(folder) / "network"), {room.name: room}))
    kernel = _seconds(_reference)
    results = evaluate(localizer, {room.name: room})
    (finest,) = correct(results, FINEST).values()
    encoder, descriptor = localizer.contents.encoder, load_descriptor()
    view = frame_view(room.test[0], encoder.stride, ViewOptions())
    image = room.test[0].read_image()
    encoding = _seconds(lambda: encode([view], encoder, descriptor))
    localizing = _seconds(lambda: localizer.localize(image))
    rng = np.random.default_rng(0)
    positions, rotations = rng.normal(size=(4000, 3)), rng.normal(size=(4000, 4))
    options_sars = SarsOptions(radius=0.0)
    selecting = _seconds(lambda: select_sars(positions, rotations, 400, options_sars), 3)
    return {
        "accuracy, 1 cm 1 deg": scores(results).mean_accuracy_1cm_1deg,
        "accuracy, 5 mm 0.5 deg": 100 * float(np.mean(finest)),
        "accuracy of the network alone, 5 cm 5 deg": network.mean_accuracy_5cm_5deg,
        "memory of a frame": report.memory_bytes / report.frames_kept / 1e3,
        "head": trained.head_bytes / 1e3,
        "learning a map": learning / kernel,
        "learning a network": training / kernel,
        "encoding an image": encoding / kernel,
        "localizing an image": localizing / kernel,
        "SARS, 4,000 poses": selecting / kernel,
    }


def run(update: bool = False) -> int:
    """Check accuracy, speed and size against the committed baseline.

    Args:
        update: Write the measured numbers as the new baseline.
    """
    now = measure()
    if update or not BASELINE.exists():
        rounded = {name: round(value, 3) for name, value in now.items()}
        BASELINE.write_text(json.dumps(rounded, indent=2) + "\n")
    baseline = json.loads(BASELINE.read_text())
    rows, broken = judge(baseline, now)
    print(table(["metric", "unit", "better", "baseline", "now", "holds"], rows, "terminal"))
    if broken:
        print(f"worse than allowed: {', '.join(broken)}")
    return 1 if broken else 0


def judge(baseline: dict[str, float], now: dict[str, float]) -> tuple[list[list[str]], list[str]]:
    """Return rows of the table, and the names of metrics beyond their tolerance or not in it."""
    rows, broken = [], []
    for name, metric in CONTRACT.items():
        before = baseline.get(name)
        holds = before is not None and metric.holds(before, now[name])
        if not holds:
            broken.append(name)
        was, verdict = "-" if before is None else f"{before:.1f}", "yes" if holds else "NO"
        rows.append([name, metric.unit, metric.better, was, f"{now[name]:.1f}", verdict])
    return rows, broken


def _reference() -> None:
    """Run the unit of time: twenty float32 products of 512 x 512."""
    a = torch.ones(512, 512)
    for _ in range(20):
        a = (a @ a).clamp(max=1.0)


def _seconds(work: Callable[[], object], repeat: int = 20) -> float:
    work()
    times = []
    for _ in range(repeat):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return float(np.median(times))
