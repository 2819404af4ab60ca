"""A store of networks opens as it was written."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from evercal.continual.networks.descriptor import described
from evercal.continual.networks.head import Head
from evercal.continual.scenes import LearnedScenes
from evercal.continual.store import NetworkStore, head_bytes
from evercal.errors import InputError
from evercal.storage import verify

from ..stages import MakeStore, Tree

Stages = dict[str, list[LearnedScenes]]

GREY = np.random.default_rng(0).integers(0, 256, (48, 64)).astype(np.uint8)
STRATEGIES = pytest.mark.parametrize("strategy", ["sars_pixels", "isolation"])


def stored(head: Head) -> dict[str, Tensor]:
    """State of a head with the precision of the file: half, except for its centres."""
    return {
        name: value
        if name == "centres" or not value.is_floating_point()
        else value.half().float()
        for name, value in head.state_dict().items()
    }


@STRATEGIES
def test_store_opens_as_it_was_written(
    strategy: str, three_stages: Stages, tmp_path: Path, make_store: MakeStore
) -> None:
    store = make_store(tmp_path, three_stages[strategy])
    scenes = three_stages[strategy][-1]
    reopened = NetworkStore.open(tmp_path)
    assert reopened.stages == store.stages
    assert [report["seconds"] for report in reopened.reports()] == [1.5] * 3
    contents = reopened.contents
    assert (contents.strategy, contents.short_side) == (
        scenes.strategy,
        scenes.short_side,
    )
    for a, b in zip(contents.heads, scenes.heads, strict=True):
        assert a.options == b.options
        assert not a.training
        state = stored(b)
        assert a.state_dict().keys() == state.keys()
        assert all(
            torch.equal(value, state[name]) for name, value in a.state_dict().items()
        )
    for a, b in zip(contents.scenes, scenes.scenes, strict=True):
        assert torch.equal(a.prototypes, b.prototypes)
        others = [f.name for f in fields(a) if f.name != "prototypes"]
        assert [getattr(a, name) for name in others] == [
            getattr(b, name) for name in others
        ]
    for a, b in zip(contents.keyframes, scenes.keyframes, strict=True):
        assert (a is None) == (b is None)
        if a is not None and b is not None:
            one = a.to_tensors()
            two = b.to_tensors()
            assert one.keys() == two.keys()
            for name, value in one.items():
                torch.testing.assert_close(value, two[name], rtol=0, atol=1e-15)
    features = scenes.encoder(GREY)
    np.testing.assert_allclose(contents.encoder(GREY), features, atol=1e-6)
    again = (
        described(features, contents.descriptor),
        described(features, scenes.descriptor),
    )
    torch.testing.assert_close(*again, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("strategy", "heads"), [("sars_pixels", [3]), ("isolation", [1, 2, 3])]
)
def test_of_a_shared_head_only_the_newest_file_remains(
    strategy: str,
    heads: list[int],
    three_stages: Stages,
    tmp_path: Path,
    make_store: MakeStore,
) -> None:
    store = make_store(tmp_path, three_stages[strategy])
    files = sorted(tmp_path.rglob("head.safetensors"))
    assert [path.parent.name[:4] for path in files] == [
        f"{number:04d}" for number in heads
    ]
    counted = head_bytes(store.contents.heads[-1])
    # The file adds its header.
    assert counted < files[-1].stat().st_size < counted + 3000
    assert verify(tmp_path) == []


def test_other_folders_are_refused(tmp_path: Path, tree: Tree) -> None:
    (tmp_path / "mixed" / "stages").mkdir(parents=True)
    for file in (tmp_path / "file", tmp_path / "mixed" / "thesis.tex"):
        file.write_text("x")
    before = tree(tmp_path)
    for name in ("file", "mixed", ""):
        with pytest.raises(InputError, match=str(tmp_path / name)):
            NetworkStore.open(tmp_path / name)
        with pytest.raises(InputError, match="not an evercal store"):
            NetworkStore.create(tmp_path / name, "sars_pixels")
    NetworkStore.create(tmp_path / "new", "sars_pixels")
    assert tree(tmp_path) == before
    assert not (tmp_path / "new").exists()
