"""`evercal evaluate`: the JSON object, the table and the names of scenes."""

import shutil

import pytest

from evercal.cli.evaluate import load_named
from evercal.errors import InputError

KEYS = "frames accuracy_5cm_5deg accuracy_2cm_2deg accuracy_1cm_1deg accuracy_5mm_05deg"
KEYS += (
    " median_translation_cm median_rotation_deg wrong_scene unknown near_training_frame"
)
KEYS += " inside_95"


def test_json_has_the_documented_keys(run, store, rooms):
    ran = run("evaluate", store, f"box-room-41={rooms[0]}", "--json")
    scores = ran.json
    assert (ran.code, ran.err) == (0, [])
    means = {"mean_accuracy_5cm_5deg", "mean_accuracy_1cm_1deg"}
    assert scores.keys() == {"scenes", *means, "ms_per_image"}
    ((name, row),) = scores["scenes"].items()
    assert row.keys() == set(KEYS.split())
    assert (name, row["frames"]) == ("box-room-41", 6)
    text = run("evaluate", store, rooms[0]).out
    assert "box-room-41" in text
    assert text.splitlines()[-1].startswith("next: evercal ")


def test_scenes_are_named_by_folder_or_option(rooms, tmp_path):
    odd = tmp_path / "a=b"
    shutil.copytree(rooms[0], odd)
    both = load_named((str(rooms[0]), f"other={rooms[0]}"))
    assert list(both) == ["box-room-41", "other"]
    assert list(load_named((str(odd),))) == ["box-room-41"]
    assert list(load_named((f"x={odd}",))) == ["x"]
    with pytest.raises(InputError, match="was given twice"):
        load_named((str(rooms[0]), str(odd)))
