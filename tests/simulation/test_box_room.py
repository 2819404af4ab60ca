"""Box rooms: pixels against rays in closed form, poses, and the scene they make on disk."""

import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from evercal.geometry import SE3, Camera, pose_distance
from evercal.recordings import generic, load_recording
from evercal.simulation import box_room
from evercal.simulation.box_room import (
    BoxRoom,
    Surface,
    box_room_scene,
    default_camera,
    look_at,
)

LENS = Camera(160, 120, 140.0, 135.0, 83.0, 57.0)
SEEDS = (11, 12, 13)


@pytest.fixture(scope="module")
def boxes() -> list[BoxRoom]:
    return [BoxRoom(seed, texture_px=32) for seed in SEEDS]


def painted(room: BoxRoom) -> tuple[BoxRoom, np.ndarray]:
    """The room with every surface in a colour of its own, and the colours (n, 3)."""
    colours = np.array([[40 + 2 * i, 255 - 2 * i, (37 * i) % 256] for i in range(100)], np.uint8)
    copy = BoxRoom.__new__(BoxRoom)
    copy.seed, copy.size_m = room.seed, room.size_m
    copy.surfaces = [
        replace(surface, pyramid=(np.full((4, 4, 3), colour, np.uint8),))
        for surface, colour in zip(room.surfaces, colours, strict=False)
    ]
    return copy, colours


def hit_by_hand(surfaces: list[Surface], origin: np.ndarray, ray: np.ndarray) -> tuple[int, float]:
    """Index of the first surface that a ray meets from its front, and its depth; by 3x3 systems."""
    best, depth = -1, np.inf
    for i, surface in enumerate(surfaces):
        normal = np.cross(surface.edge_u_m, surface.edge_v_m)
        if ray @ normal >= 0:
            continue
        system = np.stack([surface.edge_u_m, surface.edge_v_m, -ray], -1)
        u, v, t = np.linalg.solve(system, origin - surface.corner_m)
        if 0 <= u <= 1 and 0 <= v <= 1 and 0 < t < depth:
            best, depth = i, t
    return best, depth


def test_intersect_agrees_with_a_slow_twin(boxes: list[BoxRoom]) -> None:
    rng = np.random.default_rng(0)
    for room in boxes:
        origin = room.random_view(rng).translation_m
        rays = rng.normal(size=(150, 3))
        points, depth = room.intersect(origin, rays)
        for ray, point, found in zip(rays, points, depth, strict=True):
            _, expected = hit_by_hand(room.surfaces, origin, ray)
            assert found == pytest.approx(expected, abs=1e-9)
            np.testing.assert_allclose(point, origin + expected * ray, atol=1e-9)


def test_intersect_takes_one_origin_per_ray(boxes: list[BoxRoom]) -> None:
    rng = np.random.default_rng(1)
    origins = np.stack([boxes[0].random_view(rng).translation_m for _ in range(20)])
    rays = rng.normal(size=(20, 3))
    points, depth = boxes[0].intersect(origins, rays)
    for i in range(20):
        alone, far = boxes[0].intersect(origins[i], rays[i : i + 1])
        np.testing.assert_allclose(points[i], alone[0], atol=1e-12)
        assert depth[i] == pytest.approx(far[0])


def test_a_ray_that_leaves_the_room_hits_nothing(boxes: list[BoxRoom]) -> None:
    outside = np.array([0.0, 0.0, 50.0])
    points, depth = boxes[0].intersect(outside, np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]))
    assert np.isnan(points[0]).all()
    assert depth[0] == np.inf
    # From above the ceiling is seen from behind and lets the ray through.
    assert depth[1] < 50.0 + 1e-9


def test_every_ray_from_inside_ends_within_the_walls(boxes: list[BoxRoom]) -> None:
    rng = np.random.default_rng(2)
    for room in boxes:
        low = np.array([*-room.size_m[:2] / 2, 0.0])
        for _ in range(5):
            eye = room.random_view(rng).translation_m
            points, depth = room.intersect(eye, rng.normal(size=(200, 3)))
            assert np.isfinite(depth).all()
            assert (points > low - 1e-9).all()
            assert (points < low + room.size_m + 1e-9).all()


