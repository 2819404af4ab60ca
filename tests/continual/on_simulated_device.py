"""Learning on `tests.simulated_device` gives the same bytes as on the CPU.

Run by `test_simulated_device.py` in a process of its own.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace

import pytest
import torch

from evercal.continual.learning.stage import StageOptions
from evercal.continual.localizer import NetworkLocalizeOptions, NetworkLocalizer
from evercal.continual.networks.head import HeadOptions
from evercal.continual.scenes import LearnedScenes
from evercal.continual.strategies import STRATEGIES
from evercal.localization.pnp import PnpOptions

from ..simulated_device import OnDevice, register, values
from .stages import EmptyScenes, Rooms, learn, outcome

HEADS = {
    "code": HeadOptions(width=16, centres_per_scene=3),
    "descriptor": HeadOptions(width=16, centres_per_scene=3, condition="descriptor"),
    "shared": HeadOptions(width=16, centres_per_scene=3, offsets="shared", activation="relu"),
}
TRAINED = [name for name, s in STRATEGIES.items() if s.method is not None and not s.jointly]


@pytest.fixture(scope="session")
def gpu() -> torch.device:
    return register()


def same(there: Mapping[str, torch.Tensor], here: Mapping[str, torch.Tensor]) -> None:
    """Assert that the numbers on the device are those on the CPU, bit for bit."""
    assert there.keys() == here.keys()
    for name, value in here.items():
        other = there[name]
        assert torch.equal(values(other) if isinstance(other, OnDevice) else other, value), name


def moved(scenes: LearnedScenes, device: torch.device) -> LearnedScenes:
    """A copy on a device."""
    copied = copy.deepcopy(scenes)
    copied.to(device)
    return copied


def test_tensors_of_two_devices_are_refused(gpu: torch.device) -> None:
    here, there = torch.ones(2, 3), torch.ones(2, 3, device=gpu)
    for wrong in (
        lambda: here + there,
        lambda: here @ there.T,
        lambda: torch.cat([here, there]),
        lambda: there.lerp_(here, 0.5),
        lambda: torch.where(there > 0, here, there),
        there.numpy,
    ):
        with pytest.raises((RuntimeError, TypeError)):
            wrong()
    there[1:, 0] += here[0, 0]  # a scalar
    assert there.cpu().tolist() == [[1, 1, 1], [2, 1, 1]]
    assert torch.equal((there.requires_grad_() * 2).sum().cpu(), torch.tensor(14.0))


@pytest.mark.parametrize(
    ("name", "head"),
    [
        *((name, "code") for name in TRAINED),
        *(("sars_spdd", head) for head in HEADS if head != "code"),
        *(("gec", head) for head in HEADS if head != "code"),
    ],
)
def test_learning_and_localizing_equal_the_cpu(
    name: str,
    head: str,
    gpu: torch.device,
    empty_scenes: EmptyScenes,
    rooms: Rooms,
    quick: StageOptions,
) -> None:
    options, strategy = replace(quick, head=HEADS[head]), STRATEGIES[name]
    here, there = empty_scenes(name), moved(empty_scenes(name), gpu)
    for room in rooms[:2]:
        here = outcome(learn(here, strategy, room, options))
        there = outcome(learn(there, strategy, room, options))
        same(there.heads[-1].state_dict(), here.heads[-1].state_dict())
        same(there.method_states[-1], here.method_states[-1])
    frame = rooms[1].train[3]
    options = NetworkLocalizeOptions(pnp=PnpOptions(threshold_px=20.0))
    answers = [
        NetworkLocalizer(scenes, options).localize(frame.read_image(), frame.camera)
        for scenes in (here, there)
    ]
    assert answers[0].status == answers[1].status
    assert answers[0].inliers == answers[1].inliers
