"""Rules that select keyframes, by name; most use features of the learned head.

Each rule selects frames of one scene up to a capacity. Rules designed for classes treat a scene as
a class and the mean over an image as its feature. All return sorted indices.
"""

from collections.abc import Callable, Sequence

import numpy as np

from evercal.continual.selection.frame_statistics import FrameStatistics
from evercal.mapping.selection import SarsOptions, select_sars

GSS_COMPARED = 10
"""Buffered frames with which gradient-based selection compares a new frame."""


def select_reservoir(count: int, capacity: int, rng: np.random.Generator) -> np.ndarray:
    """Reservoir sampling: every frame is selected with the same probability.

    Frames are appended until the buffer is full. Later the n-th frame draws one of n slots and
    replaces its frame if the slot is in the buffer (Vitter, 1985, algorithm R).
    """
    selected = list(range(min(count, capacity)))
    for frame in range(capacity, count):
        slot = int(rng.integers(frame + 1))
        if slot < capacity:
            selected[slot] = frame
    return np.sort(np.array(selected, dtype=np.int64))


def select_herding(features: np.ndarray, capacity: int) -> np.ndarray:
    """Herding of iCaRL (Rebuffi et al., CVPR 2017, Algorithm 4).

    Each next frame is the one that brings the mean of the selection closest to the mean of all
    frames. Ties go to the earlier frame. The rows of features (n, c) are scaled to unit length.
    """
    unit = _unit(features)
    mean = unit.mean(0) if len(unit) else np.zeros(features.shape[1])
    free = np.ones(len(unit), dtype=bool)
    total = np.zeros(unit.shape[1])
    selected = []
    for taken in range(1, min(capacity, len(unit)) + 1):
        gap = np.linalg.norm(mean - (total + unit) / taken, axis=1)
        chosen = int(np.where(free, gap, np.inf).argmin())
        free[chosen] = False
        total += unit[chosen]
        selected.append(chosen)
    return np.sort(np.array(selected, dtype=np.int64))


def leverage_scores(features: np.ndarray, rank: int) -> np.ndarray:
    """Compute rank-r leverage: squared row norms of the first r left singular vectors of (n, c).

    The scores sum to the rank. FedCBDR prints the full left factor, whose rows all have norm 1; the
    thin one is used here.
    """
    left, values, _ = np.linalg.svd(
        np.asarray(features, np.float64), full_matrices=False
    )
    used = int((values > values.max(initial=0) * 1e-9).sum())
    return (left[:, : min(rank, used)] ** 2).sum(1)


def select_leverage(
    features: np.ndarray, capacity: int, rng: np.random.Generator, rank: int = 32
) -> np.ndarray:
    """Global-perspective data replay (GDR of FedCBDR, Qi et al., NeurIPS 2025) for one party.

    Frames are drawn without replacement, with probabilities proportional to their leverage.
    Encryption and bias weights, which serve several parties, are omitted.
    """
    score = leverage_scores(features, rank)
    # Frames without leverage can still fill the capacity.
    share = (score + 1e-12) / (score + 1e-12).sum()
    count = min(capacity, len(score))
    return np.sort(rng.choice(len(score), size=count, replace=False, p=share))


def select_coverage(
    visible: Sequence[np.ndarray], capacity: int, rng: np.random.Generator
) -> np.ndarray:
    """Coverage score of Buff-CS (Wang et al., ICCV 2021) inside one scene.

    Frames arrive in random order and are appended until the buffer is full. Later a frame enters if
    it shows a part of the scene that no buffered frame shows. Otherwise it enters with probability
    m / n as in a reservoir (m buffered, n earlier frames). Each entering frame replaces a random
    one, as in the released code. `visible` are the numbers of the parts that each frame shows.
    """
    count = 1 + max((int(parts.max()) for parts in visible if len(parts)), default=-1)
    shows = np.zeros((len(visible), count), dtype=bool)
    for frame, parts in enumerate(visible):
        shows[frame, parts] = True
    selected: list[int] = []
    for earlier, frame in enumerate(rng.permutation(len(visible)).tolist()):
        if len(selected) < capacity:
            selected.append(frame)
            continue
        novel = bool((shows[frame] & ~shows[selected].any(0)).any())
        if selected and (novel or rng.random() <= len(selected) / earlier):
            selected[int(rng.integers(len(selected)))] = frame
    return np.sort(np.array(selected, dtype=np.int64))


def select_gradients(
    gradients: np.ndarray, capacity: int, rng: np.random.Generator
) -> np.ndarray:
    """Gradient-based sample selection, greedy (GSS, Aljundi et al., NeurIPS 2019, Algorithm 2).

    A frame's score c is one plus its largest cosine with a few buffered frames. Frames are appended
    until the buffer is full. Later a frame enters only if c < 1, which means opposed gradients. It
    then replaces a buffered frame i, drawn by its score c_i, with probability c_i / (c_i + c). The
    gradients (n, p) are those of the loss on each frame.
    """
    unit = _unit(gradients)
    selected: list[int] = []
    scores = np.zeros(min(capacity, len(unit)))
    for frame in range(len(unit) if capacity else 0):
        compared = [selected[i] for i in rng.permutation(len(selected))[:GSS_COMPARED]]
        cosines = unit[compared] @ unit[frame] if selected else np.array([-0.9])
        score = float(cosines.max()) + 1.0
        if len(selected) < capacity:
            scores[len(selected)] = score
            selected.append(frame)
        elif score < 1.0:
            total = scores.sum()
            slot = int(rng.choice(len(selected), p=scores / total)) if total > 0 else 0
            if rng.random() * (scores[slot] + score) < scores[slot]:
                selected[slot] = frame
                scores[slot] = score
    return np.sort(np.array(selected, dtype=np.int64))


def _unit(rows: np.ndarray) -> np.ndarray:
    rows = np.asarray(rows, dtype=np.float64)
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)


Select = Callable[[FrameStatistics, int], np.ndarray]
"""Maps the frames of a finished scene and a capacity to sorted indices of the keyframes."""

SELECTORS: dict[str, Select] = {
    "reservoir": lambda f, capacity: select_reservoir(len(f), capacity, f.rng()),
    "herding": lambda f, capacity: select_herding(f.features(), capacity),
    "coverage": lambda f, capacity: select_coverage(
        f.visible_parts(), capacity, f.rng()
    ),
    "leverage": lambda f, capacity: select_leverage(f.features(), capacity, f.rng()),
    "gradients": lambda f, capacity: select_gradients(f.gradients(), capacity, f.rng()),
    "sars": lambda f, capacity: select_sars(
        f.positions_m, f.quaternions_wxyz, capacity
    ),
    "sars_filled": lambda f, capacity: select_sars(
        f.positions_m, f.quaternions_wxyz, capacity, SarsOptions(fill=True)
    ),
}
"""`sars` uses the paper's fixed radius, `sars_filled` the largest radius that fills the memory."""
