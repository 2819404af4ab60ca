"""`evercal info`."""

import re
import shutil
from pathlib import Path

KEYS = (
    "name train_frames memory_bytes keyframes camera landmarks adjusted hand_eye made"
)


def test_info_of_a_map(run, store):
    info = run.json("info", store)
    assert info["strategy"] == "evercal"
    for scene in info["scenes"]:
        assert scene["made"]["command"][:2] == ["evercal", "learn"]
    files = filter(Path.is_file, store.rglob("*"))
    assert info["total_bytes"] == sum(file.stat().st_size for file in files)
    assert 0 < info["memory_bytes"] < info["total_bytes"]
    assert info["head_bytes"] == 0
    (scene,) = info["scenes"]
    assert scene.keys() == set(KEYS.split())
    assert (scene["name"], scene["camera"]["width"]) == ("box-room-41", 320)
    assert scene["landmarks"] > 50
    text = re.sub(" +", " ", run("info", store).out)
    counts = f"{scene['train_frames']} {scene['keyframes']} {scene['landmarks']} "
    assert f"\nbox-room-41 {counts}" in text
    assert f"\nbox-room-41 {scene['adjusted']['residual_px']:.2f} px " in text
    assert text.endswith(f"\nnext: evercal info {store} --check\n")


def test_info_of_a_map_without_reports(run, hall_store):
    ran = run("info", hall_store)
    assert ran.code == 0
    assert "bundle adjustment" not in ran.out


def test_damaged_files_are_named(run, store, tmp_path):
    copy = Path(shutil.copytree(store, tmp_path / "s"))
    assert run("info --check", copy).code == 0
    assert run.json("info --check", copy)["ok"] is True
    keyframes = next(copy.rglob("keyframes.safetensors"))
    data = bytearray(keyframes.read_bytes())
    data[-1] ^= 1
    keyframes.write_bytes(data)
    next(copy.rglob("scene.json")).unlink()
    ran = run("info --check", copy)
    assert ran.code == 1
    assert "keyframes.safetensors: checksum" in ran.out
    assert "scene.json: missing" in ran.out
    record = run.json("info --check", copy)
    assert record["ok"] is False
    assert len(record["problems"]) == 2
    run.refused("info", copy)
    for verb in ("learn", "evaluate"):
        run.refused(verb, copy, tmp_path)
