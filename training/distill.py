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
    HEIGHT,
    WIDTH,
    photometric,
    room_seeds,
    room_views,
    seeded_picture,
)

CHECKPOINT_STEPS = 250
"""Optimiser steps between two checkpoints."""
TEMPERATURE = 0.05
"""Temperature of the softmax over similarities."""
COSINE_WEIGHT = 4.0
"""Weight of the cosine loss beside the divergence of the similarities."""
COMPARED = 256
"""Cells of an image whose similarities to all others are compared."""
COUNTS = (4, 2, 2)
"""Images of furnished rooms, of box rooms and of dead leaves in a step."""


class Pictures(NamedTuple):
    """Grey images by kind, each (n, h, w)."""

    furnished: Image
    boxes: Image
    leaves: Image


def pictures(rooms: int, boxes: int, leaves: int, folder: Path) -> Pictures:
    """Render furnished rooms (20 views each, cached in `folder`), box rooms and dead leaves."""
    views = [cached_furnished_views(seed, folder).images for seed in room_seeds(rooms)]
    box_views = [room_views(seed).images for seed in room_seeds(boxes)]
    drawn = [seeded_picture(seed) for seed in room_seeds(leaves)]
    return Pictures(np.concatenate(views), np.concatenate(box_views), np.stack(drawn))


def warped(image: Image, rng: np.random.Generator) -> Image:
    """A random affine view of an image, sometimes mirrored, (HEIGHT, WIDTH)."""
    height, width = image.shape
    scale = np.exp(rng.uniform(np.log(0.55), np.log(1.25)))
    scale *= min(height / HEIGHT, width / WIDTH)
    angle = rng.normal(0, 0.25)
    cosine = scale * np.cos(angle)
    sine = scale * np.sin(angle)
    matrix = np.array([[cosine, -sine], [sine, cosine]])
    matrix *= 1 + rng.uniform(-0.12, 0.12, (2, 2))
    centre = (width, height) * (0.5 + rng.uniform(-0.2, 0.2, 2))
    affine = np.c_[matrix, centre - matrix @ [WIDTH / 2, HEIGHT / 2]]
    flags = cv2.INTER_AREA | cv2.WARP_INVERSE_MAP
    view = cv2.warpAffine(
        image, affine, (WIDTH, HEIGHT), flags=flags, borderMode=cv2.BORDER_REFLECT
    )
    if rng.random() < 0.5:
        view = view[:, ::-1]
    return np.ascontiguousarray(view, np.uint8)


def batches(data: Pictures, first: int, steps: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Pairs (b, 1, h, w) in [0, 1] of unchanged and changed images, the same for every run."""
    for step in range(first, steps):
        rng = np.random.default_rng([1, step])
        drawn = []
        for kind, count in zip(data, COUNTS, strict=True):
            drawn += [warped(rng.choice(kind), rng) for _ in range(count)]
        if rng.random() < 0.3:  # of a camera that is always blurred or dark
            drawn = [photometric(image, rng) for image in drawn]
        changed = list(drawn)
        for i, image in enumerate(drawn):
            if rng.random() < 0.6:
                changed[i] = photometric(image, rng)
        yield _grey(drawn), _grey(changed)


def _grey(images: Sequence[Image]) -> Tensor:
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
        features = torch.einsum("bchw,cd->bdhw", self.module(grey), self.axes)
        return F.normalize(features, dim=1)


def difference(student: Tensor, teacher: Tensor, cells: Tensor) -> Tensor:
    """Loss of features (b, d, h, w): of their cosines, and of the similarities of some cells."""
    student = student.flatten(2)
    teacher = teacher.flatten(2)
    learned = _similarities(student[..., cells], teacher)
    expected = _similarities(teacher[..., cells], teacher)
    divergence = F.kl_div(learned, expected, log_target=True, reduction="none")
    cosine = (student * teacher).sum(1)
    return COSINE_WEIGHT * (1 - cosine).mean() + divergence.sum(-1).mean()


def _similarities(features: Tensor, teacher: Tensor) -> Tensor:
    """Logarithm of the softmax over similarities to all cells of the teacher."""
    logits = torch.einsum("bdn,bdm->bnm", features, teacher)
    return F.log_softmax(logits / TEMPERATURE, -1)


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
    centroids = fit_centroids([cells.reshape(-1, encoder.width) for cells in rows])
    save_tensors(out / "vlad.safetensors", {"centroids": centroids.astype(np.float16)})


if __name__ == "__main__":
    tyro.cli(run, prog="python -m training.distill")
