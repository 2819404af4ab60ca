"""A room that changes: what is gone leaves the map, and wrong images cannot spoil it."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evercal import InputError, Map, Recording
from evercal.geometry import SE3, Camera, pose_distance
from evercal.localization.estimate import PoseEstimate
from evercal.localization.localizer import Localizer
from evercal.localization.refreshing import RefreshReport, refresh_scene
from evercal.mapping.scene_map import MapContents, SceneMap
from evercal.mapping.store import MapStore
from evercal.recordings.frame import Frame
from evercal.simulation.box_room import BoxRoom, Surface

Refreshed = tuple[SceneMap, RefreshReport]


def truth(frame: Frame) -> SE3:
    assert frame.base_from_camera is not None
    return frame.base_from_camera


def pixels_of(room: BoxRoom, frame: Frame) -> np.ndarray:
    """Return (m, 3) points of the room at every 8th pixel of a frame."""
    v, u = np.mgrid[4 : frame.camera.height : 8, 4 : frame.camera.width : 8]
    rays = frame.camera.unproject(np.stack([u, v], -1).reshape(-1, 2).astype(float))
    pose = truth(frame)
    return room.intersect(pose.translation_m, rays @ pose.rotation_matrix().T)[0]


def on(surface: Surface, points: np.ndarray, margin_m: float = 0.02) -> np.ndarray:
    """Return (n,) whether points lie on a surface."""
    offset = points - surface.corner_m
    inside = np.abs(offset @ surface.normal) < margin_m
    for edge in (surface.edge_u_m, surface.edge_v_m):
        share = offset @ edge / (edge @ edge)
        inside &= (share > -0.02) & (share < 1.02)
    return inside


@pytest.fixture(scope="module")
def changed(hall: Recording, hall_room: BoxRoom) -> tuple[BoxRoom, Surface]:
    """The room after a picture was hung on the wall that all frames show, and the picture."""
    wall = hall_room.surfaces[3]
    middle = np.nanmedian(pixels_of(hall_room, hall.train[15]), axis=0)
    u, v = (edge / np.linalg.norm(edge) for edge in (wall.edge_u_m, wall.edge_v_m))
    corner = middle - 0.45 * u - 0.3 * v + 0.01 * wall.normal
    texture = BoxRoom(77, texture_px=256).surfaces[3].pyramid
    picture = Surface(corner, 0.9 * u, 0.6 * v, texture)
    room = copy(hall_room)
    room.surfaces = [*hall_room.surfaces, picture]
    return room, picture


@pytest.fixture(scope="module")
def images(
    hall: Recording, changed: tuple[BoxRoom, Surface]
) -> list[tuple[str, np.ndarray]]:
    frames = hall.test[::3]
    return [(f.name, changed[0].render(f.camera, truth(f))) for f in frames]


@pytest.fixture(scope="module")
def after(hall_map: MapContents, images: list[tuple[str, np.ndarray]]) -> Refreshed:
    return refresh_scene(Localizer(hall_map), images)


def points_of(scene: SceneMap) -> np.ndarray:
    """Return all landmarks (n, 3) in the frame of the keyframes."""
    keyframes = scene.keyframes
    parts = [
        keyframes.base_from_camera[i].apply(marks.surface(keyframes.cameras[i])[0])
        for i, marks in enumerate(keyframes.landmarks)
    ]
    return np.concatenate(parts)


def test_landmarks_on_the_changed_surface_leave(
    hall_map: MapContents, after: Refreshed, changed: tuple[BoxRoom, Surface]
) -> None:
    before, (scene, report) = hall_map.scenes[0], after
    gone_share = report.landmarks_gone / report.landmarks_checked
    assert 0.05 < gone_share < 0.5
    stays = {image: i for i, image in enumerate(scene.keyframes.images)}
    kept = [i for i, image in enumerate(before.keyframes.images) if image in stays]
    assert kept
    for i in kept:
        j = stays[before.keyframes.images[i]]
        # A kept keyframe keeps its pose: it holds the base frame.
        new = scene.keyframes.base_from_camera[j]
        old = before.keyframes.base_from_camera[i]
        np.testing.assert_allclose(new.matrix(), old.matrix(), rtol=0, atol=1e-12)
        pose = old
        camera = before.keyframes.cameras[i]
        left = {tuple(p) for p in scene.keyframes.landmarks[j].pixels.tolist()}
        marks = before.keyframes.landmarks[i]
        missing = np.array([tuple(p) not in left for p in marks.pixels.tolist()])
        there = on(changed[1], pose.apply(marks.surface(camera)[0]), 0.05)
        assert missing[there].mean() > 0.6
        assert missing[~there].mean() < 0.15


def test_memory_stays_and_images_are_located_as_well_as_before(
    hall: Recording,
    hall_map: MapContents,
    after: Refreshed,
    changed: tuple[BoxRoom, Surface],
) -> None:
    before, (scene, report) = hall_map.scenes[0], after
    assert len(scene.keyframes) == len(before.keyframes)
    assert scene.keyframes.bytes < 1.1 * before.keyframes.bytes
    localizer = Localizer(replace(hall_map, scenes=[scene]))
    errors = []
    for frame in hall.test[1::6]:
        estimate = localizer.localize(changed[0].render(frame.camera, truth(frame)))
        assert estimate.status == "ok"
        assert estimate.base_from_camera is not None
        errors.append(pose_distance(estimate.base_from_camera, truth(frame))[0])
    assert np.median(errors) < 0.004
    # The stated bound of the shift contains the mean error.
    assert report.shift_mm is not None
    assert report.shift_sigma_mm is not None
    assert report.shift_mm < 3 * max(report.shift_sigma_mm, 0.3)


def test_wrong_images_are_left_out(
    hall_map: MapContents, images: list[tuple[str, np.ndarray]], after: Refreshed
) -> None:
    rng = np.random.default_rng(0)
    other = BoxRoom(55, texture_px=256)
    pose = SE3.exp([0, 0, 1.2, 0.3, 0.1, 0.2])
    camera = hall_map.scenes[0].camera
    wrong = [
        ("other.png", other.render(camera, pose)),
        ("noise.png", rng.integers(0, 255, (240, 320, 3)).astype(np.uint8)),
        ("dark.png", np.zeros((240, 320, 3), np.uint8)),
    ]
    scene, report = refresh_scene(
        Localizer(hall_map), [*images[:4], *wrong, *images[4:]]
    )
    assert {name for name, _ in wrong} <= set(report.left_out)
    assert report.located == after[1].located
    assert np.array_equal(points_of(scene), points_of(after[0]))


def test_a_refresh_that_loses_its_only_image_outside_is_refused(
    hall_map: MapContents,
    images: list[tuple[str, np.ndarray]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Without an image outside the map, the shift of the base frame is unknown, not zero."""
    few = images[:5]
    localize = Localizer.localize

    def blind(self: Localizer, image: np.ndarray, *given: Any) -> PoseEstimate:
        estimate = localize(self, image, *given)
        refreshed = self.contents is not hall_map
        return (
            replace(estimate, status="failed", reason="weak") if refreshed else estimate
        )

    monkeypatch.setattr(Localizer, "localize", blind)
    with pytest.raises(InputError, match=r"locates 0 of 1 images .*unchanged"):
        refresh_scene(Localizer(hall_map), few)


