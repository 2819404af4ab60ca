"""`evercal compare`."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from evercal.calibration.calibration import Calibration
from evercal.geometry import SE3, Camera


def test_two_files_are_compared(run, tmp_path: Path) -> None:
    camera = Camera(640, 480, 600, 601, 320, 240)
    first = Calibration(
        "eye_to_hand", SE3.exp([1, 0, 0.5, 0.1, 0, 0]), 1e-7 * np.eye(6), camera=camera
    )
    first.write(tmp_path / "a.json")
    other = replace(camera, cx=326.0)
    first.for_lens(other).write(tmp_path / "b.json")
    same = run("compare", tmp_path / "a.json", tmp_path / "b.json")
    assert same.code == 0
    assert same.out.startswith("These two agree")
    assert "mm at 0.5 m" in same.out
    moved = first.parent_from_child @ SE3.exp([0.02, 0, 0, 0, 0, 0])
    replace(first, parent_from_child=moved).write(tmp_path / "c.json")
    apart = run("compare", tmp_path / "a.json", tmp_path / "c.json", "--distance", "1")
    assert apart.code == 1
    assert "The likeliest cause: the camera was displaced" in apart.out
    values = run.json("compare", tmp_path / "a.json", tmp_path / "c.json")
    assert values["agree"] is False
    assert values["pose_mm"] > 19
    replace(first, mount="eye_in_hand").write(tmp_path / "d.json")
    refused = run("compare", tmp_path / "a.json", tmp_path / "d.json")
    assert refused.code == 2
    assert "mount is 'eye_to_hand' in the first" in refused.err[-1]
