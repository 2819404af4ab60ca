"""`check` of a simulated arm: a joint that slipped by half a degree is named."""

from pathlib import Path

import numpy as np
import pytest

from evercal.geometry import SE3, Camera
from evercal.recordings import write_image
from evercal.robot.robot_model import RobotModel
from evercal.simulation.cell_room import WORK_AREA_M, cell_room

pytestmark = pytest.mark.slow(
    "src/evercal/calibration", "src/evercal/mapping", "src/evercal/recordings/poses"
)

CAMERA = Camera(320, 240, 320, 320, 159.5, 119.5)
HOME = np.array([0, -0.2, 0.3, 0, 1.2, 0])
SPREAD = np.array([0.8, 0.35, 0.4, 0.5, 0.4, 0.8])
LINKS = (
    ("0 0 0.15", "0 0 1"),
    ("0 0 0.05", "0 1 0"),
    ("0 0 0.3", "0 1 0"),
    ("0.28 0 0", "1 0 0"),
    ("0.04 0 0", "0 1 0"),
    ("0.06 0 0", "1 0 0"),
)
"""Origin and axis of each joint of a small arm with six of them."""


def write_urdf(file: Path) -> None:
    text = "".join(f'<link name="l{i}"/>' for i in range(8))
    for i, (origin, axis) in enumerate(LINKS):
        ends = f'<parent link="l{i}"/><child link="l{i + 1}"/>'
        limit = '<limit lower="-3" upper="3" effort="1" velocity="1"/>'
        place = f'<origin xyz="{origin}"/><axis xyz="{axis}"/>'
        text += f'<joint name="j{i + 1}" type="revolute">{ends}{place}{limit}</joint>'
    ends = '<parent link="l6"/><child link="l7"/><origin xyz="0.05 0 0"/>'
    file.write_text(
        f'<robot name="six">{text}<joint name="f" type="fixed">{ends}</joint></robot>'
    )


class Cell:
    """An arm with joint offsets and a camera on its gripper, which looks at a room."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        write_urdf(folder / "arm.urdf")
        self.arm = RobotModel(folder / "arm.urdf").arm("l0", "l7")
        self.room = cell_room(1)
        self.rng = np.random.default_rng(1)
        axes = np.array(
            [[0, 0, 1.0, 0.03], [-1, 0, 0, 0.01], [0, -1, 0, 0.06], [0, 0, 0, 1]]
        )
        self.gripper_from_camera = SE3.from_matrix(axes) @ SE3.exp(
            [0, 0, 0, 0.1, -0.05, 0.08]
        )
        self.offsets = np.deg2rad([0, 1.2, -0.8, 0.6, -1.1, 0])

    def record(self, folder: Path, images: int = 20) -> Path:
        """A wrist recording of postures that see the table."""
        folder.mkdir()
        write_urdf(folder / "arm.urdf")
        (folder / "camera.txt").write_text("320 0 159.5\n0 320 119.5\n0 0 1\n")
        rows = ["image," + ",".join(self.arm.joints)]
        while len(rows) <= images:
            joints = HOME + SPREAD * self.rng.uniform(-1, 1, 6)
            pose = self.arm.poses(joints[None])[0] @ self.gripper_from_camera
            seen = pose.inverse().apply(WORK_AREA_M)
            far = np.linalg.norm(seen)
            if (
                pose.translation_m[2] < 0.12
                or not 0.18 < far < 0.9
                or seen[2] < 0.82 * far
            ):
                continue
            image = self.room.render(CAMERA, pose) + self.rng.normal(
                0, 2, (240, 320, 3)
            )
            name = f"{len(rows):03d}.png"
            write_image(folder / name, np.clip(image, 0, 255).astype(np.uint8))
            stated = joints - self.offsets + np.deg2rad(0.02) * self.rng.normal(size=6)
            rows.append(f"{name}," + ",".join(map(str, stated)))
        (folder / "joints.csv").write_text("\n".join(rows) + "\n")
        return folder


def test_a_joint_that_slipped_is_named_and_others_are_not(run, tmp_path):
    cell = Cell(tmp_path / "arm")
    store = tmp_path / "cell"
    reference = tmp_path / "wrist.json"
    ran = run(
        "learn", store, cell.record(tmp_path / "first"), "--calibration", reference
    )
    assert ran.code == 0, ran.err

    same = run("check", store, cell.record(tmp_path / "same"), "--reference", reference)
    assert same.code == 0, same.out
    assert same.out.startswith("No joint has changed.\nThe camera has not moved")
    assert "j1  +0.000 deg: its offset turns the frame of the base" in same.out

    cell.offsets[3] += np.deg2rad(0.5)
    slipped = cell.record(tmp_path / "slipped")
    found = run("check", store, slipped, "--reference", reference, "--json")
    assert found.code == 1
    record = found.json
    assert record["changed"] == ["j4"]
    assert record["confidence"] > 0.99
    assert record["camera"]["moved"] is False
    assert np.rad2deg(record["joints"][3]["offset"]) == pytest.approx(0.5, abs=0.25)

    refused = run("check", store, slipped / "001.png", "--reference", reference)
    assert refused.code == 2
    images = run("check", store, slipped, slipped, "--reference", reference)
    assert (images.code, "give one recording with joint values" in images.err[-1]) == (
        2,
        True,
    )
