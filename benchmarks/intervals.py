"""Coverage of 95 % intervals of a paired difference when errors persist over frames."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from evercal.continual.benchmark.statistics import blocks, mean_interval, seeds_interval
from scipy.signal import lfilter
from scipy.stats import bootstrap, norm
from tabulate import tabulate
from tqdm import tqdm

Scenes = list[np.ndarray]
"""Correctness (seeds, frames) of each scene."""
Lengths = Sequence[int]
"""Frames of each run of a scene."""
Method = Callable[[Scenes, Scenes, Lengths], tuple[float, float]]
"""Returns the bounds of an interval."""


@dataclass(frozen=True)
class Errors:
    """A model of errors: a frame is correct if a normal number is below a bound.

    One normal number is shared by both methods (how hard the frame is) and one is each method's
    own. Both are partly constant over a run of frames and partly a first-order process in time.
    """

    scenes: int = 2
    """Scenes of the suite."""
    seeds: int = 1
    """Runs of each method."""
    constant: float = 0.3
    """Share of the variance that is constant over a run of frames."""
    decay_frames: float = 10.0
    """Frames after which the correlation of the rest has fallen to 37 %."""
    own: float = 0.5
    """Share of the variance that is a method's own."""
    seed: float = 0.1
    """Variance that a seed adds to all scenes."""
    accuracy: tuple[float, float] = (0.7, 0.6)
    """Accuracies of the two methods; the intervals should cover their difference."""

    def draw(self, lengths: Lengths, rng: np.random.Generator) -> tuple[Scenes, Scenes]:
        """Draw the correctness of both methods on runs of the given lengths in each scene."""
        added = self.seed if self.seeds > 1 else 0.0
        seeds = rng.normal(0, np.sqrt(added), (2, self.seeds))
        bounds = norm.ppf(self.accuracy) * np.sqrt(1 + added)
        both: tuple[Scenes, Scenes] = ([], [])
        for _ in range(self.scenes):
            hard = self._process(1, lengths, rng) * np.sqrt(1 - self.own)
            for which, scenes in enumerate(both):
                shared, apart = (self._process(n, lengths, rng) for n in (1, self.seeds))
                own = shared if self.seeds == 1 else (shared + apart) / np.sqrt(2)
                value = hard + own * np.sqrt(self.own) + seeds[which][:, None]
                scenes.append((value < bounds[which]).astype(float))
        return both

    def _process(self, count: int, lengths: Lengths, rng: np.random.Generator) -> np.ndarray:
        """Draw standard normal numbers, shape (count, frames of all runs)."""
        keep, runs = np.exp(-1 / self.decay_frames), len(lengths)
        noise = rng.normal(size=(count, runs, max(lengths)))
        noise[:, :, 1:] *= np.sqrt(1 - keep**2)
        in_time = lfilter([1.0], [1.0, -keep], noise, axis=-1)
        whole = rng.normal(size=(count, runs, 1))
        both = np.sqrt(self.constant) * whole + np.sqrt(1 - self.constant) * in_time
        return both[:, np.arange(max(lengths)) < np.array(lengths)[:, None]]


def bootstrap_of_runs(method: str) -> Method:
    """Return scipy's bootstrap over runs of frames of equal length; seeds are averaged."""

    def bounds(a: Scenes, b: Scenes, lengths: Lengths) -> tuple[float, float]:
        pieces = [
            (x - y).mean(axis=0).reshape(len(lengths), -1).mean(axis=1)
            for x, y in zip(a, b, strict=True)
        ]
        if all(np.ptp(means) == 0 for means in pieces):
            return float(np.mean(pieces)), float(np.mean(pieces))
        interval = bootstrap(
            pieces,
            lambda *samples, axis: sum(s.mean(axis=axis) for s in samples) / len(samples),
            n_resamples=1000,
            method=method,
            vectorized=True,
            rng=np.random.default_rng(0),
        ).confidence_interval
        return float(interval.low), float(interval.high)

    return bounds


