"""`evercal bench`."""

import dataclasses
import functools
import itertools
from dataclasses import field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from evercal.choices import Preset
from evercal.classes import frozen
from evercal.cli import args
from evercal.cli.training import Training, observer
from evercal.errors import InputError
from evercal.progress import Bars

if TYPE_CHECKING:
    from evercal.continual.benchmark.bench import CompletedStage
    from evercal.continual.learning.stage import StageOptions
    from evercal.continual.strategies import Strategy
    from evercal.recordings import Recording


@frozen
class Bench(args.Verb, Training):
    """Compare strategies on a sequence of scenes; the same command resumes.

    Given a folder of results, print its tables again.

    Example: evercal bench sim-mini --strategies evercal,finetune,er --seeds 0
    """

    suite: Annotated[Positional[str], arg(metavar="SUITE")]
    """One of sim-mini (packaged), sim, sim-7, sim-12, sim-tune, sim-unseen, sim-repeat,
    real2, i7s, i12s, custom; or a folder of results."""
    recordings: Annotated[Positional[tuple[Path, ...]], args.shown("[DIR...]")] = ()
    """Recordings of the suite custom, in order of learning."""
    strategies: Annotated[str, arg(metavar="A,B")] = (
        "evercal,joint,finetune,er,sars_spdd"
    )
    """Comma-separated strategies; the others are compared with the first. table4 stands for those
    of the paper's Table 4."""
    seeds: Annotated[str, arg(metavar="0,1")] = "0,1,2"
    """Comma-separated seeds; every strategy runs once with each."""
    order: Literal["given", "reversed", "shuffled", "balanced"] = "given"
    """Order in which the scenes are learned. shuffled draws one for each seed. balanced turns the
    given order by one place for each seed, and reverses it in every second round."""
    scenes: Annotated[str, args.shown("A,B")] = ""
    """Comma-separated scenes of the suite. Defaults to all."""
    data: args.Folder = None
    """Folder of the suite's recordings, with one folder per scene."""
    poses: args.Poses = "original"
    preset: Preset = field(default="bench", kw_only=True)
    """Training effort per stage; paper needs a GPU."""
    memory: Annotated[str, arg(metavar="SHARE|BYTES")] = "10%"
    """Keyframes to keep of a scene: a share of its frames (10%) or bytes (5MB)."""
    short_side: args.Count = None
    """Short side of the working images, pixels. Default: 240, and up to 480 with preset paper."""
    held_out: bool = False
    """Evaluate on a fifth of the training frames instead of the test frames, to choose settings."""
    tune: bool = False
    """Try every strategy with several weights on held-out frames, and write tuned.csv."""
    out: args.OutFolder = Path("evercal-bench")
    """Folder of results. The same command resumes there; in a second process it shares the runs."""

    def run(self) -> int:
        from evercal.continual.benchmark.suites import SUITES, tuning_split

        # A folder may have the name of a suite, whose run it has.
        if Path(self.suite).is_dir() and self.suite not in {*SUITES, "custom"}:
            return self._show(Path(self.suite))
        seeds = _numbers(self.seeds)
        from evercal.continual.benchmark import comparison, results
        from evercal.continual.benchmark.bench import BenchOptions, run_bench
        from evercal.continual.benchmark.tuning import run_tuning
        from evercal.continual.learning.presets import short_side

        self.load_plugin()
        strategies = self._strategies()  # refused before recordings are read
        scenes = self._recorded()
        judged = "test frames"
        if self.held_out or self.tune:
            scenes = list(map(tuning_split, scenes))
            judged = "held-out training frames"
        poses = self.poses if self.poses in ("original", "colour") else "sfm"
        frames = itertools.chain.from_iterable(scene.train for scene in scenes)
        with Bars(self.log) as bars:
            options = BenchOptions(
                self._stage,
                strategies,
                seeds,
                self.order,
                self.short_side or short_side(self.preset, frames),
                settings={"suite": self.suite, "poses": poses, "judged": judged},
                device=self.device,
                on_event=observer(bars),
            )
            run = run_tuning if self.tune else run_bench
            for step in run(scenes, options, self.out):
                bars.write(_progress(step, self.suite))
        if comparison.complete_runs(results.read(self.out)).empty:
            self.answer({"runs": []}, "other processes have all runs")
            return 0
        return self._show(self.out, strategies[0].name)

    def _show(self, folder: Path, reference: str = "") -> int:
        """Write tables and figures of a folder of results, and print the tables."""
        from evercal.continual.benchmark import report
        from evercal.continual.benchmark.comparison import LEGEND

        text, scores = report.write_report(
            folder, reference or _words(self.strategies)[0]
        )
        wrote = f"wrote {folder / report.TABLES}, {report.LATEX} and figures"
        record = {"runs": scores}
        self.answer(record, f"{text}\n\n{LEGEND}", wrote, then=("bench", folder))
        return 0

    def _strategies(self) -> "tuple[Strategy, ...]":
        from evercal.continual.benchmark.paper_tables import TABLE4

        names: list[str] = []
        for word in _words(self.strategies):
            if word == "table4":
                names += TABLE4
            else:
                names.append(word)
        return tuple(map(self.strategy, dict.fromkeys(names)))

    def _recorded(self) -> "list[Recording]":
        from evercal.continual.benchmark.suites import load_suite
        from evercal.recordings import ReadOptions, load_recording

        if (self.suite == "custom") != bool(self.recordings):
            raise InputError(
                f"suite {self.suite}: give scene folders for the suite custom only"
            )
        if self.suite == "custom":
            options = ReadOptions(poses=self.poses)
            load = functools.partial(load_recording, options=options)
            return list(map(load, self.recordings))
        return load_suite(self.suite, self.data, _words(self.scenes), self.poses)

    def _stage(self, seed: int) -> "StageOptions":
        from evercal.continual.learning.presets import PAPER_SIM_STEPS

        given = self
        if self.preset == "paper" and self.suite.startswith("sim"):
            given = dataclasses.replace(self, steps=self.steps or PAPER_SIM_STEPS)
        return given.stage(seed, self.memory, "fixed")


def _progress(step: "CompletedStage", suite: str) -> str:
    """Describe a stage: accuracy of each scene."""
    from evercal.continual.benchmark.comparison import thresholds

    run = f"[{step.done}/{step.total}] {step.strategy} seed {step.seed}"
    rows = step.results
    threshold, _ = thresholds(suite)
    shares = 100 * rows[threshold.column] / rows["frames"]
    scenes = ", ".join(rows["scene"] + shares.map(" {:.1f}".format))
    seconds = rows["seconds"].iloc[0]
    return f"{run}: {scenes} % at {threshold.text} ({seconds:.0f} s)"


def _words(text: str) -> tuple[str, ...]:
    return tuple(filter(None, map(str.strip, text.split(","))))


def _numbers(text: str) -> tuple[int, ...]:
    words = _words(text)
    if not words or not all(map(str.isdecimal, words)):
        raise InputError(
            f"--seeds {text}: give comma-separated numbers >= 0, such as 0,1,2"
        )
    return tuple(map(int, words))
