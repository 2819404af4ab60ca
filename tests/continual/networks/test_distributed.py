"""Two processes with half a batch each have the gradients of one process with the whole batch.

They start with the weights of the first, and encode each view once between them.
"""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, distributed
from torch.multiprocessing import spawn  # pyright: ignore[reportPrivateImportUsage]

from evercal.cli.bench import _own_folder
from evercal.continual.networks import buffer as buffer_module
from evercal.continual.networks.buffer import (
    EncodePlan,
    FeatureBuffer,
    Rows,
    encode_batches,
    encode_frames,
)
from evercal.continual.networks.descriptor import GlobalDescriptor
from evercal.continual.networks.distributed import (
    average,
    broadcast,
    gather,
    join_processes,
    of_first,
    processes,
    rank,
    shared_out,
    wait_for_all,
)
from evercal.continual.networks.head import Head, HeadOptions, HeadOutput
from evercal.continual.networks.hooks import ProposedStep, TrainingHooks
from evercal.continual.networks.trainer import FitOptions, HeadTrainer
from evercal.errors import InputError
from evercal.features.encoder import LocalEncoder
from evercal.features.views import ViewOptions
from evercal.geometry import SE3
from evercal.recordings.frame import Frame
from evercal.simulation.box_room import default_camera

OPTIONS = FitOptions(iterations=4, batch=64)
RULES = ("cost", "constraints", "descriptor")
"""Use of remembered rows: as a loss, as constraints, as a loss with descriptor input."""
STOPS = (0, 2)
"""Rounds of encoding before an interruption."""
Made = list[dict[str, dict[str, Tensor]]]


def buffer_of(scene: int) -> FeatureBuffer:
    """Create rows of points in front of two cameras; the features are functions of the points."""
    generator = torch.Generator().manual_seed(scene)
    buffer = FeatureBuffer(scene, SE3.identity(), correctable=True)
    points = torch.randn(200, 3, generator=generator) + torch.tensor([0.0, 0, 4])
    features = torch.cat([points.sin(), points.cos(), points], 1)
    buffer.restore(
        {
            "features": features.half(),
            "pixels": 100 * points[:, :2] / points[:, 2:] + 50,
            "view": torch.arange(2, dtype=torch.int32).repeat_interleave(100),
            "intrinsics": torch.tensor([[100.0, 100, 50, 50]] * 2),
            "camera_from_atlas": torch.eye(4)[None, :3].repeat(2, 1, 1),
            "descriptors": torch.nn.functional.normalize(torch.ones(2, 4), dim=-1),
        }
    )
    return buffer


class ReplayOrConstrain(TrainingHooks):
    """Uses remembered rows as a loss or as constraints, and records the proposed step."""

    def __init__(self, rule: str, memories: list[FeatureBuffer]):
        self.rule, self.memories, self.captured = rule, memories, dict[str, Tensor]()
        self.edits_steps = rule == "constraints"

    def replayed(
        self, fresh: Rows, step: int, rate: float, generator: torch.Generator
    ) -> list[Rows]:
        return [memory.draw(16, generator) for memory in self.memories]

    def cost(self, output: HeadOutput, rows: Rows, tau_px: float) -> Tensor | None:
        if self.rule == "constraints":
            return None
        return (output.points - rows.features[:, 6:].float()).abs().mean()

    def constraints(self, output: HeadOutput, rows: Rows) -> list[Tensor]:
        if self.rule != "constraints":
            return []
        each = len(rows.scene) // 2
        off = (output.points - rows.features[:, 6:].float()).abs().mean(1)
        return [off[:each].mean(), off[each:].mean()]

    def edit_step(self, proposed: ProposedStep) -> None:
        self.captured = {"losses": proposed.losses}
        for i, constraint in enumerate(proposed.constraints):
            self.captured |= {f"{i}.{name}": value.clone() for name, value in constraint.items()}


def gradients(rule: str, steps: int = 1) -> dict[str, Tensor]:
    """Return all gradients after some steps, and the constraints that the hooks received."""
    torch.manual_seed(0)
    torch.set_num_threads(1)
    buffers = [buffer_of(scene) for scene in range(3)]
    condition = "descriptor" if rule == "descriptor" else "code"
    head = Head(9, 4, HeadOptions(width=16, blocks=1, condition=condition, whiten=False))
    for scene in range(3):
        head.grow(torch.randn(2, 3), seed=scene)
    hooks = ReplayOrConstrain(rule, buffers[:2])
    trainer = HeadTrainer(head, buffers[2:], OPTIONS, 1, hooks)
    run = trainer.run()
    for _ in range(steps):
        next(run)
    actual = {name: value.grad for name, value in head.named_parameters()}
    return {name: value for name, value in actual.items() if value is not None} | hooks.captured


