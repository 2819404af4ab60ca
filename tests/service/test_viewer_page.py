"""The page of the 3D view: what it draws, what it refuses, and a browser that shows it."""

from __future__ import annotations

import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal
from unittest.mock import MagicMock

import numpy as np
import pytest

pytest.importorskip("viser")

from evercal.calibration.calibration import Calibration
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, pose_distance
from evercal.reports.scene import Frustum, KeyframeView
from evercal.service.viewer import drawing
from evercal.service.viewer.drawing import GRIPPER, add_arm, add_calibrations
from evercal.service.viewer.html import chip_html, rows_html
from evercal.service.viewer.overview import FOV_RAD, overview
from evercal.service.viewer.page import Page, backdrop, start_server

from .browsing import seen_until, shot, visited

if TYPE_CHECKING:
    from evercal.localization.localizer import Localizer

ARM = """<robot name="arm">
  <link name="base"><visual><geometry><box size="0.1 0.1 0.1"/></geometry></visual></link>
  <link name="gripper"><visual><geometry><box size="0.05 0.05 0.2"/></geometry></visual></link>
  <joint name="turn" type="revolute">
    <parent link="base"/><child link="gripper"/><origin xyz="0 0 0.5"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/>
  </joint>
</robot>"""
HAND = SE3.exp([0.05, 0.0, 0.02, 0.0, 0.1, 1.5])


@pytest.fixture(scope="module")
def localizer(hall_map) -> Localizer:
    from evercal.localization.localizer import Localizer

    return Localizer(hall_map)


@contextmanager
def page_of(localizer: Localizer, *given: Any) -> Iterator[Page]:
    page = Page(localizer, *given)
    try:
        yield page
    finally:
        page.close()


def calibration(
    mount: Literal["eye_in_hand", "eye_to_hand"], **more: Any
) -> Calibration:
    return Calibration(
        mount, HAND, np.diag([1e-6, 4e-6, 9e-6, 1e-8, 1e-8, 1e-8]), **more
    )


def test_backdrop_shows_each_pixel_where_the_camera_sees_it():
    # Its centre is far from that of the image.
    camera = Camera(64, 48, 50.0, 55.0, 20.0, 30.0)
    pose = SE3.exp([0.1, 0.2, 0.3, 0.5, -0.4, 0.3])
    image = np.zeros((48, 64, 3), np.uint8)
    frustum = Frustum.of(pose, camera)
    view = KeyframeView("room", 0, frustum, camera, image, np.array([2.0]))
    centre_m, width_m, height_m = backdrop(view)
    across, down = pose.rotation_matrix()[:, :2].T
    across *= width_m / 2
    down *= height_m / 2
    corners = centre_m + np.stack([-across - down, across - down, across + down])
    pixels = camera.project(pose.inverse().apply(corners))
    expected = [(-0.5, -0.5), (63.5, -0.5), (63.5, 47.5)]
    np.testing.assert_allclose(pixels, expected, atol=1e-9)


def test_an_address_that_cannot_be_used_is_refused():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=f"`port` {port}: Address already in use"):
            start_server("127.0.0.1", port, "page")
    with pytest.raises(InputError, match="`port` 99999: give 0 to 65535"):
        start_server("127.0.0.1", 99999, "page")


def test_the_server_is_not_shared_over_a_relay_and_says_nothing(capfd):
    server = start_server("127.0.0.1", 0, "page")
    assert server.request_share_url() is None
    server.stop()
    assert capfd.readouterr().out == ""


def test_a_bad_file_is_named(localizer, tmp_path):
    bent = tmp_path / "bent.urdf"
    bent.write_text("<robot")
    gone = tmp_path / "gone.urdf"
    with pytest.raises(InputError, match=r"bent.urdf: no usable URDF"):
        Page(localizer, (), bent)
    with pytest.raises(InputError, match=r"gone.urdf: no such URDF file"):
        Page(localizer, (), gone)
    with pytest.raises(InputError, match=r"bent.urdf: "):
        Page(localizer, (bent,))
    with page_of(localizer) as page, pytest.raises(InputError, match="no such folder"):
        page.track(str(gone))


def test_drawing_an_arm_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "yourdfpy", None)
    (tmp_path / "arm.urdf").write_text(ARM)
    node: Any = None
    with pytest.raises(InputError, match=r"constraints.txt '\.\[urdf\]'"):
        add_arm(node, tmp_path / "arm.urdf", node, [])


