"""`python -m training.distill`: the shipped encoder, distilled from the teacher.

The student sees a changed image (exposure, blur, noise), the teacher the unchanged one. The student
learns the teacher's features, projected to their principal axes, and how similar these are to each
other within an image (Park et al., Relational Knowledge Distillation, CVPR 2019).
"""

import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
import tyro
from torch import Tensor, nn
from torch.nn import functional as F

from evercal.features.encoder import WEIGHTS, load_encoder
from evercal.features.vlad import fit_centroids
from evercal.storage.atomic import write_bytes
from evercal.storage.tensors import save_tensors
from evercal.typing import Image
from training.furnished import cached_furnished_views
from training.network import SHIPPED, TEACHER, LocalEncoder, from_onnx, onnx_bytes
from training.pairs import (
    FIRST_ROOM_SEED,
    HEIGHT,
    WIDTH,
    leaf_picture,
    photometric,
    room_views,
)

CHECKPOINT_STEPS = 250
TEMPERATURE, COSINE_WEIGHT = 0.05, 4.0
"""Of the softmax over similarities, and weight of the cosine beside their divergence."""
COMPARED = 256
"""Cells of an image whose similarities to all others are compared."""
FURNISHED, BOXES, LEAVES = 4, 2, 2
"""Images of each kind in a step."""

Images = Image


class Pictures(NamedTuple):
    """Grey images by kind, each (n, h, w)."""

    furnished: Images
    boxes: Images
    leaves: Images


def pictures(rooms: int, boxes: int, leaves: int, folder: Path) -> Pictures:
    """Render furnished rooms (20 views each, cached in `folder`), box rooms and dead leaves."""
    seeds = range(FIRST_ROOM_SEED, FIRST_ROOM_SEED + max(rooms, boxes, leaves))
    views = [cached_furnished_views(seed, folder).images for seed in seeds[:rooms]]
    return Pictures(
        np.concatenate(views),
        np.concatenate([room_views(seed).images for seed in seeds[:boxes]]),
        np.stack(
            [leaf_picture(np.random.default_rng([seed, 3])) for seed in seeds[:leaves]]
        ),
    )


def warped(image: Images, rng: np.random.Generator) -> Images:
    """A random affine view of an image, sometimes mirrored, (HEIGHT, WIDTH)."""
    height, width = image.shape
    scale = np.exp(rng.uniform(np.log(0.55), np.log(1.25))) * min(
        height / HEIGHT, width / WIDTH
    )
    angle = rng.normal(0, 0.25)
    cosine = scale * np.cos(angle)
    sine = scale * np.sin(angle)
    matrix = np.array([[cosine, -sine], [sine, cosine]]) * (
        1 + rng.uniform(-0.12, 0.12, (2, 2))
    )
    centre = np.array([width, height]) * (0.5 + rng.uniform(-0.2, 0.2, 2))
    affine = np.c_[matrix, centre - matrix @ [WIDTH / 2, HEIGHT / 2]]
    flags = cv2.INTER_AREA | cv2.WARP_INVERSE_MAP
    view = cv2.warpAffine(
        image, affine, (WIDTH, HEIGHT), flags=flags, borderMode=cv2.BORDER_REFLECT
    )
    return np.ascontiguousarray(view[:, ::-1] if rng.random() < 0.5 else view, np.uint8)


