"""Training of the global descriptor: views of one place attract, views of other rooms repel."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.random import Generator
from torch import Tensor
from torch.nn import functional as F

from evercal.continual.networks.descriptor import GlobalDescriptor
from evercal.continual.networks.precision import autocast
from training.contrastive import PretrainData, PretrainOptions
from training.network import LocalEncoder
from training.pairs import (
    PER_ANCHOR,
    VALIDATION_ROOM_SEED,
    Views,
    photometric,
    room_views,
)

PLACES_PER_BATCH = 64
TEMPERATURE = 0.07


@torch.inference_mode()
def _encode(encoder: LocalEncoder, rooms: Sequence[Views], rng: Generator) -> Tensor:
    """Encode all views with random photometric changes.

    Returns:
        (rooms, anchors, views, width, h, w) features in bfloat16.
    """
    maps = []
    for room in rooms:
        images = np.stack([photometric(image, rng) for image in room.images])
        with autocast():
            maps.append(
                encoder(torch.from_numpy(images[:, None]).float() / 255).bfloat16()
            )
    return torch.stack(maps).unflatten(1, (-1, PER_ANCHOR))


def random_crop(maps: Tensor, rng: Generator) -> Tensor:
    """Crop a random window of the feature grid, to vary the field of view."""
    height, width = maps.shape[-2:]
    h = rng.integers(int(0.7 * height), height + 1)
    w = rng.integers(int(0.7 * width), width + 1)
    top = rng.integers(height - h + 1)
    left = rng.integers(width - w + 1)
    return maps[..., top : top + h, left : left + w]


def place_loss(a: Tensor, b: Tensor, rooms: Tensor) -> Tensor:
    """Compute the symmetric InfoNCE loss, ignoring other places of the same room (n,).

    `a` and `b` (n, width) are descriptors of two views of n places.
    """
    same_room = rooms[:, None] == rooms[None]
    same_room.fill_diagonal_(False)
    logits = (a @ b.T / TEMPERATURE).masked_fill(same_room, -1e4)
    target = torch.arange(len(a))
    return 0.5 * (F.cross_entropy(logits, target) + F.cross_entropy(logits.T, target))


@torch.inference_mode()
def place_accuracy(descriptor: GlobalDescriptor, maps: Tensor) -> float:
    """Compute the share (%) of first views whose nearest other view shows the same room."""
    flat = descriptor(maps.flatten(0, 2).float()).unflatten(0, maps.shape[:3])
    queries = flat[:, :, 0].flatten(0, 1)
    gallery = flat[:, :, 1:].flatten(0, 2)
    per_room = maps.shape[1]
    query_room = torch.arange(len(queries)) // per_room
    gallery_room = torch.arange(len(gallery)) // (per_room * (PER_ANCHOR - 1))
    nearest = (queries @ gallery.T).argmax(-1)
    return 100.0 * float((gallery_room[nearest] == query_room).float().mean())


def train_descriptor(
    data: PretrainData,
    options: PretrainOptions,
    encoder: LocalEncoder,
    log: Callable[[str], None],
) -> GlobalDescriptor:
    """Train the descriptor on features of the frozen encoder."""
    rng = np.random.default_rng([options.seed, 9])
    maps = _encode(encoder, [*data.rooms, *data.furnished], rng)
    held_out = [room_views(VALIDATION_ROOM_SEED + i) for i in range(24)]
    validation = _encode(encoder, held_out, rng)
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(options.seed)
        descriptor = GlobalDescriptor(encoder.width)
    optimiser = torch.optim.AdamW(descriptor.parameters(), lr=1e-3, weight_decay=0.05)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, 3e-3, total_steps=options.descriptor_steps
    )
    rooms, anchors = maps.shape[:2]
    losses = []
    for step in range(1, options.descriptor_steps + 1):
        places = rng.permutation(rooms * anchors)[:PLACES_PER_BATCH]
        room = places // anchors
        anchor = places % anchors
        views = np.argsort(rng.random((len(places), PER_ANCHOR)), axis=1)[:, :2]
        a = descriptor(random_crop(maps[room, anchor, views[:, 0]].float(), rng))
        b = descriptor(random_crop(maps[room, anchor, views[:, 1]].float(), rng))
        loss = place_loss(a, b, torch.from_numpy(room))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        losses.append(float(loss.detach()))
        if step % 250 == 0:
            accuracy = place_accuracy(descriptor, validation)
            log(
                f"descriptor step {step} loss {np.mean(losses):.3f} right room {accuracy:.1f} %"
            )
            losses.clear()
    return descriptor
