"""Contrastive training of the local encoder on procedural pairs, resumable and seeded."""

import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F
from torch.utils.data import DataLoader, IterableDataset

from evercal.continual.pretraining.furnished import FurnishedViews, kept_furnished_views
from evercal.continual.pretraining.pairs import (
    FIRST_ROOM_SEED,
    HEIGHT,
    PER_ANCHOR,
    VALIDATION_ROOM_SEED,
    WIDTH,
    Pair,
    RoomViews,
    Views,
    cell_pixels,
    homography_pair,
    leaf_picture,
    photometric,
    room_views,
    view_pair,
)
from evercal.errors import InputError
from evercal.features.encoder import LocalEncoder
from evercal.features.precision import autocast
from evercal.simulation.furnished.renderer import mitsuba
from evercal.storage.atomic import write_bytes

CHECKPOINT_STEPS = 250
NEAR_PX = 10.0


@dataclass(frozen=True)
class PretrainOptions:
    """What makes the weights; `pretrain.log` beside the shipped ones tells theirs."""

    steps: int = 9_000
    """Optimiser steps of the local encoder."""
    rooms: int = 160
    """Box rooms, each seen from 20 cameras."""
    furnished: int = 120
    """Furnished rooms (extra `sim`), each seen from 20 cameras."""
    pictures: int = 300
    """Dead-leaves pictures for homography pairs."""
    room_pairs: int = 1
    """Pairs of box rooms in a step."""
    furnished_pairs: int = 3
    """Pairs of furnished rooms in a step."""
    leaf_pairs: int = 2
    """Homography pairs in a step."""
    points: int = 192
    """Corresponding points drawn from a pair."""
    rivals: Literal["points", "cells"] = "cells"
    """What a point is told apart from: the other points, or every cell of its other image, too."""
    temperature: float = 0.07
    """Of the softmax over cosine similarities."""
    peak_rate: float = 2e-3
    """Peak of the one-cycle learning rate."""
    descriptor_steps: int = 2_000
    """Optimiser steps of the global descriptor."""
    seed: int = 1
    """Random seed."""
    init: str | None = None
    """Checkpoint `encoder.pt` of an earlier run to start from; random weights when left out."""


@dataclass(frozen=True)
class PretrainData:
    """All rendered input, made once from seeds."""

    rooms: list[RoomViews]
    pictures: list[np.ndarray]
    furnished: list[FurnishedViews] = field(default_factory=list)


def _picture(seed: int) -> np.ndarray:
    return leaf_picture(np.random.default_rng([seed, 3]))


def make_data(options: PretrainOptions, folder: Path) -> PretrainData:
    """Draws box rooms and pictures with one process per core, and renders furnished rooms.

    The latter take about ten seconds each and are kept in `folder`.

    Raises:
        InputError: Pairs of furnished rooms without any, more rooms of a kind than there are seeds,
            or the extra `sim` is missing.
    """
    if options.furnished_pairs and not options.furnished:
        raise InputError("pairs of furnished rooms need --furnished rooms, at least 1")
    most = VALIDATION_ROOM_SEED - FIRST_ROOM_SEED
    if max(options.furnished, options.rooms) > most:
        raise InputError(
            f"rooms {options.rooms}, furnished {options.furnished}: at most {most} of a kind, "
            "later seeds are held out"
        )
    if options.furnished:
        mitsuba()  # rather now than after minutes
    with get_context("spawn").Pool() as pool:
        seeds = range(FIRST_ROOM_SEED, FIRST_ROOM_SEED + options.rooms)
        rooms = pool.map(room_views, seeds, chunksize=4)
        seeds = range(FIRST_ROOM_SEED, FIRST_ROOM_SEED + options.pictures)
        pictures = pool.map(_picture, seeds, chunksize=8)
    seeds = range(FIRST_ROOM_SEED, FIRST_ROOM_SEED + options.furnished)
    return PretrainData(rooms, pictures, [kept_furnished_views(seed, folder) for seed in seeds])


