"""`evercal.learn` is `evercal learn` in Python: same defaults, same refusals."""

import inspect
from pathlib import Path
from typing import Any

import pytest
from evercal.continual.learn_into_store import learn

import evercal
from evercal.cli.learn import Learn
from evercal.continual import learn_into_store
from evercal.continual.learn_scene import LearnOptions
from evercal.continual.presets import preset
from evercal.errors import InputError
from evercal.recordings import Recording, generic
from evercal.storage import write_manifest

from ..box_world import box_room_scene


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Path, Recording, LearnOptions]]:
    """What `learn_scene` was called with."""
    calls: list[tuple[Path, Recording, LearnOptions]] = []
    monkeypatch.setattr(learn_into_store, "learn_scene", lambda *words: calls.append(words[:3]))
    return calls


def test_defaults_are_those_of_the_command_line() -> None:
    python = inspect.signature(learn).parameters
    command = {field: getattr(Learn, field) for field in ("preset", "memory", "strategy")}
    assert {name: python[name].default for name in command} == command
    assert evercal.learn is learn


def test_folders_and_scenes_strings_and_paths(asked: Any, tmp_path: Path) -> None:
    scene = box_room_scene(3, 2, 1)
    generic.write(tmp_path / "room", scene)
    for recorded in (scene, tmp_path / "room", str(tmp_path / "room")):
        learn(str(tmp_path / "store"), recorded, memory="5MB")
    for root, taken, options in asked:
        assert root == tmp_path / "store"
        assert taken.name == scene.name
        assert options.stage.memory_bytes == 5_000_000
        assert options.strategy.name == "evercal"


def test_memory_is_a_share_bytes_or_a_number(asked: Any, tmp_path: Path) -> None:
    scene = box_room_scene(3, 2, 1)
    for memory in ("20%", 3000, "3kB"):
        learn(tmp_path / "store", scene, memory=memory, preset="demo")
    kept = [(options.stage.memory_share, options.stage.memory_bytes) for _, _, options in asked]
    share = preset("demo").memory_share
    assert kept == [(0.2, None), (share, 3000), (share, 3000)]


def test_a_store_keeps_its_strategy(asked: Any, tmp_path: Path) -> None:
    write_manifest(tmp_path, {"strategy": "finetune"}, [])
    learn(tmp_path, box_room_scene(3, 2, 1))
    assert asked[0][2].strategy.name == "finetune"


@pytest.mark.parametrize(
    ("words", "said"),
    [({"preset": "slow"}, "preset 'slow'"), ({"memory": "none"}, "memory none")],
)
def test_other_words_are_refused(tmp_path: Path, words: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        learn(tmp_path / "store", tmp_path, **words)
    assert not list(tmp_path.iterdir())