def test_images_of_a_recording_have_their_own_cameras(
    hall: Recording,
    hall_map: MapContents,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    MapStore(tmp_path, MapContents(hall_map.encoder, 240)).commit(
        hall_map.scenes[0], {}
    )
    cameras = [Camera(320, 240, f, f, 160, 120) for f in (200, 210)]
    train = tuple(
        replace(f, camera=c) for f, c in zip(hall.test, cameras, strict=False)
    )
    given = []

    def localize(
        self: Localizer, image: np.ndarray, camera: Camera | None = None
    ) -> PoseEstimate:
        given.append(camera)
        return PoseEstimate("failed", "", None, None, None, 0, 0, 0)

    monkeypatch.setattr(Localizer, "localize", localize)
    with pytest.raises(InputError, match="0 of 2 images"):
        Map.open(tmp_path).refresh(replace(hall, train=train))
    assert given == cameras


def test_a_refresh_is_refused_or_undone_as_a_whole(
    hall: Recording,
    hall_map: MapContents,
    images: list[tuple[str, np.ndarray]],
    tmp_path: Path,
    tree: Callable[..., dict[str, str]],
) -> None:
    contents = MapContents(hall_map.encoder, hall_map.short_side)
    MapStore(tmp_path / "map", contents).commit(hall_map.scenes[0], {})
    before = tree(tmp_path / "map")
    opened = Map.open(tmp_path / "map")
    other = BoxRoom(55, texture_px=256)
    camera = hall.train[0].camera
    wrong = [
        other.render(camera, SE3.exp([0.05 * i, 0, 1.2, 0.3, 0.1, 0.2]))
        for i in range(2)
    ]
    with pytest.raises(
        InputError, match=r"0 of 2 images are located precisely.*unchanged"
    ):
        opened.refresh(wrong)
    with pytest.raises(InputError, match="no refresh to undo"):
        opened.undo_refresh("hall")
    assert tree(tmp_path / "map") == before
    image = hall.test[5].read_image()
    first = opened.localize(image).base_from_camera
    opened.refresh([pixels for _, pixels in images[:6]])
    again = Map.open(tmp_path / "map").localize(image).base_from_camera
    assert first is not None
    assert again is not None
    assert not np.array_equal(again.matrix(), first.matrix())
    opened.undo_refresh("hall")
    for cell in (opened, Map.open(tmp_path / "map")):
        back = cell.localize(image).base_from_camera
        assert back is not None
        assert np.array_equal(back.matrix(), first.matrix())
    with pytest.raises(InputError, match="no refresh to undo"):
        opened.undo_refresh("hall")