def test_the_colour_of_a_pixel_is_that_of_the_surface_its_ray_meets(boxes: list[BoxRoom]) -> None:
    rng = np.random.default_rng(3)
    for room in boxes:
        room, colours = painted(room)
        shown = set()
        for _ in range(3):
            pose = room.random_view(rng)
            image = room.render(LENS, pose)
            u, v = rng.integers(0, 160, 120), rng.integers(0, 120, 120)
            rays = LENS.unproject(np.stack([u, v], -1)) @ pose.rotation_matrix().T
            off = 0
            for k, ray in enumerate(rays):
                i, _ = hit_by_hand(room.surfaces, pose.translation_m, ray)
                shown.add(i)
                off += int((image[v[k], u[k]] != colours[i]).any())
            assert off <= 1  # a ray that grazes an edge may round to the other side
        assert len(shown) > 5


def test_a_pixel_looks_at_the_right_place_to_a_twentieth_of_a_pixel() -> None:
    """A ramp of one grey level per texel over a wall says where each pixel looks."""
    ramp = np.arange(20, 236, dtype=np.uint8)
    texture = np.tile(ramp[None, :, None], (len(ramp), 1, 3))
    room = BoxRoom(11, furniture=0, texture_px=32)
    edge_u, edge_v = np.array([2.0, 0, 0]), np.array([0, 0, 2.0])  # facing -y, to the camera
    wall = Surface(np.array([-1.0, 2.0, 0.0]), edge_u, edge_v, (texture,))
    room.surfaces = [wall]
    pose = look_at(np.array([0.1, 0.0, 1.0]), np.array([0.2, 2.0, 1.1]), 0.2)
    found = room.render(LENS, pose).astype(float)[..., 0].ravel()
    u, v = (axis.ravel() for axis in np.meshgrid(np.arange(160), np.arange(120)))
    rays = LENS.unproject(np.stack([u, v], -1)) @ pose.rotation_matrix().T
    points, _ = room.intersect(pose.translation_m, rays)
    across = (points - wall.corner_m) @ edge_u / (edge_u @ edge_u)
    seen = (across > 0.02) & (across < 0.98)
    expected = 20 + across * len(ramp) - 0.5  # the middle of texel k is (k + 0.5) / n across
    error = (found - expected)[seen]
    assert seen.sum() > 2000
    assert np.abs(error).max() < 1.0  # one texel, which is 0.65 of a pixel, from rounding
    assert abs(error.mean()) < 0.05


def test_a_small_image_is_the_large_one_shrunk() -> None:
    """Far surfaces show smaller copies of their textures, which must not be moved ones."""
    room, large = BoxRoom(14, texture_px=256), LENS.resized(640, 480)
    for seed in range(3):
        pose = room.random_view(np.random.default_rng(seed))
        expected = cv2.resize(room.render(large, pose), (160, 120), interpolation=cv2.INTER_AREA)
        images = [image.mean(-1) for image in (room.render(LENS, pose), expected)]
        found, expected = (cv2.GaussianBlur(image, (0, 0), 1.2) for image in images)
        slopes = np.stack([-g.ravel() for g in np.gradient(expected)], -1)
        moved = np.linalg.lstsq(slopes, (found - expected).ravel(), rcond=None)[0]
        assert np.abs(moved).max() < 0.08  # pixels


def test_walls_face_inwards(boxes: list[BoxRoom]) -> None:
    for room in boxes:
        middle = np.array([0, 0, room.size_m[2] / 2])
        for surface in room.surfaces[:6]:
            assert (middle - surface.corner_m) @ surface.normal > 0


