"""What the tests of the pages do in a browser."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from evercal.service.studio.devices import Devices
from evercal.service.studio.folders import Folders
from evercal.service.studio.page import StudioPage
from evercal.service.studio.studio import Studio
from evercal.simulation.panda_arm import joint_frames
from evercal.simulation.virtual_cell import CellOptions, VirtualCell, nominal_mount

PHONE = 390
"""Width of a small screen, pixels."""
SHOT_MS = 120_000
"""Time for a picture of a page that is rendered in software on a busy machine."""


@contextmanager
def visited(browser: Any, url: str, width: int = 1200) -> Iterator[tuple[Any, list[str]]]:
    """A visit of a page, and the errors in its console."""
    errors: list[str] = []
    visit = browser.new_page(viewport={"width": width, "height": 800})
    visit.on("console", lambda m: errors.append(m.text) if m.type == "error" else None)
    visit.on("pageerror", lambda error: errors.append(str(error)))
    try:
        visit.goto(url)
        visit.wait_for_selector("canvas", timeout=120_000)
        yield visit, errors
    finally:  # a page that stays open takes the processor from the next one
        visit.close()


@contextmanager
def studio_of(root: Path, cell: VirtualCell | None = None) -> Iterator[StudioPage]:
    """The studio of a virtual cell, by default a small one."""
    cell = cell or VirtualCell(3, CellOptions(width=160, height=120))
    devices = Devices(
        cell.wrist_camera,
        cell.intrinsics,
        cell.robot,
        cell.tripod_camera,
        None,
        cell.reachable_poses(120),
        nominal_mount(),
        lambda: joint_frames(np.array(cell.robot.joints_rad()))[:, :3, 3],
    )
    studio = Studio(devices, Folders(root, root / "map"), "cpu")
    page = StudioPage(studio, "127.0.0.1", 0, "evercal studio --virtual")
    try:
        yield page
    finally:
        page.close()


def seen_until(visit: Any, text: str, seconds: float = 300) -> None:
    visit.get_by_text(text).first.wait_for(timeout=1000 * seconds)


def click(visit: Any, name: str) -> None:
    visit.get_by_role("button", name=name, exact=True).click(timeout=300_000)


def shot(visit: Any, name: str) -> None:
    """Keep a picture where the environment asks for it."""
    folder = os.environ.get("STUDIO_SCREENSHOTS")
    if folder is not None:
        # viser's notice that WebGL runs in software
        visit.add_style_tag(content=".mantine-Notifications-root {display: none}")
        time.sleep(2)
        visit.screenshot(path=Path(folder) / f"{name}.png", timeout=SHOT_MS)