def students(a: Scenes, b: Scenes, lengths: Lengths) -> tuple[float, float]:
    """Return the interval of `mean_interval`, over whole runs or blocks of a single run."""
    runs = np.repeat(np.arange(len(lengths)), lengths)
    labels = blocks(lengths[0]) if len(lengths) == 1 else runs
    interval = mean_interval([x - y for x, y in zip(a, b, strict=True)], [labels] * len(a))
    return interval.low, interval.high


STUDENTS = "Student's t over runs (used)"
METHODS: dict[str, Method] = {
    "bootstrap of runs, percentiles": bootstrap_of_runs("percentile"),
    "bootstrap of runs, BCa": bootstrap_of_runs("BCa"),
    STUDENTS: students,
}


def coverage(errors: Errors, lengths: Lengths, trials: int, method: Method) -> tuple[float, float]:
    """Measure how often an interval covers the true difference.

    Returns:
        Coverage in per cent and median width in points.
    """
    rng = np.random.default_rng([len(lengths), errors.seeds])
    truth = errors.accuracy[0] - errors.accuracy[1]
    bounds = [method(*errors.draw(lengths, rng), lengths) for _ in range(trials)]
    low, high = np.array(bounds).T
    covered = (low - 1e-12 <= truth) & (truth <= high + 1e-12)  # NaN covers nothing
    return 100 * float(covered.mean()), 100 * float(np.nanmedian(high - low))


MANY_SEEDS = 400
"""Seeds whose mean counts as the truth for given frames."""


def seeds_coverage(seeds: int, frames: int, trials: int) -> tuple[float, float]:
    """Measure how often `seeds_interval` covers the mean over all seeds, on the frames as given.

    Three scenes of one long run each, on which it does not matter how long errors last.

    Returns:
        Coverage in per cent and median width in points.
    """
    rng = np.random.default_rng([seeds, frames])
    covered, widths = [], []
    for _ in range(trials):
        first, second = Errors(scenes=3, seeds=MANY_SEEDS).draw((frames,), rng)
        gains = np.mean([x - y for x, y in zip(first, second, strict=True)], axis=(0, 2))
        interval = seeds_interval(gains[:seeds])
        covered.append(interval.low <= gains[seeds:].mean() <= interval.high)
        widths.append(interval.high - interval.low)
    return 100 * float(np.mean(covered)), 100 * float(np.median(widths))


def run(trials: int = 2000) -> None:
    """Measure the coverage of 95 % intervals of a paired difference.

    Args:
        trials: Trials of each setting.
    """
    rows = [
        {"seeds": seeds, "runs a scene": runs}
        | _row(Errors(seeds=seeds), (40,) * runs, trials, METHODS)
        for seeds in (1, 3)
        for runs in tqdm((2, 4, 8, 12), f"{seeds} seeds", unit="setting")
    ]
    print(tabulate(rows, "keys", "github"))
    used = {STUDENTS: students}
    lengths = (60, 40, 40, 20), (100, 20, 20, 20), (140, 20), (100, 10, 10, 10, 10, 10, 10)
    rows = [
        {"frames of the runs": ", ".join(map(str, of))} | _row(Errors(), of, trials, used)
        for of in tqdm(lengths, "unequal runs", unit="setting")
    ]
    print(tabulate(rows, "keys", "github"))
    models = {
        "over 3 frames": Errors(constant=0.0, decay_frames=3.0),
        "over 10 frames": Errors(constant=0.0),
        "30 % constant": Errors(),
    }
    rows = [
        {"frames of the run": frames, "correlation": title} | _row(errors, (frames,), trials, used)
        for frames in tqdm((39, 160, 300), "one run", unit="setting")
        for title, errors in models.items()
    ]
    print(tabulate(rows, "keys", "github"))
    cells = {
        f"{seeds} seeds": "{:.1f} % ({:.0f})".format(*seeds_coverage(seeds, 300, trials // 4))
        for seeds in tqdm((3, 5, 8), "other seeds, the same frames", unit="setting")
    }
    print(tabulate([{"frames of the run": 300} | cells], "keys", "github"))


def _row(
    errors: Errors, lengths: Lengths, trials: int, methods: Mapping[str, Method]
) -> dict[str, object]:
    cells = {name: coverage(errors, lengths, trials, method) for name, method in methods.items()}
    return {name: f"{covered:.1f} % ({width:.0f})" for name, (covered, width) in cells.items()}
