"""The page of the 3D view: its server, the arm, and a browser that shows it."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

pytest.importorskip("viser")

from evercal.calibration.calibration import Calibration
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.service.viewer.page import Page, ViewOptions, gripper_from_camera, is_local

if TYPE_CHECKING:
    from evercal.localization.localizer import Localizer
    from evercal.mapping.scene_map import MapContents
    from evercal.recordings.frame import Recording

ARM = """<robot name="arm">
  <link name="base"><visual><geometry><box size="0.1 0.1 0.1"/></geometry></visual></link>
  <link name="gripper"><visual><geometry><box size="0.05 0.05 0.2"/></geometry></visual></link>
  <joint name="turn" type="revolute">
    <parent link="base"/><child link="gripper"/><origin xyz="0 0 0.5"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/>
  </joint>
</robot>"""


@pytest.fixture(scope="module")
def localizer(hall_map: MapContents) -> Localizer:
    from evercal.localization.localizer import Localizer

    return Localizer(hall_map)


@pytest.fixture(scope="module")
def files(hall: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording, a URDF, a calibration of a fixed camera and one of a camera on the gripper."""
    from evercal.recordings.formats import generic

    root = tmp_path_factory.mktemp("viewer")
    joints = [replace(f, joints_rad=(0.1 * i,)) for i, f in enumerate(hall.test[7:9])]
    generic.write(root / "hall", replace(hall, train=(), test=tuple(joints)))
    (root / "arm.urdf").write_text(ARM)
    covariance = np.diag([1e-6, 4e-6, 9e-6, 1e-8, 1e-8, 1e-8])
    pose = hall.train[0].base_from_camera
    assert pose is not None
    source = {"scene": "hall"}
    Calibration("eye_to_hand", pose, covariance, source=source).write(root / "fixed.json")
    hand = Calibration("eye_in_hand", SE3.identity(), covariance, "gripper")
    hand.write(root / "hand.json")
    return root


@contextmanager
def page_of(localizer: Localizer, **options: Any) -> Iterator[Page]:
    page = Page(localizer, ViewOptions(port=0, **options))
    try:
        yield page
    finally:
        page.close()


def test_a_taken_port_is_refused(localizer: Localizer) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=f"--port {port}: Address already in use"):
            Page(localizer, ViewOptions(port=port))
    with pytest.raises(InputError, match="--port 99999: give 0 to 65535"):
        Page(localizer, ViewOptions(port=99999))


def test_a_bad_file_is_named(localizer: Localizer, files: Path) -> None:
    (files / "bent.urdf").write_text("<robot")
    cases: list[tuple[dict[str, Any], str]] = [
        ({"urdf": files / "bent.urdf"}, "bent.urdf: no usable URDF"),
        ({"urdf": files / "gone.urdf"}, "gone.urdf: no such URDF file"),
        ({"recording": files / "gone"}, "gone: no such folder"),
        ({"live": str(files / "gone")}, "gone: no such folder or video"),
        ({"calibrations": (files / "arm.urdf",)}, "arm.urdf: "),
    ]
    for options, message in cases:
        with pytest.raises(InputError, match=message):
            Page(localizer, ViewOptions(port=0, **options))


def test_the_arm_follows_the_joints(localizer: Localizer, files: Path) -> None:
    from evercal.service.viewer.page import start_server
    from evercal.service.viewer.robot import Robot

    server = start_server("127.0.0.1", 0)
    try:
        robot = Robot(server, files / "arm.urdf")
        assert robot.joints == ("turn",)
        robot.move((0.7,))
        pose = robot.base_from_link("gripper")
        assert pose is not None
        np.testing.assert_allclose(pose.translation_m, [0, 0, 0.5], atol=1e-9)
        wanted = [np.cos(0.7), -np.sin(0.7), 0]
        np.testing.assert_allclose(pose.rotation_matrix()[0], wanted, atol=1e-9)
        robot.move(None)
        pose = robot.base_from_link("gripper")
        assert pose is not None
        np.testing.assert_allclose(pose.rotation_matrix(), np.eye(3), atol=1e-9)
        assert robot.base_from_link("hand") is None
        with pytest.raises(InputError, match=r"arm.urdf: has 1 joints, the recording states 2"):
            robot.move((0.0, 0.0))
    finally:
        server.stop()


def test_one_camera_on_the_gripper_is_used_and_of_two_none() -> None:
    hand = Calibration("eye_in_hand", SE3.exp([1, 2, 3, 0, 0, 0]), np.eye(6), "gripper")
    fixed = Calibration("eye_to_hand", SE3.identity(), np.eye(6))
    assert gripper_from_camera([fixed, hand]) is hand.parent_from_child
    assert gripper_from_camera([hand, hand]) is None
    assert gripper_from_camera([fixed]) is None


def test_only_loopback_addresses_are_local() -> None:
    assert [is_local(host) for host in ("127.0.0.1", "::1", "localhost")] == [True] * 3
    assert [is_local(host) for host in ("0.0.0.0", "192.168.1.4", "robot")] == [False] * 3


def seen_until(page: Any, text: str, seconds: float = 120) -> None:
    page.get_by_text(text).first.wait_for(timeout=1000 * seconds)


def test_a_browser_shows_the_map(
    localizer: Localizer, files: Path, browser: Any, tmp_path: Path
) -> None:
    calibrations = (files / "fixed.json", files / "hand.json")
    options: dict[str, Any] = {
        "calibrations": calibrations,
        "recording": files / "hall",
        "urdf": files / "arm.urdf",
    }
    with page_of(localizer, **options) as page:
        visit = browser.new_page(viewport={"width": 900, "height": 600})
        errors: list[str] = []
        elsewhere: list[str] = []
        visit.on("console", lambda m: errors.append(m.text) if m.type == "error" else None)
        visit.on("pageerror", lambda error: errors.append(str(error)))
        own = (page.url, "data:", "blob:")
        visit.on("request", lambda r: None if r.url.startswith(own) else elsewhere.append(r.url))
        visit.goto(page.url)
        visit.wait_for_selector("canvas", timeout=120_000)
        # The second calibration, the recording's frame and the keyframes are there.
        for text in ("located", "on the gripper", "3 / 2 / 1 mm", "Click a keyframe"):
            seen_until(visit, text)
        time.sleep(2)
        picture = visit.screenshot(path=os.environ.get("VIEW_SCREENSHOT", tmp_path / "view.png"))
        assert len(np.unique(pixels(picture))) > 50, "a canvas that shows something"
        assert errors == []
        assert elsewhere == [], "the page needs nothing from the internet"
        visit.close()


def test_a_stream_is_tracked_while_a_browser_looks(
    localizer: Localizer, hall: Recording, browser: Any, tmp_path: Path
) -> None:
    from evercal.recordings import write_image

    for i in range(2):
        write_image(tmp_path / f"{i}.png", hall.test[7 + i].read_image())
    rng = np.random.default_rng(0)
    write_image(tmp_path / "2.png", rng.integers(0, 256, (240, 320, 3)).astype(np.uint8))
    with page_of(localizer, live=str(tmp_path)) as page:
        visit = browser.new_page(viewport={"width": 900, "height": 600})
        visit.goto(page.url)
        seen_until(visit, "the stream has ended")
        seen_until(visit, "lost")
        visit.close()


def pixels(picture: bytes) -> np.ndarray:
    import cv2

    image = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return np.asarray(image)
