"""How often 95 % bounds of a paired difference hold the truth, where errors last over frames."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter
from scipy.stats import bootstrap, norm
from tabulate import tabulate
from tqdm import tqdm

from evercal.evaluation.statistics import paired_difference

Scenes = list[np.ndarray]
"""(seeds, frames) correctness of each scene."""
Bounds = tuple[float, float]


@dataclass(frozen=True)
class Errors:
    """Whether a frame is right: a normal number that lasts over frames is below a bound.

    One such number is shared by both methods, what makes a frame hard, and one is each method's
    own. Both are partly the same for a whole run and partly a first-order process in time.
    """

    scenes: int = 2
    """Scenes of the suite."""
    frames: int = 40
    """Frames of a run."""
    seeds: int = 1
    """Runs of each method."""
    lasting: float = 0.3
    """Share of the variance that is the same for a run of frames."""
    memory: float = 10.0
    """Frames after which the rest has fallen to 37 %."""
    own: float = 0.5
    """Share of the variance that is a method's own."""
    seed: float = 0.1
    """Variance that a seed adds, for all scenes."""
    right: tuple[float, float] = (0.7, 0.6)
    """How often the two methods are right: what the bounds are to hold is their difference."""

    def drawn(self, runs: int, rng: np.random.Generator) -> tuple[Scenes, Scenes]:
        """Correctness of both methods on `runs` runs of frames a scene."""
        added = self.seed if self.seeds > 1 else 0.0
        seeds = rng.normal(0, np.sqrt(added), (2, self.seeds))
        limits = norm.ppf(self.right) * np.sqrt(1 + added)
        found: tuple[Scenes, Scenes] = ([], [])
        for _ in range(self.scenes):
            hard = self._lasting(1, runs, rng) * np.sqrt(1 - self.own)
            for which, of in enumerate(found):
                alike, apart = (self._lasting(n, runs, rng) for n in (1, self.seeds))
                own = alike if self.seeds == 1 else (alike + apart) / np.sqrt(2)
                value = hard + own * np.sqrt(self.own) + seeds[which][:, None]
                of.append((value < limits[which]).astype(float))
        return found

    def _lasting(self, count: int, runs: int, rng: np.random.Generator) -> np.ndarray:
        """(count, frames of all runs) standard normal numbers."""
        keep = np.exp(-1 / self.memory)
        noise = rng.normal(size=(count, runs, self.frames))
        noise[:, :, 1:] *= np.sqrt(1 - keep**2)
        in_time = lfilter([1.0], [1.0, -keep], noise, axis=-1)
        whole = rng.normal(size=(count, runs, 1))
        both = np.sqrt(self.lasting) * whole + np.sqrt(1 - self.lasting) * in_time
        return both.reshape(count, -1)


def blocks_of_ten(a: Scenes, b: Scenes, runs: int) -> Bounds:
    """Percentiles over circular blocks of ten frames and over seeds, as it was before."""
    rng, samples, block = np.random.default_rng(0), 1000, 10
    seeds = len(a[0])
    weights = rng.multinomial(seeds, np.full(seeds, 1 / seeds), size=samples) / seeds
    drawn = np.zeros(samples)
    for x, y in zip(a, b, strict=True):
        rows = x - y
        frames = rows.shape[1]
        ring = np.concatenate([np.zeros((seeds, 1)), rows, rows[:, :block]], axis=1).cumsum(axis=1)
        starts = rng.integers(frames, size=(samples, frames // block))
        sums = ring[:, starts + block] - ring[:, starts]
        means = sums.sum(axis=-1) / (block * starts.shape[1])
        drawn += (weights * means.T).sum(axis=1) / len(a)
    return float(np.percentile(drawn, 2.5)), float(np.percentile(drawn, 97.5))


def whole_runs(method: str) -> Callable[[Scenes, Scenes, int], Bounds]:
    """Bootstrap of runs of frames as scipy does it; seeds are averaged before."""

    def bounds(a: Scenes, b: Scenes, runs: int) -> Bounds:
        pieces = [
            (x - y).mean(axis=0).reshape(runs, -1).mean(axis=1) for x, y in zip(a, b, strict=True)
        ]
        if all(np.ptp(of) == 0 for of in pieces):
            same = float(np.mean(pieces))
            return same, same
        found = bootstrap(
            pieces,
            lambda *samples, axis: sum(s.mean(axis=axis) for s in samples) / len(samples),
            n_resamples=1000,
            method=method,
            vectorized=True,
            rng=np.random.default_rng(0),
        ).confidence_interval
        return float(found.low), float(found.high)

    return bounds


def students(a: Scenes, b: Scenes, runs: int) -> Bounds:
    """What `evercal.evaluation.paired_difference` says of whole runs."""
    labels = np.repeat(np.arange(runs), a[0].shape[1] // runs)
    found = paired_difference(a, b, [labels] * len(a))
    return found.low, found.high


METHODS: dict[str, Callable[[Scenes, Scenes, int], Bounds]] = {
    "blocks of ten, percentiles (before)": blocks_of_ten,
    "whole runs, percentiles": whole_runs("percentile"),
    "whole runs, BCa": whole_runs("BCa"),
    "whole runs, Student's (now)": students,
}


def coverage(
    errors: Errors, runs: int, trials: int, method: Callable[[Scenes, Scenes, int], Bounds]
) -> tuple[float, float]:
    """How often bounds hold the true difference, per cent, and their median width in points."""
    rng, truth = np.random.default_rng([runs, errors.seeds]), errors.right[0] - errors.right[1]
    found = []
    for _ in range(trials):
        found.append(method(*errors.drawn(runs, rng), runs))
    low, high = np.array(found).T
    held = (low - 1e-12 <= truth) & (truth <= high + 1e-12)  # NaN holds nothing
    return 100 * float(held.mean()), 100 * float(np.nanmedian(high - low))


def run(trials: int) -> None:
    """Prints, by the number of runs of frames a scene, coverage and median width of each method."""
    rows = []
    for seeds in (1, 3):
        for runs in tqdm((2, 4, 8, 12), f"{seeds} seeds", unit="setting"):
            row: dict[str, object] = {"seeds": seeds, "runs a scene": runs}
            for name, method in METHODS.items():
                held, width = coverage(Errors(seeds=seeds), runs, trials, method)
                row[name] = f"{held:.1f} % ({width:.0f})"
            rows.append(row)
    print(tabulate(rows, "keys", "github"))