def test_the_gripper_follows_the_joints(tmp_path):
    (tmp_path / "arm.urdf").write_text(ARM)
    server = start_server("127.0.0.1", 0, "page")
    try:
        node = server.scene.add_frame(GRIPPER, visible=False)
        (slider,) = add_arm(server, tmp_path / "arm.urdf", node, ["tool", "gripper"])
        assert node.visible
        np.testing.assert_allclose(node.position, [0, 0, 0.5], atol=1e-9)
        slider.value = 0.7
        rotation = SE3(np.array(node.wxyz), np.zeros(3)).rotation_matrix()
        np.testing.assert_allclose(
            rotation[0], [np.cos(0.7), -np.sin(0.7), 0], atol=1e-9
        )
    finally:
        server.stop()


def test_the_arm_stands_at_the_base_that_is_named(tmp_path, monkeypatch):
    """Beside `base_link`, Universal Robots have `base`, turned by 180 degrees."""
    turned = (
        '<link name="turned"/><joint name="half" type="fixed"><parent link="base"/>'
        '<child link="turned"/><origin rpy="0 0 3.141592653589793"/></joint></robot>'
    )
    (tmp_path / "arm.urdf").write_text(ARM.replace("</robot>", turned))
    placed = {}
    monkeypatch.setattr(
        drawing, "place", lambda node, pose: placed.update({node.name: pose})
    )
    for bases, expected in ((["", "turned"], -1.0), (["", "unknown"], 1.0)):
        server = start_server("127.0.0.1", 0, "page")
        try:
            node = server.scene.add_frame(GRIPPER, visible=False)
            add_arm(server, tmp_path / "arm.urdf", node, ["gripper"], bases)
        finally:
            server.stop()
        assert placed.keys() == {"/robot", GRIPPER}
        for pose in placed.values():
            found = pose.rotation_matrix()[0, 0]
            assert found == pytest.approx(expected, abs=1e-9)


def test_calibrations_have_their_place_and_ellipsoid():
    """The standard deviations 1, 2 and 3 mm are drawn ten times as large."""
    server = MagicMock()
    drawn = MagicMock()
    drawn.node = lambda scene: f"/map/{scene}"
    fixed = calibration("eye_to_hand", source={"scene": "hall"})
    given = {"w/rist": calibration("eye_in_hand"), "tripod": fixed}
    add_calibrations(server, given, drawn, Camera(64, 48, 50.0, 50.0, 31.5, 23.5), 0.1)
    cameras = server.scene.add_camera_frustum.call_args_list
    assert [call.args[0] for call in cameras] == [
        f"{GRIPPER}/w_rist",
        "/map/hall/tripod",
    ]
    for call in cameras:
        pose = SE3(call.kwargs["wxyz"], call.kwargs["position"])
        assert max(pose_distance(pose, HAND)) < 1e-12
    words = server.scene.add_label.call_args.args[1]
    assert words == "tripod: 2.2 mm (1 sigma), ellipsoid x 10"
    ellipsoid = server.scene.add_icosphere.call_args.kwargs
    np.testing.assert_allclose(ellipsoid["scale"], [0.01, 0.02, 0.03], rtol=1e-6)


def test_a_keyframe_is_looked_through_until_back(localizer):
    with page_of(localizer) as page:
        view = page.map.keyframes["hall"][2]
        client = MagicMock()
        client.camera.image_width = 1056
        client.camera.image_height = 900
        page.look_through(view, client)
        pose = view.frustum.base_from_camera
        seen = SE3(client.camera.wxyz, client.camera.position)
        assert max(pose_distance(seen, pose)) < 1e-12
        assert client.camera.fov == view.frustum.fov_rad
        assert client.scene.add_image.call_args.args[1] is view.image
        page.look_from_above(client)
        removed = client.scene.remove_by_name.call_args.args[0]
        assert removed == client.scene.add_image.call_args.args[0]
        position = client.camera.position
        assert np.linalg.norm(position - pose.translation_m) > 0.1


