"""Time of a training step and of its bare matrix products, measured in the same run."""

import time
from collections.abc import Callable
from dataclasses import replace

import torch
from tabulate import tabulate

from evercal.continual.networks.buffer import FeatureBuffer
from evercal.continual.networks.descriptor import load_descriptor
from evercal.continual.networks.head import Head, HeadOptions
from evercal.continual.networks.shampoo import EVERY, inverse_root
from evercal.continual.networks.trainer import FitOptions, HeadTrainer
from evercal.features.device import device_of
from evercal.features.encoder import load_encoder
from evercal.features.precision import fast_bfloat16
from evercal.geometry import SE3

ROWS, VIEWS = 60_000, 100


def run(widths: tuple[int, ...] = (256, 384), batch: int = 2048, repeat: int = 30) -> None:
    """Time a training step and its bare matrix products, in processor time.

    Args:
        widths: Widths of the head.
        batch: Rows of a step.
        repeat: Steps to time.
    """
    rows = []
    for width in widths:
        fit = FitOptions(iterations=10_000, batch=batch)
        trainer = _trainer(HeadOptions(width=width), fit, torch.device("cpu"))
        step = _milliseconds(trainer._train_step, repeat)
        forward_backward, optimiser = _products(trainer.head, batch, repeat)
        share = 100 * (forward_backward + optimiser) / step
        rows.append([width, batch, step, forward_backward, optimiser, f"{share:.0f} %"])
    kind = "bfloat16" if fast_bfloat16() else "float32"
    print(f"{kind}, {torch.get_num_threads()} threads, processor time")
    heads = ["width", "rows", "step ms", "products of the head ms", "of Shampoo ms", "share"]
    print(tabulate(rows, heads, floatfmt=".1f"))


def step_seconds(head: HeadOptions, fit: FitOptions, repeat: int = 2, device: str = "cpu") -> float:
    """Time a training step with random rows, the replayed ones included, in seconds."""
    rows = fit.batch + fit.replay_batch
    trainer = _trainer(head, replace(fit, batch=rows), device_of(device))
    trainer._train_step()
    began = time.perf_counter()
    for _ in range(repeat):
        float(trainer._train_step().costs.mean())
    return (time.perf_counter() - began) / repeat


def _trainer(options: HeadOptions, fit: FitOptions, device: torch.device) -> HeadTrainer:
    encoder, descriptor = load_encoder(), load_descriptor()
    generator = torch.Generator().manual_seed(0)
    buffer = FeatureBuffer(0, SE3.identity(), device=device)
    pose = torch.eye(4)[:3].clone()
    pose[2, 3] = 3.0
    descriptors = torch.randn(VIEWS, descriptor.width, generator=generator)
    buffer.extend(
        {
            "features": torch.randn(ROWS, encoder.width, generator=generator).half(),
            "pixels": 200 * torch.rand(ROWS, 2, generator=generator),
            "view": torch.arange(VIEWS, dtype=torch.int32).repeat_interleave(ROWS // VIEWS),
            "intrinsics": torch.tensor([[200.0, 200.0, 160.0, 120.0]]).repeat(VIEWS, 1),
            "camera_from_atlas": pose.repeat(VIEWS, 1, 1),
            "descriptors": torch.nn.functional.normalize(descriptors, dim=-1),
        }
    )
    head = Head(encoder.width, descriptor.width, options)
    head.grow(torch.zeros(options.centres_per_scene, 3), 0)
    return HeadTrainer(head.to(device), [buffer], fit, 0)


def _products(head: Head, batch: int, repeat: int) -> tuple[float, float]:
    """Return milliseconds of the products of one step: forward and backward, and Shampoo's."""
    kind = torch.bfloat16 if fast_bfloat16() else torch.float32
    width, hidden = head.options.width, head.layers - 1
    x, w = torch.randn(batch, width, dtype=kind), torch.randn(width, width, dtype=kind)
    first, w0 = torch.randn(batch, head.features, dtype=kind), w[: head.features]
    small = torch.randn(hidden, width, width)

    def layers() -> None:
        for inputs, weights in [(first, w0)] * 2 + [(x, w)] * hidden:
            y = torch.mm(inputs, weights)
            torch.mm(inputs.T, y)
            if inputs is x:
                torch.mm(y, weights.T)

    def shampoo() -> None:
        for _ in range(EVERY):
            torch.bmm(small.mT, small)
            torch.bmm(small, small)
        inverse_root(torch.bmm(small.mT, small))

    return _milliseconds(layers, repeat), _milliseconds(shampoo, 3) / EVERY


def _milliseconds(work: Callable[[], object], repeat: int) -> float:
    for _ in range(3):
        work()
    began = time.process_time()
    for _ in range(repeat):
        work()
    return 1000 * (time.process_time() - began) / repeat
