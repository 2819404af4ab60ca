"""The first steps of preset `paper`: memory, loss and seconds on this machine."""

import json
import time
from dataclasses import replace
from pathlib import Path

from benchmarks.peak_memory import peak_gb
from evercal.continual.benchmark.suites import load_suite
from evercal.continual.learning.learn import learn
from evercal.continual.learning.presets import (
    PAPER_SIM_STEPS,
    on_paper_backbone,
    preset,
    short_side,
)
from evercal.continual.learning.stage import Encoding
from evercal.continual.networks.atlas import combined_centres
from evercal.continual.networks.descriptor import load_descriptor
from evercal.continual.networks.trainer import Progress
from evercal.continual.scenes import LearnedScenes
from evercal.continual.strategies import strategy_named
from evercal.features.device import device_of
from evercal.features.encoder import load_encoder
from evercal.recordings import stated_poses
from evercal.recordings.held_out import split_held_out

REPORT_EVERY = 10


def run(
    suite: str = "sim-mini",
    data: Path | None = None,
    steps: int = 200,
    device: str = "auto",
    out: Path = Path("runs/paper.jsonl"),
) -> None:
    """Run and time the first steps of preset `paper` on the first scene of a suite.

    Args:
        suite: Suite; all of its scenes give the centres.
        data: Folder of its recordings.
        steps: Steps to run, of 5,000.
        device: auto, cpu or cuda.
        out: File for loss, seconds and memory every ten steps, JSON lines.
    """
    scenes = load_suite(suite, data)
    trains = [split_held_out(scene.train).train for scene in scenes]
    stage = on_paper_backbone(preset("paper"))
    positions = [stated_poses(train).translation_m for train in trains]
    centres = combined_centres(positions, stage.head.centres_per_scene, 0)
    fit = replace(stage.fit, iterations=PAPER_SIM_STEPS)
    stage = replace(stage, fit=fit, grid_scenes=len(scenes), fixed_centres_m=centres)
    maps = LearnedScenes(load_encoder(), load_descriptor(), "sars_spdd", short_side("paper"))
    maps.to(device_of(device))
    out.parent.mkdir(parents=True, exist_ok=True)
    began, cpu = time.perf_counter(), time.process_time()
    first = replace(scenes[0], train=trains[0])
    for event in learn(maps, strategy_named("sars_spdd"), first, stage):
        if isinstance(event, Encoding):
            began, cpu = time.perf_counter(), time.process_time()
        if not isinstance(event, Progress) or event.step % REPORT_EVERY:
            continue
        row = {
            "step": event.step,
            "loss_px": round(event.loss, 3),
            "within_5_px": round(100 * event.inlier_share, 2),
            "seconds_a_step": round((time.perf_counter() - began) / event.step, 2),
            "processor_seconds_a_step": round((time.process_time() - cpu) / event.step, 2),
            "peak_gb": round(peak_gb(maps.device), 2),
        }
        print(json.dumps(row), flush=True)
        with open(out, "a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
        if event.step >= steps:
            return
