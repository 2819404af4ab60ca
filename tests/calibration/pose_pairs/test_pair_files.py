"""Rows of two pose files that belong together: by the names of their images."""

from pathlib import Path

import numpy as np
import pytest

from evercal.calibration.pose_pairs.pair_files import PairFiles, read_pairs
from evercal.errors import InputError


def written(file: Path, names: list[str]) -> Path:
    """Poses half a metre from the base; the i-th is i centimetres along y."""
    rows = [f"{name},0.5,{i / 100},0.2,1,0,0,0" for i, name in enumerate(names)]
    file.write_text("\n".join(["image,x,y,z,qw,qx,qy,qz", *rows]))
    return file


def test_names_that_are_times_may_lack_their_ending(tmp_path: Path) -> None:
    robot = written(tmp_path / "robot.csv", ["1.25", "1.50", "1.75"])
    camera = written(tmp_path / "camera.csv", ["rgb/1.75.png", "rgb/1.25.png", "rgb/1.50.png"])
    pairs, _ = read_pairs(PairFiles(robot, camera))
    np.testing.assert_allclose(pairs.base_from_gripper.translation_m[:, 1], [0.02, 0, 0.01])


def test_names_that_are_the_same_but_for_their_folders_are_refused(tmp_path: Path) -> None:
    robot = written(tmp_path / "robot.csv", ["left/1.png", "right/1.png"])
    camera = written(tmp_path / "camera.csv", ["1.png"])
    with pytest.raises(InputError, match=r"robot\.csv: 'left/1\.png' comes twice, apart from"):
        read_pairs(PairFiles(robot, camera))
