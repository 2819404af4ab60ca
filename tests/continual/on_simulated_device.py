"""Learning on `tests.simulated_device` gives the same bytes as on the CPU.

Run by `test_simulated_device.py` in a process of its own.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from dataclasses import replace

import pytest
import torch

from evercal.continual.learning import stage_rows
from evercal.continual.learning.learn import learn
from evercal.continual.learning.stage import StageOptions
from evercal.continual.localizer import NetworkLocalizeOptions, NetworkLocalizer
from evercal.continual.networks.head import HeadOptions
from evercal.continual.scenes import LearnedScenes
from evercal.continual.store import Checkpoint, Resume
from evercal.continual.strategies import STRATEGIES
from evercal.features.encoder import load_encoder
from evercal.localization.localizer import Localizer
from evercal.localization.pnp import PnpOptions
from evercal.mapping.build import MapOptions, build_map
from evercal.mapping.memory_budget import MemoryBudget
from evercal.mapping.prepared_frames import WorkingSize
from evercal.mapping.scene_map import MapContents
from evercal.recordings.frame import Recording

from ..simulated_device import OnDevice, register, values
from .stages import EmptyScenes, Rooms, outcome

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


@pytest.fixture
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """A checkpoint in every step."""
    monkeypatch.setattr(stage_rows, "CHECKPOINT_SECONDS", 0.0)


def stopped(events: Iterator[object], steps: int) -> Resume:
    """The checkpoints after some steps."""
    rows, trainers = [], []
    for event in events:
        if isinstance(event, Checkpoint):
            rows += [event.rows] if event.rows else []
            trainers += [event.trainer] if event.trainer else []
            if len(trainers) == steps:
                return Resume(rows, trainers[-1])
    raise AssertionError("the stage ended before it was stopped")


@pytest.mark.usefixtures("often")
@pytest.mark.parametrize(
    ("name", "head"),
    [
        *((name, "code") for name in TRAINED),
        *(("sars_spdd", head) for head in HEADS if head != "code"),
        *(("gem", head) for head in HEADS if head != "code"),
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
        resume = stopped(learn(there, strategy, room, options), 5)
        assert not any(isinstance(v, OnDevice) for v in resume.trainer.values())
        there = outcome(learn(there, strategy, room, options, resume))
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


def test_a_map_is_built_and_locates_as_on_the_cpu(
    gpu: torch.device, arcs: tuple[Recording, Recording]
) -> None:
    options, frame = MapOptions(MemoryBudget(share=0.4), WorkingSize(cells=120)), arcs[0].test[8]
    answers = []
    for device in (torch.device("cpu"), gpu):
        contents = MapContents(load_encoder(), 120)
        contents.to(device)
        built = build_map("one", arcs[0].train, contents.encoder, options)
        contents.scenes.append(replace(built.scene, min_support=0.5))
        answers.append(Localizer(contents).localize(frame.read_image(), frame.camera))
    here, there = (answer.base_from_camera for answer in answers)
    assert here is not None
    assert there is not None
    assert here.matrix().tobytes() == there.matrix().tobytes()
    assert answers[0].inliers == answers[1].inliers