def test_far_surfaces_are_smoothed_against_aliasing() -> None:
    """One pixel covers many texels of a far wall, so noise there must average out."""
    noise = np.random.default_rng(0).integers(0, 256, (256, 256, 3)).astype(np.uint8)
    room = BoxRoom(11, furniture=0, texture_px=256)
    pyramid = room.surfaces[0].pyramid
    assert [level.shape[0] for level in pyramid] == [256, 128, 64, 32, 16]
    levels = [noise]
    while levels[-1].shape[0] > 16:
        levels.append(cv2.pyrDown(levels[-1]).astype(np.uint8))
    corner, edge_u, edge_v = np.array([0.5, 0, -0.5]), np.array([-1.0, 0, 0]), np.array([0, 0, 1.0])

    def deviation(distance: float, levels: list[np.ndarray]) -> float:
        wall = Surface(corner, edge_u, edge_v, tuple(levels))
        room.surfaces = [wall]
        image = room.render(LENS, look_at(distance * wall.normal, np.zeros(3)))
        return float(image[image.any(-1)].std())

    # At 4 m a pixel covers 7 texels; without the smaller copies it would show one of them.
    assert deviation(4.0, levels) < 0.35 * deviation(4.0, levels[:1])
    assert deviation(4.0, levels) < 0.5 * deviation(1.0, levels)


def test_same_seed_same_pixels() -> None:
    pose = look_at(np.array([0.1, 0.2, 1.2]), np.array([1.0, 0.4, 1.0]))
    first, again, other = (BoxRoom(seed, texture_px=64).render(LENS, pose) for seed in (5, 5, 6))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any(-1).mean() > 0.9


def test_distortion_is_refused(boxes: list[BoxRoom]) -> None:
    lens = replace(LENS, distortion=(-0.2, 0.05, 0.0, 0.0))
    with pytest.raises(ValueError, match="distortion"):
        boxes[0].render(lens, SE3.identity())


def test_furniture_and_size_follow_the_arguments() -> None:
    bare, full = BoxRoom(7, furniture=0, texture_px=16), BoxRoom(7, furniture=9, texture_px=16)
    np.testing.assert_array_equal(bare.size_m, full.size_m)
    assert 6 + 4 <= len(bare.surfaces) <= 6 + 12
    assert 6 + 45 + 4 <= len(full.surfaces) <= 6 + 45 + 12


@pytest.mark.parametrize("frames", [60, 200])
def test_paths_are_smooth_closed_and_inside_the_room(boxes: list[BoxRoom], frames: int) -> None:
    for room in boxes:
        path = room.path(frames, 1)
        assert path.shape == (frames,)
        eye = path.translation_m
        assert (np.abs(eye[:, :2]) < room.size_m[:2] / 2 - 0.5).all()
        assert (eye[:, 2] > 0.7).all()
        assert (eye[:, 2] < room.size_m[2] - 0.2).all()
        metres, radians = pose_distance(path, path[np.roll(np.arange(frames), -1)])
        # Once around in `frames` steps; a jump would be metres and radians.
        assert metres.max() < 30 / frames
        assert radians.max() < 30 / frames
        # The sweep turns all the way round.
        heading = np.unwrap(np.arctan2(*path.rotation_matrix()[:, [1, 0], 2].T))
        assert abs(heading[-1] - heading[0]) > 1.7 * np.pi


def test_train_and_test_paths_differ_but_look_at_the_same_room(boxes: list[BoxRoom]) -> None:
    for room in boxes:
        train, test = room.path(100, 1), room.path(100, 2)
        metres, radians = pose_distance(train[:, None], test[None])
        near = (metres < 0.05) & (radians < np.deg2rad(5))
        assert near.any(0).mean() < 0.2
        # The same way as another person walks it, neither on the spot nor somewhere else.
        assert 0.03 < np.median(np.diag(metres)) < 0.4
        assert np.median(np.diag(radians)) < np.deg2rad(20)
        np.testing.assert_array_equal(train.translation_m, room.path(100, 1).translation_m)


@pytest.mark.parametrize("frames", [0, 1, 2])
def test_the_shortest_paths(boxes: list[BoxRoom], frames: int) -> None:
    path = boxes[0].path(frames, 1)
    assert path.shape == (frames,)
    assert np.isfinite(path.translation_m).all()