class PairStream(IterableDataset):
    """An endless, seeded stream of training batches that can start at any step."""

    def __init__(self, data: PretrainData, options: PretrainOptions, first_step: int):
        self.data, self.options, self.first_step = data, options, first_step

    def draw(self, step: int) -> tuple[Tensor, Tensor, Tensor]:
        """Batch `step`: images (2, b, 1, h, w), pixels (2, b, points, 2), valid (b, points)."""
        o = self.options
        rng = np.random.default_rng([o.seed, step])
        pairs: list[Pair] = []
        for count, draw in (
            (o.room_pairs, lambda: self._parallax(self.data.rooms, rng)),
            (o.furnished_pairs, lambda: self._parallax(self.data.furnished, rng)),
            (o.leaf_pairs, lambda: self._homography(rng)),
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
        return grey, torch.from_numpy(pixels), torch.from_numpy(valid)

    def _parallax(self, rooms: Sequence[Views], rng: np.random.Generator) -> Pair:
        """Two views of one part of one room."""
        views = rooms[int(rng.integers(len(rooms)))]
        anchor = PER_ANCHOR * rng.integers(len(views.images) // PER_ANCHOR)
        first, second = anchor + rng.choice(PER_ANCHOR, 2, replace=False)
        return view_pair(views, int(first), int(second), rng)

    def _homography(self, rng: np.random.Generator) -> Pair:
        picture = self.data.pictures[rng.integers(len(self.data.pictures))]
        return homography_pair(picture, rng)

    def __iter__(self) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        import cv2

        cv2.setNumThreads(1)
        for step in range(self.first_step, self.options.steps):
            yield self.draw(step)


def sample_features(features: Tensor, pixels: Tensor) -> Tensor:
    """Bilinear features (b, c, h, w) at pixels (b, n, 2) of the image, unit length (b, n, c)."""
    size = torch.tensor([WIDTH, HEIGHT], dtype=pixels.dtype)
    grid = 2 * (pixels + 0.5) / size - 1
    found = F.grid_sample(features, grid[:, None], align_corners=False, padding_mode="border")
    return F.normalize(found[:, :, 0].transpose(1, 2), dim=-1)


def contrastive_loss(
    points: Tensor, pixels: Tensor, valid: Tensor, temperature: float, cells: Tensor | None = None
) -> Tensor:
    """Symmetric InfoNCE (van den Oord et al., 2018) over every point of the batch.

    A point's rivals are all points of the batch in the other images and, where `cells` are given,
    all cells of its own other image: what looks alike within one image (books, tiles, handles)
    must be told apart, too. Rivals nearer than 10 pixels to the truth are not held against it.

    Args:
        points: (2, p, n, c) unit features of the points in the first and in the second images.
        pixels: (2, p, n, 2) where they lie there.
        valid: (p, n) bool.
        temperature: of the softmax.
        cells: (2, p, m, c) unit features of the images' cells, in the order of `cell_pixels`.
    """
    keep = valid.flatten()
    image = torch.arange(len(valid)).repeat_interleave(valid.shape[1])[keep]
    target = torch.arange(len(image))
    total = points.new_zeros(())
    for one, other in ((0, 1), (1, 0)):
        x, y = points[one].flatten(0, 1)[keep], points[other].flatten(0, 1)[keep]
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


@torch.inference_mode()
def matching_accuracy(
    encoder: torch.nn.Module, batches: list[tuple[Tensor, Tensor, Tensor]]
) -> float:
    """Share (%) of points whose best cell in the other image lies within 8 pixels of the truth."""
    right = total = 0
    for images, pixels, valid in batches:
        with autocast():
            maps = encoder(images.flatten(0, 1)).float().unflatten(0, images.shape[:2])
        points = sample_features(maps[0], pixels[0])
        cells = maps[1].flatten(2)
        best = (points @ cells).argmax(-1)
        columns = maps.shape[-1]
        found = torch.stack([best % columns, best // columns], -1) * 8 + 3.5
        close = (found - pixels[1]).norm(dim=-1) < 8
        right += int((close & valid).sum())
        total += int(valid.sum())
    return 100.0 * right / max(total, 1)


def train_encoder(
    data: PretrainData, options: PretrainOptions, folder: Path, say: Callable[[str], None]
) -> LocalEncoder:
    """Trains, checkpointing every 250 steps to `folder`; picks up a checkpoint it finds there.

    Returns:
        The trained encoder with batch norm still separate (`fuse()` gives the inference form).
    """
    torch.manual_seed(options.seed)
    encoder = LocalEncoder(fused=False)
    encoder.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    optimiser = torch.optim.AdamW(encoder.parameters(), lr=1e-4, weight_decay=0.02)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, options.peak_rate, total_steps=options.steps, pct_start=0.05
    )
    checkpoint, step = folder / "encoder.pt", 0
    if options.init is not None:
        encoder.load_state_dict(_earlier(Path(options.init)))
    if checkpoint.is_file():
        saved = torch.load(checkpoint, weights_only=True)
        if saved["options"] == json.dumps(asdict(options)):
            encoder.load_state_dict(saved["encoder"])
            optimiser.load_state_dict(saved["optimiser"])
            schedule.load_state_dict(saved["schedule"])
            step = saved["step"]
            say(f"resumed at step {step}")
    validation = _validation(data, folder)
    # Spawned, not forked: OpenCV's threads do not survive a fork, and the worker would hang.
    loader = DataLoader(
        PairStream(data, options, step),
        batch_size=None,
        num_workers=1,
        prefetch_factor=8,
        multiprocessing_context="spawn",
    )
    began, losses = time.perf_counter(), []
    for images, pixels, valid in loader:
        with autocast():
            maps = encoder(images.flatten(0, 1)).float().unflatten(0, images.shape[:2])
        points = torch.stack([sample_features(*of) for of in zip(maps, pixels, strict=True)])
        cells = maps.flatten(3).transpose(2, 3) if options.rivals == "cells" else None
        loss = contrastive_loss(points, pixels, valid, options.temperature, cells)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        losses.append(float(loss.detach()))
        step += 1
        if step % CHECKPOINT_STEPS == 0 or step == options.steps:
            encoder.eval()
            matched = ", ".join(
                f"{matching_accuracy(encoder, batches):.1f} % in {kind}"
                for kind, batches in validation.items()
            )
            encoder.train()
            seconds = time.perf_counter() - began
            say(f"step {step} loss {np.mean(losses):.3f} matched {matched} {seconds:.0f} s")
            losses.clear()
            _save(checkpoint, encoder, optimiser, schedule, step, options)
    return encoder


def _earlier(checkpoint: Path) -> dict[str, Tensor]:
    """Weights of an earlier run.

    Raises:
        InputError: no checkpoint of ours, or of an encoder with another layout.
    """
    try:
        found = torch.load(checkpoint, weights_only=True)["encoder"]
        LocalEncoder(fused=False).load_state_dict(found)
    except Exception as error:
        reason = (str(error).splitlines() or [repr(error)])[0]
        raise InputError(f"--init {checkpoint}: not the encoder.pt of a run ({reason})") from error
    return found


def _validation(data: PretrainData, folder: Path) -> dict[str, list[tuple[Tensor, Tensor, Tensor]]]:
    """Batches of rooms that training never sees, by kind of room."""
    rooms = [room_views(VALIDATION_ROOM_SEED + i) for i in range(8)]
    options = PretrainOptions(room_pairs=8, furnished_pairs=0, leaf_pairs=0)
    judge = PairStream(PretrainData(rooms, []), options, 0)
    batches = {"box rooms": [judge.draw(i) for i in range(6)]}
    if data.furnished:
        cells = [kept_furnished_views(VALIDATION_ROOM_SEED + i, folder) for i in range(8)]
        options = PretrainOptions(room_pairs=0, furnished_pairs=8, leaf_pairs=0)
        judge = PairStream(PretrainData([], [], cells), options, 0)
        batches["furnished rooms"] = [judge.draw(i) for i in range(6)]
    return batches


def _save(
    path: Path,
    encoder: LocalEncoder,
    optimiser: torch.optim.Optimizer,
    schedule: torch.optim.lr_scheduler.LRScheduler,
    step: int,
    options: PretrainOptions,
) -> None:
    import io

    buffer = io.BytesIO()
    state = {
        "encoder": encoder.state_dict(),
        "optimiser": optimiser.state_dict(),
        "schedule": schedule.state_dict(),
        "step": step,
        "options": json.dumps(asdict(options)),
    }
    torch.save(state, buffer)
    write_bytes(path, buffer.getvalue())
