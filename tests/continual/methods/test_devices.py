"""Every method creates tensors only on the device of its inputs."""

from __future__ import annotations

import copy
from contextlib import nullcontext
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from evercal.continual.methods.method import FinishedScene, Method, MethodState
from evercal.continual.networks.head import HeadOptions
from evercal.continual.networks.trainer import FitOptions, HeadTrainer
from evercal.continual.selection.frame_statistics import FrameStatistics
from evercal.continual.strategies import STRATEGIES
from evercal.geometry import SE3, Camera
from evercal.recordings.frame import Frame

from ...one_device import tensors_stay_on_their_device
from .by_hand import stage_start, wave_buffer, wave_head

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from torch import Tensor

METHODS = {
    name: strategy.method
    for name, strategy in STRATEGIES.items()
    if strategy.method is not None
}
CAMERA = Camera(4, 3, 4.0, 4.0, 1.5, 1.0)
IMAGE = np.zeros((3, 4, 3), np.uint8)
FIT = FitOptions(iterations=3, batch=64, replay_batch=48)
BACKBONES = {
    "ours": HeadOptions(width=16, blocks=1, whiten=False),
    "paper": HeadOptions(
        16, 1, "descriptor", centres="fixed", whiten=False, activation="relu"
    ),
}


def learned(
    method: Method, options: HeadOptions, context: AbstractContextManager[None]
) -> tuple[dict[str, Tensor], np.ndarray | None]:
    """Learn and finish a second scene; return all resulting tensors and the selected frames."""
    own = wave_buffer(1)
    memory = wave_buffer(0, views=2)
    head = wave_head(2, options)
    teacher = copy.deepcopy(head).eval()
    pose = SE3.identity()
    frames = [Frame(str(i), IMAGE, CAMERA, pose) for i in range(own.views)]
    with context:
        first = FinishedScene(teacher, 0, lambda: memory, lambda: memory, 0.1)
        states: list[MethodState] = [method.after_scene(first)]
        start = stage_start(
            head, [memory], teacher=teacher, states=states, replay_rows=48
        )
        hooks = method.begin(start)
        trainer = HeadTrainer(head, [own], FIT, 0, hooks)
        list(trainer.run())
        chosen = method.select(FrameStatistics(frames, head, lambda: own, 0), 2)
        last = FinishedScene(head, 1, lambda: own, lambda: memory, 0.1)
        selected = method.after_scene(last)
    return dict(head.state_dict()) | {
        f"state.{k}": v for k, v in selected.items()
    }, chosen


@pytest.mark.parametrize("backbone", BACKBONES)
@pytest.mark.parametrize("name", METHODS)
def test_no_tensor_is_created_on_the_default_device(name: str, backbone: str) -> None:
    # With `meta` as the default device and inputs on the CPU, results are the same.
    expected, frames = learned(METHODS[name], BACKBONES[backbone], nullcontext())
    actual, again = learned(
        METHODS[name], BACKBONES[backbone], tensors_stay_on_their_device()
    )
    assert actual.keys() == expected.keys()
    for key, value in actual.items():
        assert value.device.type == "cpu", key
        torch.testing.assert_close(value, expected[key], msg=key)
    assert (frames is None) == (again is None)
    assert frames is None or again is None or frames.tolist() == again.tolist()
