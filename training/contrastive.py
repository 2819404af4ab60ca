"""Contrastive training of the local encoder on procedural image pairs."""

import io
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.random import Generator
from torch import Tensor
from torch.nn import functional as F
from torch.utils.data import DataLoader, IterableDataset

from evercal.continual.networks.precision import autocast
from evercal.errors import InputError
from evercal.processes import started_safely
from evercal.storage.atomic import write_bytes
from rooms.renderer import mitsuba
from training.furnished import cached_furnished_views
from training.network import TEACHER, LocalEncoder
from training.pairs import (
    END_ROOM_SEED,
    FIRST_ROOM_SEED,
    HEIGHT,
    PER_ANCHOR,
    VALIDATION_ROOM_SEED,
    WIDTH,
    Pair,
    Views,
    cell_pixels,
    homography_pair,
    photometric,
    room_seeds,
    room_views,
    seeded_picture,
    view_pair,
)

CHECKPOINT = "encoder.pt"
CHECKPOINT_STEPS = 250
NEAR_PX = 10.0


@dataclass(frozen=True)
class PretrainOptions:
    """Options of the pretraining; `pretrain.log` records the options of the shipped weights."""

    steps: int = 9_000
    """Optimiser steps of the local encoder."""
    rooms: int = 160
    """Box rooms, each with 20 views."""
    furnished: int = 120
    """Furnished rooms (folder `rooms`), each with 20 views."""
    pictures: int = 300
    """Dead-leaves pictures for homography pairs."""
    room_pairs: int = 1
    """Pairs from box rooms in a step."""
    furnished_pairs: int = 3
    """Pairs from furnished rooms in a step."""
    leaf_pairs: int = 2
    """Homography pairs in a step."""
    points: int = 192
    """Largest number of corresponding points of a pair."""
    rivals: Literal["points", "cells"] = "cells"
    """Negatives of a point: points of other images, or also every cell of its other image."""
    temperature: float = 0.07
    """Temperature of the softmax over cosine similarities."""
    peak_rate: float = 2e-3
    """Peak of the one-cycle learning rate."""
    descriptor_steps: int = 2_000
    """Optimiser steps of the global descriptor."""
    seed: int = 1
    """Random seed."""
    init: str | None = None
    """Checkpoint `encoder.pt` of an earlier run to start from. Without it, weights are random."""


@dataclass(frozen=True)
class PretrainData:
    """Rendered training data."""

    rooms: Sequence[Views]
    pictures: list[np.ndarray]
    furnished: Sequence[Views] = ()


class Batch(NamedTuple):
    """One training batch of b image pairs."""

    images: Tensor
    """(2, b, 1, h, w) grey values in [0, 1]."""
    pixels: Tensor
    """(2, b, points, 2) corresponding pixels."""
    valid: Tensor
    """(b, points) bool; pairs may have fewer points."""


def make_data(options: PretrainOptions, folder: Path) -> PretrainData:
    """Render rooms and pictures, box rooms with one process per core.

    Furnished rooms take about ten seconds each and are cached in `folder`.

    Raises:
        InputError: Pairs but no furnished rooms, more rooms than seeds, or no Mitsuba.
    """
    if options.furnished_pairs and not options.furnished:
        raise InputError(
            f"--furnished-pairs {options.furnished_pairs} needs --furnished of at least 1"
        )
    limit = END_ROOM_SEED - FIRST_ROOM_SEED
    if max(options.furnished, options.rooms) > limit:
        raise InputError(
            f"--rooms {options.rooms}, --furnished {options.furnished}: at most {limit} of a kind;"
            " later seeds are held out"
        )
    if options.furnished:
        mitsuba()  # fails early without it
    with started_safely() as context, context.Pool() as pool:
        rooms = pool.map(room_views, room_seeds(options.rooms), chunksize=4)
        seeds = room_seeds(options.pictures)
        pictures = pool.map(seeded_picture, seeds, chunksize=8)
    seeds = room_seeds(options.furnished)
    furnished = [cached_furnished_views(seed, folder) for seed in seeds]
    return PretrainData(rooms, pictures, furnished)