def _worker(number: int, folder: str) -> None:
    rendezvous = f"file://{folder}/rendezvous"
    distributed.init_process_group("gloo", init_method=rendezvous, rank=number, world_size=2)
    assert (processes(), rank()) == (2, number)
    context = {f"gradients {rule}": gradients(rule) for rule in RULES}
    context |= {f"encoded {stop}": encoded(stop) for stop in STOPS}
    context |= {"exchanged": exchanged(), "folder": seen_folders(Path(folder), number)}
    torch.save(context, f"{folder}/{number}.pt")
    wait_for_all()
    distributed.destroy_process_group()


def seen_folders(folder: Path, number: int) -> dict[str, Tensor]:
    """Whether a process works in the folder of a benchmark, and refuses one that it cannot see."""
    shared, own = folder / "shared", folder / f"node-{number}"
    if number == 0:
        for out in (shared, own):
            (out / "runs" / "er-0").mkdir(parents=True)
            (out / "runs" / "er-0" / "manifest.json").write_text("{}")
    wait_for_all()
    mine = _own_folder(shared)
    try:
        refused = _own_folder(own) != own
    except InputError as error:
        refused = "sees other files" in str(error)
    found = {
        "in shared": mine == shared,
        "complete": (mine / "runs" / "er-0" / "manifest.json").is_file(),
        "refused": refused,
        "first": of_first(number == 0),
    }
    return {name: torch.tensor(value) for name, value in found.items()}