def batches(data: Pictures, first: int, steps: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Pairs (b, 1, h, w) in [0, 1] of unchanged and changed images, the same for every run."""
    for step in range(first, steps):
        rng = np.random.default_rng([1, step])
        drawn = [
            warped(kind[rng.integers(len(kind))], rng)
            for kind, count in zip(data, (FURNISHED, BOXES, LEAVES), strict=True)
            for _ in range(count)
        ]
        if rng.random() < 0.3:  # of a camera that is always blurred or dark
            drawn = [photometric(image, rng) for image in drawn]
        changed = [
            photometric(image, rng) if rng.random() < 0.6 else image for image in drawn
        ]
        yield _grey(drawn), _grey(changed)


def _grey(images: Sequence[Images]) -> Tensor:
    return torch.from_numpy(np.stack(images))[:, None].float() / 255


class Teacher(NamedTuple):
    """The teacher's features on their principal axes."""

    module: LocalEncoder
    axes: Tensor
    """(channels, width)."""

    @classmethod
    def of(cls, data: Pictures, width: int) -> "Teacher":
        """Principal axes from a tenth of the images of rooms."""
        module = from_onnx(WEIGHTS / "encoder-1.onnx", TEACHER)
        second = torch.zeros(TEACHER.width, TEACHER.width, dtype=torch.float64)
        with torch.inference_mode():
            for image in np.concatenate([data.furnished[::10], data.boxes[::20]]):
                rows = module(_grey([image])).flatten(2)[0].T.double()
                second += rows.T @ rows
        return cls(module, torch.linalg.eigh(second)[1][:, -width:].flip(1).float())

    @torch.no_grad()
    def __call__(self, grey: Tensor) -> Tensor:
        """(b, 1, h, w) -> (b, width, rows, columns) unit vectors."""
        return F.normalize(
            torch.einsum("bchw,cd->bdhw", self.module(grey), self.axes), dim=1
        )


def difference(student: Tensor, teacher: Tensor, cells: Tensor) -> Tensor:
    """Loss of features (b, d, h, w): of their cosines, and of the similarities of some cells."""
    own = student.flatten(2)
    target = teacher.flatten(2)
    logits = [
        torch.einsum("bdn,bdm->bnm", x[:, :, cells], target) for x in (own, target)
    ]
    found, wanted = (F.log_softmax(x / TEMPERATURE, -1) for x in logits)
    divergence = (
        F.kl_div(found, wanted, log_target=True, reduction="none").sum(-1).mean()
    )
    return COSINE_WEIGHT * (1 - (own * target).sum(1)).mean() + divergence


def distil(data: Pictures, steps: int, folder: Path) -> LocalEncoder:
    """Train the student; a checkpoint in `folder` every 250 steps is resumed."""
    torch.manual_seed(1)
    student = LocalEncoder(SHIPPED, fused=False)
    teacher = Teacher.of(data, SHIPPED.width)
    optimiser = torch.optim.AdamW(student.parameters(), 1e-4, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, 3e-3, total_steps=steps, pct_start=0.05
    )
    parts = (student, optimiser, schedule)
    file = folder / "student.pt"
    first = 0
    if file.is_file():
        first, *states = torch.load(file, weights_only=True)
        for part, state in zip(parts, states, strict=True):
            part.load_state_dict(state)
    began = time.perf_counter()
    losses = []
    for step, (grey, changed) in enumerate(batches(data, first, steps), first + 1):
        cells = torch.randperm(HEIGHT * WIDTH // student.stride**2)[:COMPARED]
        loss = difference(student(changed), teacher(grey), cells)
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(student.parameters(), 5.0)
        optimiser.step()
        schedule.step()
        losses.append(float(loss.detach()))
        if step % CHECKPOINT_STEPS == 0 or step == steps:
            torch.save((step, *(part.state_dict() for part in parts)), file)
            seconds = time.perf_counter() - began
            print(
                f"step {step} loss {np.mean(losses):.3f} {seconds:.0f} s",
                file=sys.stderr,
            )
            losses.clear()
    return student.fuse()


def run(
    out: Path, steps: int = 11_000, rooms: int = 14, boxes: int = 100, leaves: int = 200
) -> None:
    """Distil the shipped encoder (hours); the same command resumes.

    Args:
        out: Folder of `encoder.onnx`, `vlad.safetensors`, rendered rooms and checkpoints.
        steps: Optimiser steps.
        rooms: Furnished rooms.
        boxes: Box rooms.
        leaves: Dead-leaves pictures.
    """
    out.mkdir(parents=True, exist_ok=True)
    data = pictures(rooms, boxes, leaves, out)
    write_bytes(out / "encoder.onnx", onnx_bytes(distil(data, steps, out)))
    encoder = load_encoder(out / "encoder.onnx")
    rows = [encoder(image) for image in (*data.furnished[::5], *data.boxes[::20])]
    centroids = fit_centroids([each.reshape(-1, encoder.width) for each in rows])
    save_tensors(out / "vlad.safetensors", {"centroids": centroids.astype(np.float16)})


if __name__ == "__main__":
    tyro.cli(run, prog="python -m training.distill")