def test_look_at_axes() -> None:
    pose = look_at(np.array([1.0, 2.0, 1.5]), np.array([1.0, 5.0, 1.5]))
    x, y, z = pose.rotation_matrix().T
    np.testing.assert_allclose(z, [0, 1, 0], atol=1e-12)  # forward, to the target
    np.testing.assert_allclose(x, [1, 0, 0], atol=1e-12)  # right
    np.testing.assert_allclose(y, [0, 0, -1], atol=1e-12)  # down
    np.testing.assert_allclose(pose.translation_m, [1.0, 2.0, 1.5])


def test_roll_turns_the_camera_clockwise_about_its_axis() -> None:
    eye, target = np.array([0.3, -0.2, 1.0]), np.array([2.0, 0.7, 0.4])
    level, rolled = look_at(eye, target), look_at(eye, target, 0.3)
    turn = (level.inverse() @ rolled).log()
    np.testing.assert_allclose(turn, [0, 0, 0, 0, 0, 0.3], atol=1e-12)
    aim = LENS.project(rolled.inverse().apply(target))
    np.testing.assert_allclose(aim, [LENS.cx, LENS.cy], atol=1e-9)


def test_random_views_are_inside_and_near_upright(boxes: list[BoxRoom]) -> None:
    rng = np.random.default_rng(4)
    for room in boxes:
        for _ in range(50):
            pose = room.random_view(rng)
            assert (np.abs(pose.translation_m[:2]) < room.size_m[:2] / 2).all()
            assert 0.5 <= pose.translation_m[2] <= 0.8 * room.size_m[2]
            assert pose.rotation_matrix()[2, 1] < -0.7  # camera's y points down


def test_default_camera_sees_63_degrees() -> None:
    for width, height in ((320, 240), (640, 480)):
        rays = default_camera(width, height).unproject([[-0.5, height / 2], [width - 0.5, 0]])
        angle = np.rad2deg(np.arctan(rays[1, 0]) - np.arctan(rays[0, 0]))
        assert angle == pytest.approx(62.7, abs=0.1)


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Coarse textures, drawn sooner."""
    monkeypatch.setattr(box_room, "BoxRoom", partial(BoxRoom, texture_px=32))


@pytest.mark.usefixtures("coarse")
def test_a_scene_survives_the_disk(tmp_path: Path) -> None:
    memory = box_room_scene(21, 3, 2)
    generic.write(tmp_path / "room", memory)
    for loaded in (generic.load(tmp_path / "room"), load_recording(tmp_path / "room")):
        assert loaded.name == memory.name == "box-room-21"
        for split in ("train", "test"):
            frames, expected = getattr(loaded, split), getattr(memory, split)
            assert [frame.name for frame in frames] == [frame.name for frame in expected]
            for frame, twin in zip(frames, expected, strict=True):
                np.testing.assert_array_equal(frame.read_image(), twin.image)
                assert frame.camera == twin.camera
                metres, radians = pose_distance(frame.base_from_camera, twin.base_from_camera)
                assert max(metres, radians) < 1e-9
    assert len(memory.train) == 3
    assert len(memory.test) == 2


@pytest.mark.usefixtures("coarse")
def test_a_scene_takes_its_camera_and_may_have_no_test_frames() -> None:
    scene = box_room_scene(21, 2, 0, LENS)
    assert scene.test == ()
    assert scene.train[0].camera == LENS
    assert scene.train[0].read_image().shape == (120, 160, 3)


def test_a_frame_is_drawn_in_well_under_100_ms() -> None:
    room, camera = BoxRoom(31, texture_px=128), default_camera()
    poses = room.path(9, 1)
    room.render(camera, poses[0])
    seconds = []
    for pose in poses:
        began = time.process_time()
        room.render(camera, pose)
        seconds.append(time.process_time() - began)
    assert np.median(seconds) < 0.1