@pytest.mark.parametrize(
    ("window_px", "picture_px", "free_px"),
    [((1440, 900), (1056, 900), 900), ((390, 844), (390, 844), 354)],
)
def test_the_first_picture_holds_base_arm_and_calibrations_beside_the_panel(
    localizer, tmp_path, window_px, picture_px, free_px
):
    """On a phone the panel lies over the lower part of the picture."""
    (tmp_path / "arm.urdf").write_text(ARM)
    files = [tmp_path / "fixed.json", tmp_path / "wrist.json"]
    calibration("eye_to_hand").write(files[0])
    calibration("eye_in_hand").write(files[1])
    client = MagicMock()
    camera = client.camera
    with page_of(localizer, files, tmp_path / "arm.urdf") as page:
        (begin,) = page.server._client_connect_cb
        for size_px, show in (
            (window_px, begin),
            (picture_px, page.look_from_above),
        ):
            camera.image_width, camera.image_height = size_px
            show(client)
            seen = np.array([[0, 0, 0], HAND.translation_m, [0, 0, 0.5]])
            x, y = pixels_of(camera, seen, picture_px).T
            assert ((x > 0) & (x < picture_px[0])).all()
            assert ((y > 0) & (y < free_px)).all()


def test_cameras_that_look_straight_down_have_an_overview():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0.5]])
    camera = MagicMock(fov=FOV_RAD)
    found = overview(points, np.array([0.0, 0.0, -1.0]), (800, 800))
    camera.position, camera.look_at = found
    pixels = pixels_of(camera, points, (800, 800))
    assert ((pixels > 0) & (pixels < 800)).all()
    assert np.ptp(pixels, axis=0).max() > 700  # nor is it farther away than it must be


def pixels_of(
    camera: Any, points_m: np.ndarray, size_px: tuple[int, int]
) -> np.ndarray:
    """Pixels (n, 2) of points in a picture of viser."""
    width, height = size_px
    forward = np.subtract(camera.look_at, camera.position)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward])
    local = (points_m - camera.position) @ axes.T
    assert (local[:, 2] > 0).all()
    scale = height / 2 / np.tan(camera.fov / 2)
    return scale * local[:, :2] / local[:, 2:] + [width / 2, height / 2]


def test_without_an_arm_the_gripper_is_where_it_took_the_first_keyframe(
    localizer, tmp_path
):
    wrist = calibration("eye_in_hand", source={"scene": "hall"})
    wrist.write(tmp_path / "wrist.json")
    with page_of(localizer, [tmp_path / "wrist.json"]) as page:
        gripper = page.server.scene.add_frame("/other", visible=False)
        camera = page.map.gripper_of(gripper, wrist) @ HAND
        first = page.map.keyframes["hall"][0].frustum.base_from_camera
        assert max(pose_distance(camera, first)) < 1e-9
        assert gripper.visible


def test_surfaces_are_shown_as_in_the_images_and_landmarks_by_a_value(localizer):
    with page_of(localizer) as page:
        (cloud,) = page.map._clouds.values()
        surfaces = page.map._surfaces
        landmarks = page.map.landmarks["hall"]
        assert sum(len(one.points) for one in surfaces) > 3 * len(landmarks)
        for by in ("height", "image"):
            page.map.colour_by(by)
            assert cloud.visible == (by == "height")
            assert {one.visible for one in surfaces} == {by == "image"}


def test_names_of_files_are_no_markup():
    page = rows_html([("<b>", "&")]) + chip_html("<i>", "<script>")
    assert "&lt;b&gt;" in page
    assert "&lt;script&gt;" in page
    assert "<script>" not in page


@pytest.mark.slow("src/evercal/service/viewer")
def test_a_browser_shows_the_map_and_a_tracked_camera(
    localizer, hall, browser, tmp_path
):
    import cv2

    from evercal.recordings import write_image

    pose = hall.train[0].base_from_camera
    assert pose is not None
    file = tmp_path / "tripod.json"
    fixed = Calibration("eye_to_hand", pose, calibration("eye_to_hand").covariance)
    fixed.write(file)
    (tmp_path / "images").mkdir()
    for i in range(3):
        write_image(tmp_path / f"images/{i}.png", hall.test[7 + i].read_image())
    with page_of(localizer, [file]) as page, visited(browser, page.server.url) as visit:
        page.track(str(tmp_path / "images"))
        seen_until(visit, "3 / 2 / 1 mm")
        for text in ("tracking", "ended"):
            seen_until(visit, text)
        picture = cv2.imdecode(
            np.frombuffer(shot(visit, "view"), np.uint8), cv2.IMREAD_GRAYSCALE
        )
        assert picture is not None
        assert len(np.unique(picture)) > 50, "a canvas that shows something"
