"""The studio in a browser: from an empty folder to exported calibrations of the virtual cell."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser")

from evercal.calibration.calibration import read_calibration
from evercal.geometry import pose_distance_mm_deg
from evercal.recordings import load_recording
from evercal.service.studio.devices import Devices
from evercal.service.studio.page import StudioPage
from evercal.service.studio.studio import Studio
from evercal.simulation.panda_arm import joint_frames
from evercal.simulation.virtual_cell import CellOptions, VirtualCell, nominal_mount

from .browsing import click, seen_until, shot, visited


@pytest.mark.slow("src/evercal/service/studio", "src/evercal/service/viewer")
def test_from_an_empty_folder_to_both_calibrations(browser, tmp_path):
    """The exported mount and tripod are within 1 mm and 0.05 deg of the truth."""
    cell = VirtualCell(3, CellOptions(width=320, height=240))
    devices = Devices(
        cell.wrist_camera,
        cell.intrinsics,
        cell.robot,
        cell.tripod_camera,
        reachable=cell.reachable_poses(120),
        rough=nominal_mount(),
        arm=lambda: joint_frames(np.array(cell.robot.joints_rad()))[:, :3, 3],
        settle_s=0.0,
    )
    page = StudioPage(Studio(devices, tmp_path), "127.0.0.1", 0)
    try:
        with visited(browser, page.server.url) as visit:
            record(visit, tmp_path)
            calibrate(visit, tmp_path)
            assert page.watched()
            # As for a hidden page.
            visit.evaluate("window.requestAnimationFrame = () => 0")
            time.sleep(2)  # the frame that was requested before is drawn
            assert not page.watched()
        wait_until = time.monotonic() + 20
        while page.server.get_clients():
            assert time.monotonic() < wait_until
        assert not page.watched()
    finally:
        page.close()
    truth = {
        "wrist": cell.truth.gripper_from_camera,
        "fixed": cell.truth.base_from_tripod,
    }
    for name, true in truth.items():
        found = read_calibration(tmp_path / f"{name}.json").parent_from_child
        millimetres, degrees = pose_distance_mm_deg(found, true)
        assert millimetres < 1
        assert degrees < 0.05
        assert (tmp_path / f"export/{name}_opencv.yml").is_file()


def record(visit: Any, root: Path) -> None:
    """By button and by key, then by itself."""
    seen_until(visit, "Images and gripper poses arrive.")
    click(visit, "Record", "tab")
    click(visit, "Take sample")
    seen_until(visit, "Took sample 0000.jpg.")
    visit.keyboard.press("m")
    seen_until(visit, "The arm is there.")
    visit.keyboard.press("t")
    seen_until(visit, "Took sample 0001.jpg.")
    visit.get_by_text("Samples", exact=True).first.click()
    click(visit, "Remove")
    seen_until(visit, "Removed 0001.jpg.")
    visit.get_by_text("Samples", exact=True).first.click()
    assert [f.name for f in load_recording(root / "wrist").train] == ["0000.jpg"]
    click(visit, "Record by itself")
    seen_until(visit, "samples are recorded.", 900)
    shot(visit, "record")


def calibrate(visit: Any, root: Path) -> None:
    """Learn, calibrate and check the fixed camera, export both."""
    click(visit, "Learn", "tab")
    click(visit, "Learn the recording")
    seen_until(visit, "wrist.json.", 1200)
    click(visit, "Fixed", "tab")
    click(visit, "Take 8 images")
    seen_until(visit, "Took 8 images.", 600)
    click(visit, "Calibrate")
    seen_until(visit, "Calibrated the fixed camera", 600)
    click(visit, "Check")
    seen_until(visit, "The camera has not moved")
    shot(visit, "fixed")
    click(visit, "Export", "tab")
    click(visit, "Export file")
    seen_until(visit, "the base frame is unknown")
    visit.locator("input[value='easy_handeye2']:not([type=hidden])").last.click()
    visit.get_by_role("option", name="opencv").last.click()
    click(visit, "Export file")
    seen_until(visit, f"Wrote {root}/export/wrist_opencv.yml.")
    visit.locator(
        "input[value='camera on the gripper']:not([type=hidden])"
    ).last.click()
    visit.get_by_role("option", name="fixed camera").last.click()
    click(visit, "Export file")
    seen_until(visit, f"Wrote {root}/export/fixed_opencv.yml.")
