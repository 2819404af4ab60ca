"""`evercal inspect`: what it prints, and what it refuses."""

import dataclasses

from evercal.recordings import load_recording
from evercal.recordings.inspection import Inspection, inspect_recording


def test_sound_recording_has_no_warnings(run, rooms):
    ran = run("inspect", rooms[0], "--json")
    record = ran.json
    assert record.keys() == {field.name for field in dataclasses.fields(Inspection)}
    assert (record["train"], record["test"], record["untracked"]) == (24, 6, 0)
    assert record["warnings"] == []
    text = run("inspect", rooms[0]).out
    assert "24 training and 6 test frames" in text
    assert text.splitlines()[-1] == f"next: evercal learn MAP {rooms[0]}"


def test_frames_in_both_splits_are_a_warning(rooms):
    recorded = load_recording(rooms[0])
    both = dataclasses.replace(recorded, test=recorded.train[:6])
    assert "test frames have the pose or the file" in "\n".join(
        inspect_recording(both).warnings
    )


def test_coverage_and_next_poses_of_a_wrist_recording(run, tmp_path):
    cell = tmp_path / "cell"
    ran = run(
        "simulate cell --out",
        cell,
        "--frames 9 --size 160x120 --json",
    )
    made = ran.json
    assert (ran.code, made["wrist"], made["frames"]) == (0, str(cell / "wrist"), 42)
    words = ["inspect", cell / "wrist", "--coverage --next", cell / "reachable.csv"]
    words += ["--count 3 --gripper-from-camera", cell / "rough.txt"]
    record = run.json(*words)
    assert len(record["coverage"]["samples"]) == 9
    assert record["warnings"] == []
    assert record["open_position"] is None
    assert record["coverage"]["ready"]
    sigmas = [view["sigma_mm"] for view in record["next"]]
    assert len(sigmas) == 3
    assert sigmas == sorted(sigmas, reverse=True)
    text = run(*words).out
    assert "can be learned" in text
    assert f"row {record['next'][0]['row']}:" in text
