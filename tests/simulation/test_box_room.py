"""Box rooms: pixels against rays in closed form, paths, and recordings."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from evercal.geometry import SE3, Camera, pose_distance
from evercal.simulation.box_room import BoxRoom, Surface, look_at

CAMERA = Camera(160, 120, 140.0, 135.0, 83.0, 57.0)
SEEDS = (11, 12)


@pytest.fixture(scope="module")
def boxes() -> list[BoxRoom]:
    return [BoxRoom(seed, texture_px=32) for seed in SEEDS]


def single_coloured(room: BoxRoom) -> tuple[BoxRoom, np.ndarray]:
    """The room with one colour for each surface, and the colours (n, 3)."""
    colours = np.array(
        [[40 + 2 * i, 255 - 2 * i, (37 * i) % 256] for i in range(100)], np.uint8
    )
    copy = BoxRoom.__new__(BoxRoom)
    copy.seed = room.seed
    copy.size_m = room.size_m
    copy.surfaces = [
        replace(surface, pyramid=(np.full((4, 4, 3), colour, np.uint8),))
        for surface, colour in zip(room.surfaces, colours, strict=False)
    ]
    return copy, colours


def first_hit(
    surfaces: list[Surface], origin: np.ndarray, ray: np.ndarray
) -> tuple[int, float]:
    """Index and depth of the first surface that faces a ray; solves 3x3 systems."""
    best = -1
    depth = np.inf
    for i, surface in enumerate(surfaces):
        normal = np.cross(surface.edge_u_m, surface.edge_v_m)
        if ray @ normal >= 0:
            continue
        system = np.stack([surface.edge_u_m, surface.edge_v_m, -ray], -1)
        u, v, t = np.linalg.solve(system, origin - surface.corner_m)
        if 0 <= u <= 1 and 0 <= v <= 1 and 0 < t < depth:
            best = i
            depth = t
    return best, depth


def test_intersections_match_a_slow_reference(boxes: list[BoxRoom]) -> None:
    rng = np.random.default_rng(0)
    for room in boxes:
        origin = room.random_view(rng).translation_m
        rays = rng.normal(size=(60, 3))
        points, depth = room.intersect(np.tile(origin, (60, 1)), rays)
        for ray, point, measured in zip(rays, points, depth, strict=True):
            _, expected = first_hit(room.surfaces, origin, ray)
            assert measured == pytest.approx(expected, abs=1e-9)
            np.testing.assert_allclose(point, origin + expected * ray, atol=1e-9)


def test_rays_that_miss_the_room_have_no_depth(boxes: list[BoxRoom]) -> None:
    outside = np.array([0.0, 0.0, 50.0])
    points, depth = boxes[0].intersect(
        outside, np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    )
    assert np.isnan(points[0]).all()
    assert depth[0] == np.inf
    # From above, the ray passes through the back side of the ceiling.
    assert depth[1] < 50.0 + 1e-9


def test_rays_from_inside_end_at_the_walls(boxes: list[BoxRoom]) -> None:
    rng = np.random.default_rng(2)
    for room in boxes:
        low = np.array([*-room.size_m[:2] / 2, 0.0])
        for _ in range(5):
            eye = room.random_view(rng).translation_m
            points, depth = room.intersect(eye, rng.normal(size=(200, 3)))
            assert np.isfinite(depth).all()
            assert (points > low - 1e-9).all()
            assert (points < low + room.size_m + 1e-9).all()


def test_pixels_have_the_colour_of_the_surface_on_their_ray(
    boxes: list[BoxRoom],
) -> None:
    rng = np.random.default_rng(3)
    for room in boxes:
        room, colours = single_coloured(room)
        surfaces = set()
        for _ in range(2):
            pose = room.random_view(rng)
            image = room.render(CAMERA, pose)
            u = rng.integers(0, 160, 100)
            v = rng.integers(0, 120, 100)
            rays = CAMERA.unproject(np.stack([u, v], -1)) @ pose.rotation_matrix().T
            errors = 0
            for k, ray in enumerate(rays):
                i, _ = first_hit(room.surfaces, pose.translation_m, ray)
                surfaces.add(i)
                errors += int((image[v[k], u[k]] != colours[i]).any())
            assert errors <= 1  # a ray along an edge can round to the other side
        assert len(surfaces) > 5


def test_pixels_sample_the_texture_at_their_ray() -> None:
    """A ramp of one grey level per texel encodes the position on a wall."""
    ramp = np.arange(20, 236, dtype=np.uint8)
    texture = np.tile(ramp[None, :, None], (len(ramp), 1, 3))
    room = BoxRoom(11, furniture=0, texture_px=32)
    edge_u = np.array([2.0, 0, 0])
    edge_v = np.array([0, 0, 2.0])  # facing -y, to the camera
    wall = Surface(np.array([-1.0, 2.0, 0.0]), edge_u, edge_v, (texture,))
    room.surfaces = [wall]
    pose = look_at(np.array([0.1, 0.0, 1.0]), np.array([0.2, 2.0, 1.1]), 0.2)
    measured = room.render(CAMERA, pose).astype(float)[..., 0].ravel()
    u, v = (axis.ravel() for axis in np.meshgrid(np.arange(160), np.arange(120)))
    rays = CAMERA.unproject(np.stack([u, v], -1)) @ pose.rotation_matrix().T
    points, _ = room.intersect(pose.translation_m, rays)
    across = (points - wall.corner_m) @ edge_u / (edge_u @ edge_u)
    inside = (across > 0.02) & (across < 0.98)
    # The middle of texel k is (k + 0.5) / n across.
    expected = 20 + across * len(ramp) - 0.5
    error = (measured - expected)[inside]
    assert inside.sum() > 2000
    # One texel, which is 0.65 of a pixel, from rounding.
    assert np.abs(error).max() < 1.0
    assert abs(error.mean()) < 0.05


def test_small_and_large_images_agree() -> None:
    """Smaller copies of a texture are not shifted."""
    room = BoxRoom(14, texture_px=256)
    large = CAMERA.resized(640, 480)
    for seed in range(3):
        pose = room.random_view(np.random.default_rng(seed))
        expected = cv2.resize(
            room.render(large, pose), (160, 120), interpolation=cv2.INTER_AREA
        )
        images = [image.mean(-1) for image in (room.render(CAMERA, pose), expected)]
        measured, expected = (cv2.GaussianBlur(image, (0, 0), 1.2) for image in images)
        slopes = np.stack([-g.ravel() for g in np.gradient(expected)], -1)
        shift = np.linalg.lstsq(slopes, (measured - expected).ravel(), rcond=None)[0]
        assert np.abs(shift).max() < 0.08  # pixels


def test_far_surfaces_are_smoothed_against_aliasing() -> None:
    """A pixel averages the many texels of a far wall that it covers."""
    noise = np.random.default_rng(0).integers(0, 256, (256, 256, 3)).astype(np.uint8)
    room = BoxRoom(11, furniture=0, texture_px=256)
    pyramid = room.surfaces[0].pyramid
    assert [level.shape[0] for level in pyramid] == [256, 128, 64, 32, 16]
    levels = [noise]
    while levels[-1].shape[0] > 16:
        levels.append(cv2.pyrDown(levels[-1]).astype(np.uint8))
    corner = np.array([0.5, 0, -0.5])
    edge_u = np.array([-1.0, 0, 0])
    edge_v = np.array([0, 0, 1.0])

    def deviation(distance: float, levels: list[np.ndarray]) -> float:
        wall = Surface(corner, edge_u, edge_v, tuple(levels))
        room.surfaces = [wall]
        image = room.render(CAMERA, look_at(distance * wall.normal, np.zeros(3)))
        return float(image[image.any(-1)].std())

    # At 4 m a pixel covers 7 texels; without smaller copies it would sample one of them.
    assert deviation(4.0, levels) < 0.35 * deviation(4.0, levels[:1])
    assert deviation(4.0, levels) < 0.5 * deviation(1.0, levels)


def test_same_seed_same_pixels() -> None:
    pose = look_at(np.array([0.1, 0.2, 1.2]), np.array([1.0, 0.4, 1.0]))
    first, again, other = (
        BoxRoom(seed, texture_px=64).render(CAMERA, pose) for seed in (5, 5, 6)
    )
    np.testing.assert_array_equal(first, again)
    assert (first != other).any(-1).mean() > 0.9


def test_distortion_is_refused(boxes: list[BoxRoom]) -> None:
    distorted = replace(CAMERA, distortion=(-0.2, 0.05, 0.0, 0.0))
    with pytest.raises(ValueError, match="distortion"):
        boxes[0].render(distorted, SE3.identity())


@pytest.mark.parametrize("frames", [60, 200])
def test_paths_are_smooth_closed_and_inside_the_room(
    boxes: list[BoxRoom], frames: int
) -> None:
    for room in boxes:
        path = room.path(frames, 1)
        assert path.shape == (frames,)
        eye = path.translation_m
        assert (np.abs(eye[:, :2]) < room.size_m[:2] / 2 - 0.5).all()
        assert (eye[:, 2] > 0.7).all()
        assert (eye[:, 2] < room.size_m[2] - 0.2).all()
        metres, radians = pose_distance(path, path[np.roll(np.arange(frames), -1)])
        # A jump would be metres and radians.
        assert metres.max() < 30 / frames
        assert radians.max() < 30 / frames
        # The sweep covers all directions.
        heading = np.unwrap(np.arctan2(*path.rotation_matrix()[:, [1, 0], 2].T))
        assert abs(heading[-1] - heading[0]) > 1.7 * np.pi


def test_train_and_test_paths_are_close_but_different(boxes: list[BoxRoom]) -> None:
    for room in boxes:
        train = room.path(100, 1)
        test = room.path(100, 2)
        metres, radians = pose_distance(train[:, None], test[None])
        near = (metres < 0.05) & (radians < np.deg2rad(5))
        assert near.any(0).mean() < 0.2
        assert 0.03 < np.median(np.diag(metres)) < 0.4
        assert np.median(np.diag(radians)) < np.deg2rad(20)
        np.testing.assert_array_equal(
            train.translation_m, room.path(100, 1).translation_m
        )


def test_look_at_aims_at_the_target_with_a_clockwise_roll() -> None:
    eye = np.array([0.3, -0.2, 1.0])
    target = np.array([2.0, 0.7, 0.4])
    level = look_at(eye, target)
    rolled = look_at(eye, target, 0.3)
    assert level.rotation_matrix()[2, 0] == pytest.approx(0)  # x is horizontal
    assert level.rotation_matrix()[2, 1] < 0  # y points down
    np.testing.assert_allclose(
        (level.inverse() @ rolled).log(), [0, 0, 0, 0, 0, 0.3], atol=1e-12
    )
    aim = CAMERA.project(rolled.inverse().apply(target))
    np.testing.assert_allclose(aim, [CAMERA.cx, CAMERA.cy], atol=1e-9)
