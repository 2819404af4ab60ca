"""How often 95 % bounds of a paired difference hold the truth, where errors last over frames."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter
from scipy.stats import bootstrap, norm, t
from tabulate import tabulate
from tqdm import tqdm

from evercal.continual.benchmark.statistics import blocks, paired_difference

Scenes = list[np.ndarray]
"""(seeds, frames) correctness of each scene."""
Bounds = tuple[float, float]
Lengths = Sequence[int]
"""Frames of each run of a scene."""
Method = Callable[[Scenes, Scenes, Lengths], Bounds]


@dataclass(frozen=True)
class Errors:
    """Whether a frame is right: a normal number that lasts over frames is below a bound.

    One such number is shared by both methods, what makes a frame hard, and one is each method's
    own. Both are partly the same for a whole run and partly a first-order process in time.
    """

    scenes: int = 2
    """Scenes of the suite."""
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

    def drawn(self, lengths: Lengths, rng: np.random.Generator) -> tuple[Scenes, Scenes]:
        """Correctness of both methods on runs of so many frames in each scene."""
        added = self.seed if self.seeds > 1 else 0.0
        seeds = rng.normal(0, np.sqrt(added), (2, self.seeds))
        limits = norm.ppf(self.right) * np.sqrt(1 + added)
        found: tuple[Scenes, Scenes] = ([], [])
        for _ in range(self.scenes):
            hard = self._lasting(1, lengths, rng) * np.sqrt(1 - self.own)
            for which, of in enumerate(found):
                alike, apart = (self._lasting(n, lengths, rng) for n in (1, self.seeds))
                own = alike if self.seeds == 1 else (alike + apart) / np.sqrt(2)
                value = hard + own * np.sqrt(self.own) + seeds[which][:, None]
                of.append((value < limits[which]).astype(float))
        return found

    def _lasting(self, count: int, lengths: Lengths, rng: np.random.Generator) -> np.ndarray:
        """(count, frames of all runs) standard normal numbers."""
        keep, runs = np.exp(-1 / self.memory), len(lengths)
        noise = rng.normal(size=(count, runs, max(lengths)))
        noise[:, :, 1:] *= np.sqrt(1 - keep**2)
        in_time = lfilter([1.0], [1.0, -keep], noise, axis=-1)
        whole = rng.normal(size=(count, runs, 1))
        both = np.sqrt(self.lasting) * whole + np.sqrt(1 - self.lasting) * in_time
        return both[:, np.arange(max(lengths)) < np.array(lengths)[:, None]]


def blocks_of_ten(a: Scenes, b: Scenes, lengths: Lengths) -> Bounds:
    """Percentiles over circular blocks of ten frames and over seeds, as it was at first."""
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


def whole_runs(method: str) -> Method:
    """Bootstrap of runs of frames as scipy does it; seeds are averaged before."""

    def bounds(a: Scenes, b: Scenes, lengths: Lengths) -> Bounds:
        pieces = [
            (x - y).mean(axis=0).reshape(len(lengths), -1).mean(axis=1)
            for x, y in zip(a, b, strict=True)
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


def plain_students(a: Scenes, b: Scenes, lengths: Lengths) -> Bounds:
    """With one degree less than pieces however long they are; one run: blocks of ten, 20 at most.

    So it was before; seeds are averaged.
    """
    labels, total = _labels(lengths), sum(lengths)
    if len(lengths) == 1:
        labels = np.arange(total) * min(max(total // 10, 2), 20) // total
    count = labels[-1] + 1
    variances, mean = [], 0.0
    for x, y in zip(a, b, strict=True):
        rows = (x - y).mean(axis=0)
        residual = np.bincount(labels, rows - rows.mean()) / total
        variances.append(count / (count - 1) * (residual**2).sum() / len(a) ** 2)
        mean += rows.mean() / len(a)
    variance = np.array(variances)
    if variance.sum() == 0:
        return mean, mean
    freedom = (count - 1) * variance.sum() ** 2 / (variance**2).sum()
    half = float(t.ppf(0.975, freedom) * np.sqrt(variance.sum()))
    return mean - half, mean + half


def students(a: Scenes, b: Scenes, lengths: Lengths) -> Bounds:
    """What `evercal.evaluation.paired_difference` says of whole runs, of one run its blocks."""
    labels = blocks(lengths[0]) if len(lengths) == 1 else _labels(lengths)
    found = paired_difference(a, b, [labels] * len(a))
    return found.low, found.high


def _labels(lengths: Lengths) -> np.ndarray:
    return np.repeat(np.arange(len(lengths)), lengths)


NOW = "whole runs, Student's (now)"
METHODS: dict[str, Method] = {
    "blocks of ten, percentiles (at first)": blocks_of_ten,
    "whole runs, percentiles": whole_runs("percentile"),
    "whole runs, BCa": whole_runs("BCa"),
    NOW: students,
}
BEFORE_NOW: dict[str, Method] = {"before": plain_students, "now": students}
ONE_RUN = {
    "fades over 3 frames": Errors(lasting=0.0, memory=3.0),
    "fades over 10 frames": Errors(lasting=0.0),
    "30 % lasts for a run": Errors(),
}


def coverage(errors: Errors, lengths: Lengths, trials: int, method: Method) -> tuple[float, float]:
    """How often bounds hold the true difference, per cent, and their median width in points."""
    rng = np.random.default_rng([len(lengths), errors.seeds])
    truth = errors.right[0] - errors.right[1]
    found = []
    for _ in range(trials):
        found.append(method(*errors.drawn(lengths, rng), lengths))
    low, high = np.array(found).T
    held = (low - 1e-12 <= truth) & (truth <= high + 1e-12)  # NaN holds nothing
    return 100 * float(held.mean()), 100 * float(np.nanmedian(high - low))


def run(trials: int) -> None:
    """Prints coverage and median width of each method, by the runs of frames of a scene."""
    rows = []
    for seeds in (1, 3):
        for runs in tqdm((2, 4, 8, 12), f"{seeds} seeds", unit="setting"):
            row: dict[str, object] = {"seeds": seeds, "runs a scene": runs}
            rows.append(row | _row(Errors(seeds=seeds), (40,) * runs, trials, METHODS))
    print(tabulate(rows, "keys", "github"))
    rows = []
    unequal = (60, 40, 40, 20), (100, 20, 20, 20), (140, 20), (100, 10, 10, 10, 10, 10, 10)
    for lengths in tqdm(unequal, "unequal", unit="setting"):
        row = {"frames of the runs": ", ".join(map(str, lengths))}
        rows.append(row | _row(Errors(), lengths, trials, BEFORE_NOW))
    print(tabulate(rows, "keys", "github"))
    rows = []
    for frames in tqdm((39, 160, 300), "one run", unit="setting"):
        for title, errors in ONE_RUN.items():
            row = {"frames of the one run": frames, "what makes a frame hard": title}
            rows.append(row | _row(errors, (frames,), trials, BEFORE_NOW))
    print(tabulate(rows, "keys", "github"))


def _row(
    errors: Errors, lengths: Lengths, trials: int, methods: dict[str, Method]
) -> dict[str, object]:
    found = {name: coverage(errors, lengths, trials, method) for name, method in methods.items()}
    return {name: f"{held:.1f} % ({width:.0f})" for name, (held, width) in found.items()}
