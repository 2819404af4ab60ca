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
from evercal.service.viewer.page import Page, ViewOptions, gripper_from_camera

from .browsing import SHOT_MS, click, seen_until, visited

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


def test_a_browser_shows_the_map(
    localizer: Localizer, files: Path, browser: Any, tmp_path: Path
) -> None:
    calibrations = (files / "fixed.json", files / "hand.json")
    options: dict[str, Any] = {
        "calibrations": calibrations,
        "recording": files / "hall",
        "urdf": files / "arm.urdf",
    }
    elsewhere: list[str] = []
    with (
        page_of(localizer, **options) as page,
        visited(browser, page.url) as (visit, errors),
    ):
        own = (page.url, "data:", "blob:")
        visit.on("request", lambda r: None if r.url.startswith(own) else elsewhere.append(r.url))
        visit.reload()
        # The second calibration, the recording's frame and the keyframes are there.
        for text in ("located", "on the gripper", "3 / 2 / 1 mm", "Click a keyframe"):
            seen_until(visit, text)
        time.sleep(2)
        path = os.environ.get("VIEW_SCREENSHOT", tmp_path / "view.png")
        picture = visit.screenshot(path=path, timeout=SHOT_MS)
        assert len(np.unique(pixels(picture))) > 50, "a canvas that shows something"
        assert errors == []
        assert elsewhere == [], "the page needs nothing from the internet"


@pytest.mark.slow
def test_a_stream_is_tracked_while_a_browser_looks(
    localizer: Localizer, hall: Recording, browser: Any, tmp_path: Path
) -> None:
    from evercal.recordings import write_image

    for i in range(2):
        write_image(tmp_path / f"{i}.png", hall.test[7 + i].read_image())
    rng = np.random.default_rng(0)
    write_image(tmp_path / "2.png", rng.integers(0, 256, (240, 320, 3)).astype(np.uint8))
    with page_of(localizer, live=str(tmp_path)) as page, visited(browser, page.url) as (visit, _):
        seen_until(visit, "the stream has ended")
        seen_until(visit, "lost")


@pytest.mark.slow
def test_play_goes_on_until_it_is_unchecked(
    localizer: Localizer, hall: Recording, files: Path, browser: Any
) -> None:
    first, second = (frame.name for frame in hall.test[7:9])
    with (
        page_of(localizer, recording=files / "hall") as page,
        visited(browser, page.url) as (visit, errors),
    ):
        seen_until(visit, first)
        visit.get_by_label("Play").check()
        for name in (second, first, second):
            seen_until(visit, name)
        visit.get_by_label("Play").uncheck()
        visit.wait_for_timeout(3000)
        stays = [visit.get_by_text(name).count() for name in (first, second)]
        visit.wait_for_timeout(3000)
        assert [visit.get_by_text(name).count() for name in (first, second)] == stays
        assert sorted(stays) == [0, 1]
        assert errors == []


@pytest.mark.slow
def test_a_paused_camera_goes_on_with_what_it_sees_now(
    localizer: Localizer, hall: Recording, browser: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from evercal.recordings.streams import StreamFrame
    from evercal.service.viewer import live

    image, given = hall.test[7].read_image(), [0]

    def camera(source: str) -> Iterator[StreamFrame]:
        while True:
            given[0] += 1
            yield StreamFrame(f"shot-{given[0]}", time.time(), image)
            time.sleep(0.05)

    def shown(visit: Any) -> int:
        return int(visit.get_by_text("shot-").first.inner_text().split("-")[-1])

    monkeypatch.setattr(live, "stream", camera)
    with page_of(localizer, live="0") as page, visited(browser, page.url) as (visit, errors):
        seen_until(visit, "tracking")
        visit.get_by_label("Pause").check()
        visit.wait_for_timeout(4000)
        paused, meanwhile = shown(visit), given[0]
        visit.wait_for_timeout(2000)
        assert shown(visit) == paused
        assert given[0] > meanwhile, "the buffer of the camera is emptied"
        now = given[0]
        visit.get_by_label("Pause").uncheck()
        visit.wait_for_timeout(4000)
        assert shown(visit) >= now
        assert errors == []


@pytest.mark.slow
def test_a_clicked_keyframe_is_looked_through_until_back(
    localizer: Localizer, browser: Any
) -> None:
    with page_of(localizer) as page, visited(browser, page.url) as (visit, errors):
        seen_until(visit, "Click a keyframe")
        visit.wait_for_timeout(3000)
        (client,) = page.server.get_clients().values()
        before = np.array(client.camera.position)
        view, place = next(
            (view, place)
            for view in page.stage.keyframes[0]
            if (place := on_screen(client.camera, view.frustum.corners(0.01).mean(0), (1200, 800)))
            and place[0] < 600
            and page.stage.keyframe_at(*ray(client.camera, place, (1200, 800))) is view
        )
        visit.mouse.click(*place)
        seen_until(visit, f"{view.number} of {view.scene}")
        visit.wait_for_timeout(3000)
        pose = view.frustum.base_from_camera
        np.testing.assert_allclose(client.camera.position, pose.translation_m, atol=0.01)
        click(visit, "Back to the overview")
        seen_until(visit, "Click a keyframe")
        visit.wait_for_timeout(3000)
        np.testing.assert_allclose(client.camera.position, before, atol=0.01)
        assert errors == []


def on_screen(camera: Any, point: np.ndarray, size: tuple[int, int]) -> tuple[float, float] | None:
    """Pixel of a point for a visitor's camera; None outside of the window."""
    x, y, z = SE3(np.array(camera.wxyz), np.array(camera.position)).inverse().apply(point)
    focal = size[1] / 2 / np.tan(camera.fov / 2)
    place = float(size[0] / 2 + focal * x / z), float(size[1] / 2 + focal * y / z)
    inside = z > 0 and all(0 < p < s for p, s in zip(place, size, strict=True))
    return place if inside else None


def ray(camera: Any, place: tuple[float, float], size: tuple[int, int]) -> tuple[Any, Any]:
    """Origin and direction of a pixel for a visitor's camera."""
    pose = SE3(np.array(camera.wxyz), np.array(camera.position))
    focal = size[1] / 2 / np.tan(camera.fov / 2)
    ahead = np.array([(place[0] - size[0] / 2) / focal, (place[1] - size[1] / 2) / focal, 1.0])
    return pose.translation_m, pose.rotation_matrix() @ ahead


def pixels(picture: bytes) -> np.ndarray:
    import cv2

    image = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return np.asarray(image)