@pytest.fixture(scope="module")
def by_two(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Results of two processes that train together, started once because that is slow."""
    folder = tmp_path_factory.mktemp("processes")
    os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
    spawn(_worker, (str(folder),), nprocs=2)
    return [torch.load(folder / f"{number}.pt", weights_only=True) for number in range(2)]


@pytest.mark.parametrize("rule", list(RULES))
def test_two_processes_have_the_gradients_of_one(rule: str, by_two: Made) -> None:
    actual = [context[f"gradients {rule}"] for context in by_two]
    alone = gradients(rule)
    assert actual[0].keys() == actual[1].keys() == alone.keys()
    assert ("losses" in alone) == (rule == "constraints")
    for name, value in alone.items():
        assert torch.equal(actual[0][name], actual[1][name]), name
        # Rounding in half precision depends on the batch size.
        size = float(value.abs().max()) + 1e-6
        torch.testing.assert_close(actual[0][name], value, atol=0.02 * size, rtol=0.02)


def exchanged() -> dict[str, Tensor]:
    """Average, broadcast and gather tensors that differ by process."""
    own = rank()
    mean = [torch.arange(6.0).view(2, 3).T * (1 + own), torch.tensor(own, dtype=torch.float32)]
    average(mean)
    layer = torch.nn.Linear(3, 2)
    with torch.no_grad():
        layer.weight.copy_(torch.full((2, 3), 0.1) + own)
        layer.bias.fill_(torch.nan if own == 0 else 1.0)
    steps = torch.tensor([7 + own])
    broadcast([*layer.parameters(), steps])
    assert layer.weight.requires_grad

    part = {"a": torch.full((3 + own, 2), own).half(), "b": torch.tensor([own == 1])}
    both, last = gather(part), gather(part if own else None)
    assert [set(one) for one in both] == [{"a", "b"}] * 2
    assert len(last) == 1
    assert gather(None) == []
    actual = {f"{i}.{name}": value for i, one in enumerate(both) for name, value in one.items()}
    return actual | {
        "mean": mean[0],
        "number": mean[1],
        "weight": layer.weight.detach(),
        "bias": layer.bias.detach(),
        "steps": steps,
        "last": last[0]["a"],
    }


def test_tensors_are_averaged_broadcast_and_gathered_exactly(by_two: Made) -> None:
    for context in by_two:
        actual = context["exchanged"]
        assert torch.equal(actual["mean"], torch.arange(6.0).view(2, 3).T * 1.5)
        assert float(actual["number"]) == 0.5
        assert torch.equal(actual["weight"], torch.full((2, 3), 0.1))
        assert actual["bias"].isnan().all()
        assert actual["steps"].tolist() == [7]
        for number, count in enumerate((3, 4)):
            expected = torch.full((count, 2), number, dtype=torch.half)
            assert actual[f"{number}.a"].dtype == torch.half
            assert torch.equal(actual[f"{number}.a"], expected)
            assert actual[f"{number}.b"].tolist() == [number == 1]
        assert torch.equal(actual["last"], torch.ones(4, 2).half())


def test_processes_run_what_the_first_runs(by_two: Made) -> None:
    for number, context in enumerate(by_two):
        folder = context["folder"]
        assert bool(folder["in shared"]) == (number == 0), "a copy keeps results apart"
        assert folder["complete"]
        assert bool(folder["refused"]) == (number == 1)
        assert folder["first"]


def frames_of(sizes: Sequence[tuple[int, int]]) -> list[Frame]:
    """Create frames of noise with cameras of given sizes."""
    rng, frames = np.random.default_rng(0), []
    for i, (width, height) in enumerate(sizes):
        image = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
        pose = SE3.exp(rng.normal(0, 0.3, 6))
        frames.append(Frame(f"{i}", image, default_camera(width, height), pose))
    return frames


def encoded(stop: int = 0) -> dict[str, Tensor]:
    """Fill a buffer with nine frames of two sizes, and count the views encoded by this process.

    Args:
        stop: Number of rounds after which the rows move to another buffer, as after a resume.
    """
    torch.set_num_threads(1)
    torch.manual_seed(0)
    encoder = LocalEncoder(stem=(4, 4), inner=8, blocks=1, width=8).eval()
    descriptor = GlobalDescriptor(8, maps=2, hidden=4, width=8).eval()
    frames = frames_of([(64, 48)] * 5 + [(48, 64)] * 4)
    plan = EncodePlan(views_per_frame=3, cells=20, view=ViewOptions(short_side=48))
    buffer, rounds, captured = FeatureBuffer(2, SE3.exp([1.0, 2, 0, 0, 0, 1])), 0, 0

    def counting(grey: Tensor) -> Tensor:
        nonlocal captured
        captured += len(grey)
        return LocalEncoder.forward(encoder, grey)

    encoder.forward = counting
    buffer_module.ENCODE_BATCH = 2
    for rounds, done in enumerate(encode_frames(buffer, frames, plan, encoder, descriptor), 1):
        assert done == buffer.views
        if rounds == stop:
            selected, buffer = buffer.take_new(), FeatureBuffer(2, buffer.atlas_from_base)
            buffer.restore(selected)
            break
    for _ in encode_frames(buffer, frames, plan, encoder, descriptor):
        pass
    buffer_module.ENCODE_BATCH = 8
    assert buffer.views == 27
    return dict(buffer.tensors) | {"encoded": torch.tensor(captured)}


@pytest.mark.parametrize("stop", STOPS)
def test_two_processes_share_the_encoding(stop: int, by_two: Made) -> None:
    alone = encoded()
    actual = [dict(context[f"encoded {stop}"]) for context in by_two]
    assert sum(int(one["encoded"]) for one in actual) == int(alone.pop("encoded")) == 27
    for one in actual:
        assert 27 * 0.35 < int(one.pop("encoded")) < 27 * 0.65
        assert one.keys() == alone.keys()
        for name, value in alone.items():
            assert value.dtype == one[name].dtype
            assert torch.equal(one[name], value), name


@given(st.lists(st.integers(), max_size=20), st.integers(1, 5))
def test_work_is_divided_once_and_in_order(work: list[int], count: int) -> None:
    shares = [shared_out(work, number, count) for number in range(count)]
    assert len({len(share) for share in shares}) == 1  # equal numbers of exchanges
    in_turn = [
        piece for rotation in zip(*shares, strict=True) for piece in rotation if piece is not None
    ]
    assert in_turn == work


@given(st.lists(st.booleans(), min_size=1, max_size=12), st.integers(1, 3), st.integers(0, 40))
def test_batches_contain_consecutive_views_of_one_size(
    sizes: list[bool], passes: int, done: int
) -> None:
    frames = frames_of([(24, 16) if size else (16, 16) for size in sizes])
    total = passes * len(frames)
    batches = encode_batches(frames, EncodePlan(views_per_frame=passes), done)
    assert [number for batch in batches for number in batch] == list(range(done, total))
    kinds = [{sizes[number % len(sizes)] for number in batch} for batch in batches]
    assert all(len(kind) == 1 for kind in kinds)
    for i, batch in enumerate(batches):
        assert len(batch) <= buffer_module.ENCODE_BATCH
        full = len(batch) == buffer_module.ENCODE_BATCH
        assert full or i + 1 == len(batches) or kinds[i] != kinds[i + 1]


def test_without_torchrun_there_is_one_process() -> None:
    assert join_processes("cpu") == torch.device("cpu")
    assert processes() == 1
    with pytest.raises(InputError, match="use auto, cpu or cuda"):
        join_processes("gpu")


def test_each_process_of_a_machine_has_its_own_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Calls to torch on a simulated machine with two GPUs."""
    calls: list[object] = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(torch.cuda, "set_device", calls.append)
    monkeypatch.setattr(distributed, "is_torchelastic_launched", lambda: True)
    monkeypatch.setattr(
        distributed, "init_process_group", lambda kind, device_id=None: calls.append(kind)
    )
    monkeypatch.setenv("LOCAL_RANK", "1")
    assert join_processes() == torch.device("cuda", 1)
    assert calls == [torch.device("cuda", 1), "nccl"]
    assert join_processes("cpu") == torch.device("cpu")
    assert calls[2:] == ["gloo"]
    monkeypatch.setenv("LOCAL_RANK", "2")
    with pytest.raises(InputError, match="--nproc-per-node 2"):
        join_processes("cuda")
