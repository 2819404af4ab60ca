"""Calibrations of one camera: for another lens, and compared by their rays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evercal.calibration.calibration import Calibration, read_calibration
from evercal.calibration.checks import Checks
from evercal.calibration.export.formats import export_files
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, pose_distance_mm_deg
from evercal.recordings.cameras.camera_file import read_camera
from evercal.robot.frame_names import FrameNames

STATED = Camera(1280, 720, 900, 903, 650, 362, (0.01, 0.2, 4e-4, -4e-4, -0.3))
ESTIMATED = STATED.changed([0.002, 6, -3, 0.01, -0.02, 3e-4, -2e-4, 0.02])
POSE = SE3.exp([0.05, -0.03, 0.02, 0.4, -0.5, 0.6])
SIGMA = np.repeat([0.4e-3, np.deg2rad(0.03)], 3)


NAMES = FrameNames(gripper="hand", camera="right")


def example(pose: SE3 = POSE, camera: Camera | None = ESTIMATED) -> Calibration:
    lenses = {"stated": STATED, "estimated": ESTIMATED}
    return Calibration(
        "eye_in_hand", pose, np.diag(SIGMA**2), NAMES, camera=camera, lenses=lenses
    )


def moved(*tangent: float) -> Calibration:
    return example(POSE @ SE3.exp(tangent))


def test_one_answer_for_two_lenses_is_one_answer() -> None:
    """The frames are as far apart as a principal point turns them; the rays agree."""
    first = example()
    second = first.for_lens("stated")
    _, turned = pose_distance_mm_deg(POSE, second.parent_from_child)
    assert turned > 0.3
    compared = first.distance(second)
    assert compared.agree
    assert compared.d2 < 0.01
    assert compared.pose_deg < 1e-3
    assert compared.rays_deg[0] < 0.1
    assert first.lens == "estimated"
    assert second.lens == "stated"
    back = second.for_lens("estimated")
    mm, deg = pose_distance_mm_deg(POSE, back.parent_from_child)
    assert max(mm, deg) < 1e-6


def test_a_covariance_turns_with_the_frame() -> None:
    given = replace(STATED, cx=STATED.cx + 300)
    widened = replace(example(), covariance=np.diag([1, 1, 1, 1, 1, 100]) * 1e-8)
    turned = widened.for_lens(given)
    assert turned.lens == "given"
    rotation = POSE.rotation.inv() * turned.parent_from_child.rotation
    expected = rotation.inv().as_matrix() @ widened.covariance[3:, 3:]
    expected = expected @ rotation.as_matrix()
    np.testing.assert_allclose(turned.covariance[3:, 3:], expected, atol=1e-12)


@pytest.mark.parametrize(
    ("tangent", "cause"),
    [
        ((0, 0, 0.01, 0, 0, 0), "a scale"),
        ((0, 0, 0, 0.01, 0.01, 0), "turned in its mount"),
        ((0.005, 0.005, 0, 0, 0, 0), "displaced without a turn"),
        ((0.009, -0.008, 0.01, 0.02, -0.01, 0.01), "moved between both recordings"),
    ],
)
def test_the_likeliest_cause_has_the_fewest_parameters(
    tangent: tuple[float, ...], cause: str
) -> None:
    compared = example().distance(moved(*tangent))
    assert not compared.agree
    assert cause in compared.cause
    assert compared.cause in compared.verdict


def test_a_turn_about_the_last_axis_is_the_zero_of_a_joint() -> None:
    other = SE3.exp([0, 0, 0, 0, 0, np.deg2rad(1)]) @ POSE
    compared = example().distance(example(other))
    assert compared.cause.startswith("the zero of a joint")
    assert "gripper" in compared.cause


def test_points_are_compared_at_the_working_distance() -> None:
    other = moved(0, 0, 0, 0.002, 0, 0)
    near = example().distance(other, 0.3)
    far = replace(example(), checks=Checks(target_m=1.2)).distance(other)
    assert near.rays_mm[0] == pytest.approx(0.6, rel=0.1)
    assert far.rays_mm[0] == pytest.approx(2.4, rel=0.1)
    assert example().distance(other).notes[0].startswith("no working distance")
    with pytest.raises(InputError, match="above 0"):
        example().distance(other, -1.0)


def test_without_intrinsics_frames_are_compared() -> None:
    neither = replace(example(camera=None), lenses={})
    assert "frames are compared" in neither.distance(neither).notes[-1]
    assert "only one" in neither.distance(example()).notes[-1]
    assert "only one" in example().distance(neither).notes[-1]


def test_errors_of_one_map_cancel() -> None:
    scatter = np.diag(np.repeat([1e-4, 1e-4], 3) ** 2).tolist()
    checks = Checks(images_used=20, image_scatter=scatter)
    first = replace(example(), checks=checks, source={"map": "a"})
    same = first.distance(replace(moved(0.002, 0, 0, 0, 0, 0), **vars_of(first)))
    other = first.distance(moved(0.002, 0, 0, 0, 0, 0))
    assert "map" in same.shared
    assert "map" not in other.shared
    assert same.sigma_mm < other.sigma_mm / 2


def vars_of(calibration: Calibration) -> dict[str, object]:
    return {"checks": calibration.checks, "source": calibration.source}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mount": "eye_to_hand"}, "mount is 'eye_in_hand' in the first"),
        ({"frames": FrameNames(gripper="tool0")}, "gripper is 'hand' in the first"),
        ({"frames": FrameNames(camera="left")}, "camera is 'right' in the first"),
        ({"camera": STATED.resized(640, 360)}, "differ in image size"),
    ],
)
def test_calibrations_of_different_things_are_refused(
    change: dict[str, object], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        example().distance(replace(example(), **change))


def test_a_file_states_its_lens_and_the_pose_for_the_stated_one(tmp_path: Path) -> None:
    first = example()
    first.write(tmp_path / "c.json")
    read = read_calibration(tmp_path / "c.json")
    assert (read.lens, read.lenses) == ("estimated", first.lenses)
    record = first.to_dict()
    stated = first.for_lens("stated")
    assert record["lens"] == "estimated"
    left_deg = record["for_stated_lens"].pop("left_deg")
    assert record["for_stated_lens"] == stated.transform_to_dict()
    assert 0 < left_deg < 0.2
    # As a camera file, the intrinsics of its pose count.
    assert read_camera(tmp_path / "c.json") == ESTIMATED


def test_exports_are_for_the_stated_lens_by_default(tmp_path: Path) -> None:
    first = example()
    exported = export_files(first, "urdf", tmp_path / "camera.urdf")
    stated = first.for_lens("stated").parent_from_child
    assert exported.calibration.lens == "stated"
    mm, deg = pose_distance_mm_deg(exported.calibration.parent_from_child, stated)
    assert max(mm, deg) < 1e-9
    assert "For the stated intrinsics fx 900.000" in exported.text
    assert [file.name for file in exported.files] == ["camera.urdf"]
    info = tmp_path / "info.yaml"
    export_files(first, "camera_info", info)
    assert read_camera(info) == STATED


def test_the_estimated_lens_is_written_beside_its_pose(tmp_path: Path) -> None:
    first = example()
    out = tmp_path / "camera.urdf"
    exported = export_files(first, "urdf", out, lens="estimated")
    _, beside = exported.files
    assert beside.name == "camera.camera_info.yaml"
    assert read_camera(beside) == ESTIMATED
    mm, deg = pose_distance_mm_deg(exported.calibration.parent_from_child, POSE)
    assert max(mm, deg) < 1e-9
    inside = export_files(first, "opencv", tmp_path / "c.yml", lens="estimated")
    assert len(inside.files) == 1


def test_an_export_takes_the_lens_of_a_driver(tmp_path: Path) -> None:
    first = example()
    driver = replace(STATED, cx=STATED.cx + 5, fx=1.01 * STATED.fx)
    info = tmp_path / "driver.yaml"
    info.write_text(first.for_lens(driver).export("camera_info", lens=driver))
    exported = export_files(first, "json", lens=info)
    expected = first.for_lens(driver).parent_from_child
    mm, deg = pose_distance_mm_deg(exported.calibration.parent_from_child, expected)
    assert max(mm, deg) < 1e-6
    assert exported.calibration.lens == "given"
    with pytest.raises(InputError, match="no other intrinsics"):
        export_files(replace(first, lenses={}), "json", lens="estimated")
