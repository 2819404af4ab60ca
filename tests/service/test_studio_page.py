"""The studio in a browser: from an empty folder to exported calibrations of the virtual cell."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser")

from evercal.calibration.calibration import read_calibration
from evercal.geometry import SE3, pose_distance_mm_deg
from evercal.recordings import load_recording
from evercal.simulation.virtual_cell import CellOptions, VirtualCell

from .browsing import click, seen_until, shot, studio_of, visited


def test_samples_are_taken_by_button_and_key_and_removed(browser: Any, tmp_path: Path) -> None:
    with studio_of(tmp_path) as page, visited(browser, page.url) as (visit, errors):
        seen_until(visit, "Images and gripper poses arrive.")
        click(visit, "Next: Record")
        click(visit, "Take sample")
        seen_until(visit, "Took sample 0000.jpg.")
        click(visit, "Move there")
        seen_until(visit, "The arm is there.")
        visit.keyboard.press("t")
        seen_until(visit, "Took sample 0001.jpg.")
        click(visit, "Remove")
        seen_until(visit, "Removed 0001.jpg.")
        seen_until(visit, f"evercal inspect {tmp_path}/wrist --coverage")
        assert [f.name for f in load_recording(tmp_path / "wrist").train] == ["0000.jpg"]
        assert errors == []


@pytest.mark.slow
def test_from_an_empty_folder_to_both_calibrations(browser: Any, tmp_path: Path) -> None:
    """The exported mount and tripod are within 1 mm and 0.05 deg of the truth."""
    cell = VirtualCell(3, CellOptions(width=320, height=240))
    with studio_of(tmp_path, cell) as page, visited(browser, page.url) as (visit, errors):
        seen_until(visit, "Images and gripper poses arrive.")
        shot(visit, "connect")
        click(visit, "Next: Record")
        click(visit, "Record by itself")
        seen_until(visit, "samples are recorded.", 900)
        shot(visit, "record")
        click(visit, "Next: Learn")
        click(visit, "Learn the recording")
        seen_until(visit, "wrist.json.", 1200)
        shot(visit, "learn")
        click(visit, "Next: Fixed camera")
        click(visit, "Take 8 images")
        seen_until(visit, "Took 8 images.", 600)
        click(visit, "Calibrate")
        seen_until(visit, "Calibrated the fixed camera", 600)
        click(visit, "Check")
        seen_until(visit, "The camera has not moved")
        shot(visit, "fixed")
        click(visit, "Next: Export")
        click(visit, "Export file")
        seen_until(visit, f"Wrote {tmp_path}/export/wrist.calib.")
        visit.locator("input[value='camera on the gripper']").first.click()
        visit.get_by_role("option", name="fixed camera").click()
        seen_until(visit, f"{tmp_path}/export/fixed.calib")
        click(visit, "Export file")
        seen_until(visit, f"Wrote {tmp_path}/export/fixed.calib.")
        click(visit, "Write report")
        seen_until(visit, f"Wrote {tmp_path}/fixed.html.")
        shot(visit, "export")
        assert errors == []
    assert "<html" in (tmp_path / "fixed.html").read_text()
    truth = {"wrist": cell.truth.gripper_from_camera, "fixed": cell.truth.base_from_tripod}
    for name, true in truth.items():
        for found in (
            read_calibration(tmp_path / f"{name}.json").parent_from_child,
            exported_pose(tmp_path / f"export/{name}.calib"),
        ):
            millimetres, degrees = pose_distance_mm_deg(found, true)
            assert millimetres < 1
            assert degrees < 0.05


def exported_pose(path: Path) -> SE3:
    """The transform in a file of easy_handeye2."""
    numbers: dict[str, float] = {}
    part = ""
    for line in path.read_text().splitlines():
        key, _, value = line.strip().partition(":")
        if key in ("translation", "rotation"):
            part = key
        elif key in "xyzw" and value.strip():
            numbers[f"{part}_{key}"] = float(value)
    quaternion = np.array([numbers[f"rotation_{axis}"] for axis in "wxyz"])
    return SE3(quaternion, np.array([numbers[f"translation_{axis}"] for axis in "xyz"]))
