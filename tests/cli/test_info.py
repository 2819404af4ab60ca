"""`evercal info`."""

import json
import shutil
from pathlib import Path
from typing import Any

MAP_KEYS = {"name", "train_frames", "memory_bytes", "keyframes", "camera", "landmarks"}
MAP_KEYS |= {"adjusted", "hand_eye"}


def test_info_of_a_map(run: Any, store: Path) -> None:
    info = json.loads(run("info", store, "--json").out)
    assert info["strategy"] == "evercal"
    assert info["total_bytes"] == sum(
        f.stat().st_size for f in store.rglob("*") if f.is_file()
    )
    assert 0 < info["memory_bytes"] < info["total_bytes"]
    assert info["head_bytes"] == 0
    (scene,) = info["scenes"]
    assert scene.keys() == MAP_KEYS
    assert (scene["name"], scene["camera"]["width"]) == ("box-room-41", 320)
    assert scene["landmarks"] > 50
    lines = [" ".join(line.split()) for line in run("info", store).out.splitlines()]
    counts = f"{scene['train_frames']} {scene['keyframes']} {scene['landmarks']} "
    assert any(line.startswith(f"box-room-41 {counts}") for line in lines)
    residual = f"box-room-41 {scene['adjusted']['residual_px']:.2f} px "
    assert any(line.startswith(residual) for line in lines)
    assert lines[-1] == f"next: evercal info {store} --check"


def test_info_of_a_map_without_reports(run: Any, hall_store: Path) -> None:
    ran = run("info", hall_store)
    assert ran.code == 0
    assert "bundle adjustment" not in ran.out


def test_damaged_files_are_named(run: Any, store: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(store, tmp_path / "s"))
    assert run("info", "--check", copy).code == 0
    assert json.loads(run("info", "--check", copy, "--json").out)["ok"] is True
    keyframes = next(copy.rglob("keyframes.safetensors"))
    data = bytearray(keyframes.read_bytes())
    data[-1] ^= 1
    keyframes.write_bytes(data)
    next(copy.rglob("scene.json")).unlink()
    ran = run("info", "--check", copy)
    assert ran.code == 1
    assert "keyframes.safetensors: checksum" in ran.out
    assert "scene.json: missing" in ran.out
    record = json.loads(run("info", "--check", copy, "--json").out)
    assert record["ok"] is False
    assert len(record["problems"]) == 2
    for words in (
        ["info", copy],
        ["learn", copy, tmp_path],
        ["evaluate", copy, tmp_path],
    ):
        ran = run(*words)
        assert (ran.code, ran.out, len(ran.err)) == (2, "", 1)
