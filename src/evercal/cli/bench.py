"""`evercal bench`."""

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from evercal.cli.bench_report import show_report
from evercal.cli.options import Device
from evercal.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from evercal.continual.benchmark.bench import BenchOptions, Step
    from evercal.continual.learning.stage import StageOptions
    from evercal.continual.strategies import Strategy
    from evercal.recordings import Recording


LEAST_BATCH = 64
"""Smallest number of rows in a step that learns anything."""


@dataclass(frozen=True)
class Bench:
    """Compare strategies on a sequence of scenes; the same command resumes.

    Under torchrun, several processes share every training.

    Example: evercal bench sim-mini --strategies evercal,finetune,er --seeds 0
    """

    suite: Annotated[Positional[str], arg(metavar="SUITE")]
    """One of sim-mini (packaged), sim, sim-7, sim-12, sim-tune, sim-unseen, sim-repeat,
    real2, i7s, i12s, custom, regions."""
    recordings: Annotated[
        Positional[tuple[Path, ...]], arg(metavar="[DIR...]", help_behavior_hint="")
    ] = ()
    """Recordings of the suite custom, in order of learning; one recording for regions."""
    strategies: Annotated[str | None, arg(metavar="A,B", help_behavior_hint="")] = None
    """Comma-separated strategies; the others are compared with the first. Defaults to those of
    --rows, or to evercal,joint,finetune,er,sars_spdd."""
    rows: Annotated[str | None, arg(metavar="NAME|FILE.json", help_behavior_hint="")] = None
    """Strategies derived from others: table4, spdd-sweep, with-map, or your own file (see
    `evercal.continual.benchmark.rows`)."""
    seeds: Annotated[str, arg(metavar="0,1")] = "0,1,2"
    """Comma-separated seeds; every strategy runs once with each."""
    order: Literal["given", "reversed", "shuffled", "balanced"] = "given"
    """Order in which the scenes are learned. shuffled draws one for each seed. balanced turns the
    given order by one place for each seed, and reverses it in every second round."""
    scenes: Annotated[str, arg(metavar="A,B", help_behavior_hint="")] = ""
    """Comma-separated scenes of the suite. Defaults to all."""
    data: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Folder of the suite's recordings, with one folder per scene."""
    poses: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Structure-from-motion poses for i7s and i12s (Brachmann et al., ICCV 2021). Defaults to the
    original poses."""
    parts: int = 4
    """Stages that the suite regions splits a scene into."""
    preset: Literal["fast", "demo", "bench", "converged", "paper"] = "bench"
    """Training effort per stage."""
    backbone: Literal["evercal", "paper", "paper_head"] = "evercal"
    """Network: ours, or the paper's with all centres given in advance, trained by its optimiser
    and loss (paper) or by ours (paper_head)."""
    offsets: Literal["per_centre", "shared"] = "per_centre"
    """One offset and scale per centre (the paper), or one for all centres (GLACE)."""
    steps: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Optimiser steps of a stage. Defaults to that of the preset."""
    batch: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Rows of the new scene in a step; replayed rows keep the preset's proportion. Defaults to that
    of the preset."""
    memory: Annotated[str, arg(metavar="SHARE|BYTES")] = "10%"
    """Keyframes to keep of a scene: a share of its frames (10%) or bytes (5MB)."""
    held_out: bool = False
    """Evaluate on a fifth of the training frames instead of the test frames, to choose settings."""
    device: Device = "auto"
    plugin: Annotated[Path | None, arg(metavar="FILE.py", help_behavior_hint="")] = None
    """Python file of your own strategies (see examples/my_strategy.py)."""
    ray: Annotated[str | None, arg(metavar="ADDRESS", help_behavior_hint="")] = None
    """Ray cluster to run on, or `local` for this machine. Without it, runs are sequential."""
    out: Annotated[Path, arg(metavar="DIR")] = Path("evercal-bench")
    """Folder of results. The same command resumes there."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        """Run what is missing and print the tables."""
        seeds = _numbers(self.seeds)
        from evercal.continual.benchmark.bench import BenchOptions
        from evercal.continual.learning.presets import short_side
        from evercal.continual.networks.distributed import join_processes, rank, wait_for_all
        from evercal.continual.plugin import load_plugin

        if self.plugin is not None:
            load_plugin(self.plugin)
        # Workers of a cluster have GPUs of their own.
        device = self.device if self.ray else str(join_processes(self.device))
        out = _own_folder(self.out)
        wait_for_all()
        strategies = self._strategies()  # refused before recordings are read
        scenes = self._scenes()
        options = BenchOptions(
            self._stage,
            strategies,
            seeds,
            self.order,
            short_side(self.preset, (frame for scene in scenes for frame in scene.train)),
            settings={
                "suite": self.suite,
                "poses": "sfm" if self.poses else "original",
                "judged": "held-out training frames" if self.held_out else "test frames",
            },
            device=device,
            features=self.out.absolute() / "features",
        )
        for step in self._steps(scenes, options, out):
            if rank() == 0:
                print(_progress(step), file=sys.stderr if self.json else sys.stdout, flush=True)
        return 0 if rank() else show_report(self.out, options.strategies[0].name, self.json)

    def _strategies(self) -> "tuple[Strategy, ...]":
        from evercal.continual.benchmark.rows import load_rows
        from evercal.continual.strategies import strategy_named

        names = self.strategies
        if names is None:
            names = "" if self.rows else "evercal,joint,finetune,er,sars_spdd"
        named = [strategy_named(name) for name in _words(names)]
        # Equal strategies run once. Different strategies of one name are refused later.
        return tuple(dict.fromkeys((*named, *(load_rows(self.rows) if self.rows else ()))))

    def _steps(
        self, scenes: "list[Recording]", options: "BenchOptions", out: Path
    ) -> "Iterator[Step]":
        from evercal.continual.benchmark.bench import run_bench
        from evercal.continual.benchmark.ray_runs import run_on_ray

        if self.ray is None:
            return run_bench(scenes, options, out)
        return run_on_ray(scenes, options, out, self.ray, self.plugin)

    def _scenes(self) -> "list[Recording]":
        from evercal.continual.benchmark.suites import tuning_split

        scenes = self._recorded()
        return [tuning_split(scene) for scene in scenes] if self.held_out else scenes

    def _recorded(self) -> "list[Recording]":
        from evercal.continual.benchmark.suites import load_suite, regions
        from evercal.recordings import load_recording

        if (self.suite in ("custom", "regions")) != bool(self.recordings):
            raise InputError(
                f"suite {self.suite}: give scene folders for the suites custom and regions only"
            )
        if self.suite == "regions":
            scenes = [load_recording(path) for path in self.recordings]
            if len(scenes) > 1:
                raise InputError(f"suite regions: got {len(scenes)} scenes; give one")
            return regions(scenes[0], self.parts)
        if self.suite == "custom":
            return [load_recording(path) for path in self.recordings]
        return load_suite(self.suite, self.data, _words(self.scenes), self.poses)

    def _stage(self, seed: int) -> "StageOptions":
        from evercal.continual.learning.presets import BACKBONES, PAPER_SIM_STEPS, preset

        try:
            stage = preset(self.preset, seed).with_memory(self.memory)
        except InputError as error:
            raise InputError(f"--{error}") from None
        stage = BACKBONES["paper" if self.preset == "paper" else self.backbone](stage)
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


def _progress(step: "Step") -> str:
    """Describe a stage: accuracy of each scene, under every name that the strategy is judged by."""
    shares: dict[str, list[str]] = {}
    for result in step.results:
        part = f"{result.scene} {100 * result.accuracy():.1f}"
        shares.setdefault(result.strategy, []).append(part)
    names = [f"{name} seed {step.seed}: {', '.join(parts)}" for name, parts in shares.items()]
    text = "; ".join(names) or f"{step.strategy} seed {step.seed}: no results before the last stage"
    seconds = f" ({step.results[0].seconds:.0f} s)" if step.results else ""
    return f"[{step.done}/{step.total}] {text} % within 5 cm, 5 deg{seconds}"


def _own_folder(out: Path) -> Path:
    """Return the folder in which this process works.

    The first process works in `out`. A process that trains along has a folder whose results are not
    used. It starts with a copy of what is complete, so that all processes run the same.

    Raises:
        InputError: The process does not see the files of the first one.
    """
    import atexit
    import shutil
    import socket
    import tempfile

    from evercal.continual.benchmark.results import RESULTS, SETTINGS
    from evercal.continual.networks.distributed import of_first, rank

    files = [out / SETTINGS, out / RESULTS, *(out / "runs").rglob("*")]
    seen = sorted(str(file.relative_to(out)) for file in files if file.is_file())
    if of_first(seen) != seen:
        raise InputError(
            f"{out}: process {rank()} on {socket.gethostname()} sees other files than the first"
            " process; give --out on a file system that all machines share"
        )
    if rank() == 0:
        return out
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
        raise InputError(f"--seeds {text}: give comma-separated numbers >= 0, such as 0,1,2")
    return tuple(int(word) for word in words)
