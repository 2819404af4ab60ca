"""Which frames of a scene stay in memory, decided from what the learned head makes of them.

Selectors of other methods, each over one scene with its own quota. Where a rule was made for
classes, a class is a scene here and its feature a mean over the image; the docstrings say what
that leaves of the original. All return kept indices in recorded order.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

ROUNDING = 1e-9
GSS_COMPARED = 10
"""Remembered frames that gradient-based selection compares a new one with."""


def select_reservoir(count: int, capacity: int, rng: np.random.Generator) -> np.ndarray:
    """Reservoir sampling: every frame of the stream stays with the same probability.

    The n-th frame is appended while there is room; later it draws a place among n and, if that
    lies in the buffer, takes it (Vitter, 1985, algorithm R).

    Args:
        count: frames in the stream.
        capacity: places.
        rng: of the draws.
    """
    kept = list(range(min(count, capacity)))
    for frame in range(capacity, count):
        place = int(rng.integers(frame + 1))
        if place < capacity:
            kept[place] = frame
    return np.sort(np.array(kept, dtype=np.int64))


def select_hybrid(features: np.ndarray, capacity: int, rng: np.random.Generator) -> np.ndarray:
    """A reservoir of novel frames, after the hybrid replay of Bahadir et al. (MVA 2024).

    A frame enters the stream of the reservoir only if it is novel: less alike to the last one that
    did than the median of neighbouring frames is. What is known of the original is its abstract
    (reservoir, and a test of new data for novelty); the measure is ours. Places that are left when
    too few frames are novel are filled with a reservoir of the others.

    Args:
        features: (n, c) of the frames in recorded order; rows are scaled to unit length.
        capacity: frames to keep.
        rng: of the draws.
    """
    unit = _unit(features)
    step = 1 - (unit[1:] * unit[:-1]).sum(1)
    floor = float(np.median(step)) if len(step) else 0.0
    novel: list[int] = []
    for frame in range(len(unit)):
        if not novel or 1 - float(unit[frame] @ unit[novel[-1]]) > floor + ROUNDING:
            novel.append(frame)
    kept = np.array(novel, dtype=np.int64)[select_reservoir(len(novel), capacity, rng)]
    others = np.setdiff1d(np.arange(len(unit)), novel)
    more = select_reservoir(len(others), capacity - len(kept), rng)
    return np.sort(np.concatenate([kept, others[more]]))


def select_herding(features: np.ndarray, capacity: int) -> np.ndarray:
    """Herding of iCaRL (Rebuffi et al., CVPR 2017, Algorithm 4).

    Frames are taken one after another so that the mean of those taken stays nearest to the mean of
    all. Ties go to the earlier frame.

    Args:
        features: (n, c) of the frames; rows are scaled to unit length.
        capacity: frames to keep.
    """
    unit = _unit(features)
    mean = unit.mean(0) if len(unit) else np.zeros(features.shape[1])
    free, total, kept = np.ones(len(unit), dtype=bool), np.zeros(unit.shape[1]), []
    for taken in range(1, min(capacity, len(unit)) + 1):
        gap = np.linalg.norm(mean - (total + unit) / taken, axis=1)
        chosen = int(np.where(free, gap, np.inf).argmin())
        free[chosen] = False
        total += unit[chosen]
        kept.append(chosen)
    return np.sort(np.array(kept, dtype=np.int64))


def leverage_scores(features: np.ndarray, rank: int) -> np.ndarray:
    """Rank-r leverage of rows: squared norms of the rows of the first r left singular vectors.

    They add up to the rank. Of the full left factor every row has norm 1, so the thin one is meant
    (FedCBDR prints the full one).

    Args:
        features: (n, c).
        rank: at most this many singular vectors; fewer where the matrix has fewer.
    """
    left, values, _ = np.linalg.svd(np.asarray(features, np.float64), full_matrices=False)
    used = int((values > values.max(initial=0) * 1e-9).sum())
    return (left[:, : min(rank, used)] ** 2).sum(1)


def select_leverage(
    features: np.ndarray, capacity: int, rng: np.random.Generator, rank: int = 32
) -> np.ndarray:
    """Global-perspective data replay (GDR of FedCBDR, Qi et al., NeurIPS 2025), in one place.

    Frames are drawn without replacement with probabilities proportional to their leverage. What
    serves several parties (encryption, weights against bias) has no part with one.

    Args:
        features: (n, c) of the frames.
        capacity: frames to keep.
        rng: of the draws.
        rank: see `leverage_scores`.
    """
    score = leverage_scores(features, rank)
    # Frames without any leverage may fill what is left.
    share = (score + 1e-12) / (score + 1e-12).sum()
    kept = rng.choice(len(score), size=min(capacity, len(score)), replace=False, p=share)
    return np.sort(kept)


def select_coverage(
    visible: Sequence[np.ndarray],
    capacity: int,
    rng: np.random.Generator,
    victim: Literal["random", "redundant"] = "random",
) -> np.ndarray:
    """Coverage score of Buff-CS (Wang et al., ICCV 2021) inside one scene.

    The frames stream by in random order. While there is room all stay. Later a frame stays if it
    shows a part of the scene that no kept frame shows, or else with probability m / n as in a
    reservoir (m kept, n seen before); then a kept frame leaves.

    Args:
        visible: for each frame the numbers of the parts that it shows.
        capacity: frames to keep.
        rng: of the order and the draws.
        victim: who leaves: a random frame as in the released code, or the one that shares most with
            the others, which that code computes and does not use.
    """
    parts = 1 + max((int(found.max()) for found in visible if len(found)), default=-1)
    shows = np.zeros((len(visible), parts), dtype=bool)
    for frame, found in enumerate(visible):
        shows[frame, found] = True
    kept: list[int] = []
    for seen, frame in enumerate(rng.permutation(len(visible)).tolist()):
        if len(kept) < capacity:
            kept.append(frame)
            continue
        novel = bool((shows[frame] & ~shows[kept].any(0)).any())
        if kept and (novel or rng.random() <= len(kept) / seen):
            kept[_leaving(shows[kept], rng, victim)] = frame
    return np.sort(np.array(kept, dtype=np.int64))


def _leaving(shows: np.ndarray, rng: np.random.Generator, victim: str) -> int:
    if victim == "random":
        return int(rng.integers(len(shows)))
    signed = np.where(shows, 1.0, -1.0)
    return int((signed @ signed.T).sum(1).argmax())


def select_gradients(gradients: np.ndarray, capacity: int, rng: np.random.Generator) -> np.ndarray:
    """Gradient-based sample selection, greedy (GSS, Aljundi et al., NeurIPS 2019, Algorithm 2).

    A frame's score is one plus its largest cosine with a few kept frames. While there is room all
    stay. Later only a frame that points away from all of those (score below 1) may enter: it
    challenges a kept frame, drawn by score, and wins with the share of that score in both.

    Args:
        gradients: (n, p) of the loss on each frame.
        capacity: frames to keep.
        rng: of the draws.
    """
    unit = _unit(gradients)
    kept: list[int] = []
    scores = np.zeros(min(capacity, len(unit)))
    for frame in range(len(unit) if capacity else 0):
        compared = rng.permutation(len(kept))[:GSS_COMPARED]
        likeness = unit[[kept[i] for i in compared]] @ unit[frame] if kept else np.array([-0.9])
        score = float(likeness.max()) + 1.0
        if len(kept) < capacity:
            scores[len(kept)] = score
            kept.append(frame)
        elif score < 1.0:
            total = scores.sum()
            place = int(rng.choice(len(kept), p=scores / total)) if total > 0 else 0
            if rng.random() * (scores[place] + score) < scores[place]:
                kept[place], scores[place] = frame, score
    return np.sort(np.array(kept, dtype=np.int64))


def _unit(rows: np.ndarray) -> np.ndarray:
    rows = np.asarray(rows, dtype=np.float64)
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)
