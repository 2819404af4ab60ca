"""`evercal arm-in-view`, its report, and `evercal check` of a camera by its arm."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evercal.calibration.calibration import read_calibration
from evercal.cli import main
from evercal.geometry import SE3
from evercal.robot.frame_names import FrameNames
from tests import arm_cell


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording, `camera.json` made of it, and the report."""
    folder = tmp_path_factory.mktemp("arm")
    arm_cell.write(folder / "recording")
    words = ["arm-in-view", str(folder / "recording"), "--out", f"{folder}/camera.json"]
    assert main([*words, "--report", f"{folder}/report.html"]) == 0
    return folder


def test_the_report_draws_the_outline_of_the_arm(cell: Path) -> None:
    page = (cell / "report.html").read_text("utf-8")
    assert page.count("% of the outline shown") >= 4
    for name in ("Lines are the outline of the arm", "<td>fore</td>", "<td>hand</td>"):
        assert name in page
    assert "residual (deg)" not in page
    assert "--store MAP" not in page


def test_a_report_without_the_recording_names_the_command(
    cell: Path, tmp_path: Path
) -> None:
    images = str(cell / "recording")
    words = ["report", str(cell / "camera.json"), "--images", images, "--out"]
    assert main([*words, str(tmp_path / "r.html")]) == 0
    page = (tmp_path / "r.html").read_text("utf-8")
    assert "with --report" in page
    assert "--store MAP" not in page


@pytest.mark.parametrize("named", [True, False])
def test_compare_with_a_calibration_by_a_board(
    cell: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], *, named: bool
) -> None:
    """Another origin, 50 mm beside it; frames with names, and without."""
    ours = read_calibration(cell / "camera.json")
    bump = SE3.exp([0.05, 0, 0, 0, 0, 0])
    board = replace(
        ours,
        parent_from_child=ours.parent_from_child @ bump,
        frames=ours.frames if named else FrameNames(),
        joints=(),
        joint_covariance=np.zeros((0, 0)),
        source={"command": "solve"},
    )
    files = [str(cell / "camera.json"), str(tmp_path / "board.json")]
    board.write(files[1])
    assert main(["compare", *files]) == 1
    assert "50.00 mm" in capsys.readouterr().out
    assert main(["compare", files[0], files[0]]) == 0


def test_inspect_names_the_method(
    cell: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = str(cell / "recording")
    assert main(["inspect", recording]) == 0
    assert f"next: evercal arm-in-view {recording}" in capsys.readouterr().out


def test_what_cannot_be_compared_is_refused(
    cell: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A camera on the gripper, a map without images, an arm that stands still."""
    still = tmp_path / "still"
    shutil.copytree(cell / "recording", still)
    header, first, *rows = (still / "joints.csv").read_text().splitlines()
    values = first.partition(",")[2]
    lines = [f"{row.partition(',')[0]},{values}" for row in (first, *rows)]
    (still / "joints.csv").write_text("\n".join([header, *lines]))
    on_arm = replace(read_calibration(cell / "camera.json"), mount="eye_in_hand")
    file = tmp_path / "on_arm.json"
    on_arm.write(file)
    for words, message in (
        (["check", str(still), "--reference", str(file)], "a camera on the gripper"),
        (["arm-in-view", str(still)], "the arm does not move"),
        (
            ["check", str(still), "--reference", str(file), "--scene", "x"],
            "give images that show a scene of a map",
        ),
    ):
        assert main(words) == 2
        assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "code", "words"),
    [
        ("", 0, ("No joint has changed", "The camera has not moved")),
        (
            "urdf",
            1,
            ("The camera has moved", "is this the URDF of the arm as it is now"),
        ),
        ("camera", 1, ("No joint has changed", "The camera has moved by 2")),
        ("joint", 1, ("Changed joints: shoulder (", "The camera has not moved")),
    ],
)
def test_new_images_show_what_has_moved(
    cell: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    change: str,
    code: int,
    words: tuple[str, ...],
) -> None:
    """The camera by 20 mm and more, the zero of a joint by 0.6 deg, or a longer link."""
    new = tmp_path / "new"
    arm_cell.write(new, 6, seed=1)
    reference = read_calibration(cell / "camera.json")
    if change == "camera":
        bump = SE3.exp([0.015, -0.015, 0, 0, 0, 0.01])
        moved = reference.parent_from_child @ bump
        reference = replace(reference, parent_from_child=moved)
    if change == "urdf":
        text = (new / "robot.urdf").read_text().replace("0 0 0.32", "0 0 0.36")
        (new / "robot.urdf").write_text(text)
    if change == "joint":
        names = ("image", *arm_cell.NAMES)
        rows = np.loadtxt(new / "joints.csv", str, delimiter=",", skiprows=1)
        rows[:, 2] = (rows[:, 2].astype(float) + 0.01).astype(str)
        lines = [",".join(row) for row in (names, *rows.tolist())]
        (new / "joints.csv").write_text("\n".join(lines))
    file = tmp_path / "reference.json"
    reference.write(file)
    assert main(["check", str(new), "--reference", str(file)]) == code
    output = capsys.readouterr().out
    for sentence in words:
        assert sentence in output
