"""`evercal bench`."""

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from evercal.cli.bench_report import show_report
from evercal.cli.device import Device
from evercal.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from evercal.continual.benchmark.bench import BenchOptions, Step
    from evercal.continual.stage import StageOptions
    from evercal.continual.strategies import Strategy
    from evercal.recordings import Recording


LEAST_BATCH = 64
"""Rows of a step below which nothing is learned."""


@dataclass(frozen=True)
class Bench:
    """Compare strategies on a sequence of scenes; what is done is kept, what is missing is run.

    Under torchrun, several processes share every training.
    """

    suite: Annotated[Positional[str], arg(metavar="SUITE")]
    """One of sim-mini (in the package), sim, sim-7, sim-12, real2, i7s, i12s, custom, regions."""
    recordings: Annotated[
        Positional[tuple[Path, ...]], arg(metavar="DIR...", help_behavior_hint="")
    ] = ()
    """Recording folders of the suite custom, in order of learning; a single one for regions."""
    strategies: Annotated[str | None, arg(metavar="A,B", help_behavior_hint="")] = None
    """Strategies with commas between; the others are compared with the first. When left out, those
    of --rows alone, or evercal,joint,finetune,er,sars_spdd."""
    rows: Annotated[str | None, arg(metavar="NAME|FILE.json", help_behavior_hint="")] = None
    """More strategies, made from others: table4, spdd-sweep, with-map, or a file of one's own (see
    `evercal.continual.benchmark.rows`)."""
    seeds: Annotated[str, arg(metavar="0,1")] = "0,1,2"
    """Seeds with commas between; every strategy is run once with each."""
    order: Literal["given", "reversed", "shuffled"] = "given"
    """Order in which the scenes are learned."""
    scenes: Annotated[str, arg(metavar="A,B", help_behavior_hint="")] = ""
    """Scenes of the suite to use, with commas between; all when left out."""
    data: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Folder of the suite's recordings, with a folder for each scene."""
    poses: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Structure-from-motion poses for i7s and i12s (Brachmann et al., ICCV 2021); the original ones
    when left out."""
    parts: int = 4
    """How many stages the suite regions makes of one scene."""
    preset: Literal["fast", "demo", "bench", "paper"] = "bench"
    """How much a network is trained in a stage."""
    backbone: Literal["evercal", "paper"] = "evercal"
    """The network: ours, or the paper's with all centres known in advance and trained its way."""
    offsets: Literal["per_centre", "shared"] = "per_centre"
    """An offset and scale for each centre (the paper), or one for all (GLACE)."""
    steps: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Optimiser steps of a stage; the preset's number when left out."""
    batch: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Rows of a new scene in a step, and replayed ones in the preset's proportion; the preset's
    number when left out."""
    memory: Annotated[str, arg(metavar="SHARE|BYTES")] = "10%"
    """How many keyframes are kept of a scene: a share of its frames (10%) or bytes (5MB)."""
    held_out: bool = False
    """Judge on a fifth of the training frames instead of the test frames, to choose settings."""
    device: Device = "auto"
    plugin: Annotated[Path | None, arg(metavar="FILE.py", help_behavior_hint="")] = None
    """File with strategies of one's own (see examples/my_strategy.py)."""
    ray: Annotated[str | None, arg(metavar="ADDRESS", help_behavior_hint="")] = None
    """Ray cluster to run on, `local` for this machine; one run after the other when left out."""
    out: Annotated[Path, arg(metavar="DIR")] = Path("evercal-bench")
    """Folder of results; the same command continues there."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        """Runs what is missing and prints the tables."""
        seeds = _numbers(self.seeds)
        from evercal.continual.benchmark.bench import BenchOptions
        from evercal.continual.networks.distributed import join_processes, rank, wait_for_all
        from evercal.continual.plugin import load_plugin
        from evercal.continual.presets import short_side

        if self.plugin is not None:
            load_plugin(self.plugin)
        # Workers of a cluster have GPUs of their own.
        device = self.device if self.ray else str(join_processes(self.device))
        out = self.out if rank() == 0 else _mirror(self.out)
        wait_for_all()
        options = BenchOptions(
            self._stage,
            self._strategies(),
            seeds,
            self.order,
            short_side(self.preset),
            settings={
                "suite": self.suite,
                "poses": "sfm" if self.poses else "original",
                "judged": "held-out training frames" if self.held_out else "test frames",
            },
            device=device,
            features=self.out.absolute() / "features",
        )
        said = sys.stderr if self.json else sys.stdout
        for step in self._steps(options, out):
            if rank():
                continue
            found = ", ".join(f"{o.scene} {100 * o.correct().mean():.1f}" for o in step.results)
            seconds = f" ({step.results[0].seconds:.0f} s)" if step.results else ""
            line = f"[{step.done}/{step.total}] {step.strategy} seed {step.seed}: "
            print(line + (found or "noted") + seconds, file=said, flush=True)
        return 0 if rank() else show_report(self.out, options.strategies[0].name, self.json)

    def _strategies(self) -> "tuple[Strategy, ...]":
        from evercal.continual.benchmark.rows import load_rows
        from evercal.continual.strategies import strategy_named

        names = self.strategies
        if names is None:
            names = "" if self.rows else "evercal,joint,finetune,er,sars_spdd"
        named = [strategy_named(name) for name in _words(names)]
        # Rows may repeat what is named: it is run once. Two of one name are refused later.
        return tuple(dict.fromkeys((*named, *(load_rows(self.rows) if self.rows else ()))))

    def _steps(self, options: "BenchOptions", out: Path) -> "Iterator[Step]":
        from evercal.continual.benchmark.bench import run_bench
        from evercal.continual.benchmark.ray_runs import run_on_ray

        if self.ray is None:
            return run_bench(self._scenes(), options, out)
        return run_on_ray(self._scenes(), options, out, self.ray, self.plugin)

    def _scenes(self) -> "list[Recording]":
        from evercal.continual.benchmark.suites import tuning_split

        scenes = self._recorded()
        return [tuning_split(scene) for scene in scenes] if self.held_out else scenes

    def _recorded(self) -> "list[Recording]":
        from evercal.continual.benchmark.suites import load_suite, regions
        from evercal.recordings import load_recording

        if (self.suite in ("custom", "regions")) != bool(self.recordings):
            raise InputError(
                f"suite {self.suite}: scene folders are for the suites custom and regions, and "
                "these need them"
            )
        if self.suite == "regions":
            scenes = [load_recording(path) for path in self.recordings]
            if len(scenes) > 1:
                raise InputError(f"suite regions: one scene, got {len(scenes)}")
            return regions(scenes[0], self.parts)
        if self.suite == "custom":
            return [load_recording(path) for path in self.recordings]
        return load_suite(self.suite, self.data, _words(self.scenes), self.poses)

    def _stage(self, seed: int) -> "StageOptions":
        from evercal.cli.learn import parse_memory
        from evercal.continual.presets import PAPER_SIM_STEPS, on_paper_backbone, preset
        from evercal.mapping.memory_budget import with_memory

        parse_memory(self.memory)
        stage = with_memory(preset(self.preset, seed), self.memory)
        if "paper" in (self.backbone, self.preset):
            stage = on_paper_backbone(stage)
        preset_steps = stage.fit.iterations
        if self.preset == "paper" and self.suite.startswith("sim"):
            preset_steps = PAPER_SIM_STEPS
        steps = preset_steps if self.steps is None else self.steps
        if steps < 1:
            raise InputError(f"--steps {steps}: give a number >= 1")
        fit = dataclasses.replace(stage.fit, iterations=steps)
        if self.batch is not None:
            if self.batch < LEAST_BATCH:
                raise InputError(f"--batch {self.batch}: give a number >= {LEAST_BATCH}")
            replayed = fit.replay_batch * self.batch // fit.batch
            fit = dataclasses.replace(fit, batch=self.batch, replay_batch=replayed)
        head = dataclasses.replace(stage.head, offsets=self.offsets)
        return dataclasses.replace(stage, head=head, fit=fit)


def _mirror(out: Path) -> Path:
    """A folder for a process that trains along with the first, and whose results nobody reads.

    It begins with what is done already, so that all run the same.
    """
    import atexit
    import shutil
    import tempfile

    from evercal.continual.benchmark.results import RESULTS, SETTINGS

    folder = Path(tempfile.mkdtemp(prefix="evercal-bench-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    for name in (SETTINGS, RESULTS):
        if (out / name).exists():
            shutil.copy(out / name, folder / name)
    if (out / "runs").exists():
        shutil.copytree(out / "runs", folder / "runs")
    return folder


def _words(text: str) -> tuple[str, ...]:
    return tuple(word.strip() for word in text.split(",") if word.strip())


def _numbers(text: str) -> tuple[int, ...]:
    words = _words(text)
    if not words or not all(word.isdecimal() for word in words):
        raise InputError(f"--seeds {text}: give numbers >= 0 with commas between, such as 0,1,2")
    return tuple(int(word) for word in words)
