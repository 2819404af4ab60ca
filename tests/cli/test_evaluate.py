"""`evercal evaluate`: the JSON object, the table and the names of scenes."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evercal.cli.evaluate import load_named
from evercal.errors import InputError
from evercal.evaluation import evaluate
from evercal.localization.localizer import Localizer
from evercal.recordings import load_recording


def test_json_has_the_documented_keys(run: Any, store: Path, rooms: Any) -> None:
    ran = run("evaluate", store, f"box-room-41={rooms[0]}", "--json")
    scores = json.loads(ran.out)
    assert ran.code == 0
    assert ran.err == []
    means = {"mean_accuracy_5cm_5deg", "mean_accuracy_1cm_1deg"}
    assert scores.keys() == {"scenes", *means, "ms_per_image"}
    assert scores["scenes"].keys() == {"box-room-41"}
    assert scores["scenes"]["box-room-41"].keys() == {
        "frames",
        "accuracy_5cm_5deg",
        "accuracy_2cm_2deg",
        "accuracy_1cm_1deg",
        "accuracy_5mm_05deg",
        "median_translation_cm",
        "median_rotation_deg",
        "wrong_scene",
        "unknown",
        "near_training_frame",
        "inside_95",
    }
    assert scores["scenes"]["box-room-41"]["frames"] == 6


def test_table(run: Any, store: Path, rooms: Any) -> None:
    ran = run("evaluate", store, rooms[0])
    assert ran.code == 0
    assert "box-room-41" in ran.out
    assert ran.out.splitlines()[-1].startswith("next: evercal ")


def test_results_contain_the_estimated_poses(store: Path, rooms: Any) -> None:
    localizer, scene = Localizer.open(store), load_recording(rooms[0])
    results = evaluate(localizer, {"box-room-41": scene})
    for frame, result in zip(scene.test, results, strict=True):
        assert result.frame == frame.name
        expected = localizer.localize(frame.read_image()).base_from_camera
        assert (result.estimated is None) == (expected is None)
        if result.estimated is not None and expected is not None:
            np.testing.assert_array_equal(result.estimated.matrix(), expected.matrix())
    assert any(result.estimated is not None for result in results)


def test_scenes_are_named_by_folder_or_option(rooms: Any, tmp_path: Path) -> None:
    odd = tmp_path / "a=b"
    shutil.copytree(rooms[0], odd)
    assert list(load_named((str(rooms[0]), f"other={rooms[0]}"))) == ["box-room-41", "other"]
    assert list(load_named((str(odd),))) == ["box-room-41"]
    assert list(load_named((f"x={odd}",))) == ["x"]
    with pytest.raises(InputError, match="was given twice"):
        load_named((str(rooms[0]), str(odd)))


@pytest.mark.parametrize("kind", ["none", "missing", "unknown", "no poses", "store"])
def test_bad_input_gives_one_line(
    run: Any, store: Path, rooms: Any, snapshot: Any, tmp_path: Path, kind: str
) -> None:
    shutil.copytree(rooms[0], tmp_path / "scene")
    data = json.loads((tmp_path / "scene/scene.json").read_text())
    for frame in data["frames"]:
        frame["base_from_camera"] = None
    (tmp_path / "scene/scene.json").write_text(json.dumps(data))
    words: list[object] = {
        "none": [store],
        "missing": [store, tmp_path / "nowhere"],
        "unknown": [store, rooms[1]],
        "no poses": [store, tmp_path / "scene"],
        "store": [rooms[0], rooms[0]],
    }[kind]
    before = snapshot(store)
    ran = run("evaluate", *words)
    assert (ran.code, ran.out, len(ran.err)) == (2, "", 1)
    assert snapshot(store) == before
    assert json.loads(run("evaluate", *words, "--json").out).keys() == {"error"}
