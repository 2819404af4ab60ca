"""`evercal info` and `evercal verify`."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest


def test_info_adds_up(run: Any, store: Path) -> None:
    info = json.loads(run("info", store, "--json").out)
    assert info["strategy"] == "evercal"
    assert info["total_bytes"] == sum(f.stat().st_size for f in store.rglob("*") if f.is_file())
    assert info["memory_bytes"] + info["head_bytes"] < info["total_bytes"]
    (scene,) = info["scenes"]
    assert scene["name"] == "box-room-41"
    assert scene["camera"]["width"] == 320
    text = run("info", store).out
    assert "box-room-41" in text
    assert text.splitlines()[-1] == f"next: evercal verify {store}"


def test_verify_names_what_is_damaged(run: Any, store: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(store, tmp_path / "s"))
    assert run("verify", copy).code == 0
    assert json.loads(run("verify", copy, "--json").out)["ok"] is True
    victim = next(copy.rglob("memory.safetensors"))
    data = bytearray(victim.read_bytes())
    data[-1] ^= 1
    victim.write_bytes(data)
    next(copy.rglob("prototypes.safetensors")).unlink()
    ran = run("verify", copy)
    assert ran.code == 1
    assert "memory.safetensors: checksum" in ran.out
    assert "prototypes.safetensors: missing" in ran.out
    answer = json.loads(run("verify", copy, "--json").out)
    assert answer["ok"] is False
    assert len(answer["problems"]) == 2
    for verb in (["info", copy], ["learn", copy, tmp_path], ["evaluate", copy, tmp_path]):
        refused = run(*verb)
        assert (refused.code, refused.out, len(refused.err)) == (2, "", 1)


@pytest.mark.parametrize("verb", ["info", "verify"])
def test_what_is_not_a_store_is_refused(run: Any, tmp_path: Path, verb: str) -> None:
    for path in (tmp_path, tmp_path / "nowhere"):
        ran = run(verb, path)
        assert (ran.code, ran.out, len(ran.err)) == (2, "", 1)
        assert json.loads(run(verb, path, "--json").out).keys() == {"error"}