class PairStream(IterableDataset):
    """Seeded training batches from any first step to the last."""

    def __init__(self, data: PretrainData, options: PretrainOptions, first_step: int):
        self.data = data
        self.options = options
        self.first_step = first_step

    def draw(self, step: int) -> Batch:
        """Draw the batch of a step."""
        o = self.options
        rng = np.random.default_rng([o.seed, step])
        pairs: list[Pair] = []
        for count, draw in (
            (o.room_pairs, lambda: self._parallax(self.data.rooms, rng)),
            (o.furnished_pairs, lambda: self._parallax(self.data.furnished, rng)),
            (o.leaf_pairs, lambda: homography_pair(self._picture(rng), rng)),
        ):
            goal = len(pairs) + count
            while len(pairs) < goal:
                pair = draw()
                if pair.pixels.shape[1] >= 48:
                    pairs.append(pair)
        count = len(pairs)
        images = np.stack([[photometric(im, rng) for im in p.images] for p in pairs], 1)
        pixels = np.zeros((2, count, o.points, 2), np.float32)
        valid = np.zeros((count, o.points), bool)
        for i, pair in enumerate(pairs):
            chosen = rng.permutation(pair.pixels.shape[1])[: o.points]
            pixels[:, i, : len(chosen)] = pair.pixels[:, chosen]
            valid[i, : len(chosen)] = True
        grey = torch.from_numpy(images[:, :, None]).float() / 255
        return Batch(grey, torch.from_numpy(pixels), torch.from_numpy(valid))

    def _parallax(self, rooms: Sequence[Views], rng: Generator) -> Pair:
        """Draw two views of one part of a room."""
        views = rooms[int(rng.integers(len(rooms)))]
        anchor = PER_ANCHOR * rng.integers(len(views.images) // PER_ANCHOR)
        first, second = anchor + rng.choice(PER_ANCHOR, 2, replace=False)
        return view_pair(views, int(first), int(second), rng)

    def _picture(self, rng: Generator) -> np.ndarray:
        return self.data.pictures[rng.integers(len(self.data.pictures))]

    def __iter__(self) -> Iterator[Batch]:
        import cv2

        cv2.setNumThreads(1)
        for step in range(self.first_step, self.options.steps):
            yield self.draw(step)


def sample_features(features: Tensor, pixels: Tensor) -> Tensor:
    """Interpolate features (b, c, h, w) at pixels (b, n, 2) as unit vectors (b, n, c)."""
    size = torch.tensor([WIDTH, HEIGHT], dtype=pixels.dtype)
    grid = 2 * (pixels + 0.5) / size - 1
    sampled = F.grid_sample(
        features, grid[:, None], align_corners=False, padding_mode="border"
    )
    return F.normalize(sampled[:, :, 0].transpose(1, 2), dim=-1)


def contrastive_loss(
    points: Tensor,
    pixels: Tensor,
    valid: Tensor,
    temperature: float,
    cells: Tensor | None = None,
) -> Tensor:
    """Compute the symmetric InfoNCE loss (van den Oord et al., 2018) over all points of a batch.

    The negatives of a point are all other points of the batch. With `cells`, all cells of the other
    image of its pair are added, so similar structures within an image (books, tiles, handles) are
    separated too. Negatives within 10 pixels of the true match are ignored.

    Args:
        points: (2, p, n, c) unit features of the points in the first and second images.
        pixels: (2, p, n, 2) positions of the points.
        valid: (p, n) bool.
        temperature: Temperature of the softmax.
        cells: (2, p, m, c) unit features of the images' cells, in the order of `cell_pixels`.
    """
    keep = valid.flatten()
    image = torch.arange(len(valid)).repeat_interleave(valid.shape[1])[keep]
    target = torch.arange(len(image))
    total = points.new_zeros(())
    for one, other in ((0, 1), (1, 0)):
        x = points[one].flatten(0, 1)[keep]
        y = points[other].flatten(0, 1)[keep]
        where = pixels[other].flatten(0, 1)[keep]
        near = (torch.cdist(where, where) < NEAR_PX) & (image[:, None] == image[None])
        near.fill_diagonal_(False)
        logits = x @ y.T
        if cells is not None:
            grid = torch.from_numpy(cell_pixels()).to(where)
            within = (points[one] @ cells[other].transpose(1, 2)).flatten(0, 1)[keep]
            logits = torch.cat([logits, within], 1)
            near = torch.cat([near, torch.cdist(where, grid) < NEAR_PX], 1)
        logits = (logits / temperature).masked_fill(near, -1e4)
        total = total + 0.5 * F.cross_entropy(logits, target)
    return total


def _encoded(encoder: torch.nn.Module, images: Tensor) -> Tensor:
    """Features (2, b, c, h / 8, w / 8) of the images of a batch."""
    with autocast():
        return encoder(images.flatten(0, 1)).float().unflatten(0, images.shape[:2])


@torch.inference_mode()
def matching_accuracy(encoder: torch.nn.Module, batches: list[Batch]) -> float:
    """Compute the share (%) of points whose best cell is within 8 pixels of the true match."""
    right = total = 0
    for images, pixels, valid in batches:
        maps = _encoded(encoder, images)
        points = sample_features(maps[0], pixels[0])
        cells = maps[1].flatten(2)
        best = (points @ cells).argmax(-1)
        columns = maps.shape[-1]
        matches = torch.stack([best % columns, best // columns], -1) * 8 + 3.5
        close = (matches - pixels[1]).norm(dim=-1) < 8
        right += int((close & valid).sum())
        total += int(valid.sum())
    return 100.0 * right / max(total, 1)


def train_encoder(
    data: PretrainData,
    options: PretrainOptions,
    folder: Path,
    log: Callable[[str], None],
) -> LocalEncoder:
    """Train the encoder with a checkpoint every 250 steps; resume from a checkpoint in `folder`.

    Returns:
        The trained encoder with separate batch norm (`fuse()` gives the inference form).
    """
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(options.seed)
        encoder = LocalEncoder(TEACHER, fused=False)
    encoder.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    optimiser = torch.optim.AdamW(encoder.parameters(), lr=1e-4, weight_decay=0.02)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, options.peak_rate, total_steps=options.steps, pct_start=0.05
    )
    trained = {"encoder": encoder, "optimiser": optimiser, "schedule": schedule}
    if options.init is not None:
        encoder.load_state_dict(_earlier(Path(options.init)))
    step = _resume(folder / CHECKPOINT, trained, options)
    if step:
        log(f"resumed at step {step}")
    validation = _validation(data, folder)
    # Spawned, because OpenCV's threads do not survive a fork and the worker would hang.
    loader = DataLoader(
        PairStream(data, options, step),
        batch_size=None,
        num_workers=1,
        prefetch_factor=8,
        multiprocessing_context="spawn",
    )
    began = time.perf_counter()
    losses = []
    with started_safely():
        batches = iter(loader)
    for images, pixels, valid in batches:
        maps = _encoded(encoder, images)
        points = torch.stack(list(map(sample_features, maps, pixels)))
        cells = None
        if options.rivals == "cells":
            cells = maps.flatten(3).transpose(2, 3)
        loss = contrastive_loss(points, pixels, valid, options.temperature, cells)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        losses.append(float(loss.detach()))
        step += 1
        if step % CHECKPOINT_STEPS == 0 or step == options.steps:
            matched = _validated(encoder, validation)
            seconds = time.perf_counter() - began
            log(
                f"step {step} loss {np.mean(losses):.3f} matched {matched} {seconds:.0f} s"
            )
            losses.clear()
            _save(folder / CHECKPOINT, trained, step, options)
    return encoder


def _validated(encoder: LocalEncoder, validation: dict[str, list[Batch]]) -> str:
    """Matching accuracy in each kind of held-out rooms."""
    encoder.eval()
    matched = []
    for kind, batches in validation.items():
        matched.append(f"{matching_accuracy(encoder, batches):.1f} % in {kind}")
    encoder.train()
    return ", ".join(matched)


def _resume(path: Path, trained: Mapping[str, Any], options: PretrainOptions) -> int:
    """Load a checkpoint of a run with the same options; return its step, or 0 without one."""
    if not path.is_file():
        return 0
    saved = torch.load(path, weights_only=True)
    if saved["options"] != json.dumps(asdict(options)):
        return 0
    for name, part in trained.items():
        part.load_state_dict(saved[name])
    return saved["step"]


def _save(
    path: Path, trained: Mapping[str, Any], step: int, options: PretrainOptions
) -> None:
    state = {name: part.state_dict() for name, part in trained.items()}
    state |= {"step": step, "options": json.dumps(asdict(options))}
    buffer = io.BytesIO()
    torch.save(state, buffer)
    write_bytes(path, buffer.getvalue())


def _earlier(checkpoint: Path) -> dict[str, Tensor]:
    """Load the encoder's weights from a checkpoint of an earlier run.

    Raises:
        InputError: Not a checkpoint, or of an encoder with another architecture.
    """
    try:
        weights = torch.load(checkpoint, weights_only=True)["encoder"]
        LocalEncoder(TEACHER, fused=False).load_state_dict(weights)
    except Exception as error:
        reason = (str(error).splitlines() or [repr(error)])[0]
        raise InputError(
            f"{checkpoint}: not the {CHECKPOINT} of a run ({reason}); correct --init"
        ) from error
    return weights


def _validation(data: PretrainData, folder: Path) -> dict[str, list[Batch]]:
    """Draw batches from held-out rooms, by kind of room."""
    seeds = range(VALIDATION_ROOM_SEED, VALIDATION_ROOM_SEED + 8)
    kinds = {"box rooms": _held_out([room_views(seed) for seed in seeds])}
    if data.furnished:
        views = [cached_furnished_views(seed, folder) for seed in seeds]
        kinds["furnished rooms"] = _held_out(views)
    return kinds


def _held_out(rooms: Sequence[Views]) -> list[Batch]:
    options = PretrainOptions(room_pairs=8, furnished_pairs=0, leaf_pairs=0)
    stream = PairStream(PretrainData(rooms, []), options, 0)
    return [stream.draw(i) for i in range(6)]
