"""Renderings against geometry: projected balls and the depth of a plane."""

from dataclasses import replace

import numpy as np
import pytest

from evercal.geometry import SE3, Camera
from evercal.simulation.box_room import look_at
from rooms.materials import Material, plain
from rooms.renderer import Renderer, RenderOptions
from rooms.shapes import ball, box

pytestmark = pytest.mark.slow("rooms", "src/evercal/simulation")

pytest.importorskip("mitsuba", reason="Mitsuba is not installed")

CENTRES = np.array([[0.05, -0.3, 0.0], [0.3, 0.15, 0.2], [-0.4, 0.3, 0.1]])
RADIUS = 0.02
CAMERA = Camera(96, 72, 90.0, 90.0, 44.0, 38.5)
POSE = look_at(np.array([1.2, 0.3, 0.6]), np.array([0.0, 0.0, 0.1]), 0.1)


@pytest.fixture(scope="module")
def balls() -> Renderer:
    light = plain("lamp", (1.0, 1.0, 1.0), emission=0.3)
    shapes = [ball(RADIUS, segments=32).shifted(*(c - (0, 0, RADIUS))) for c in CENTRES]
    return Renderer([(shape, light) for shape in shapes], exposure=1.0)


def test_balls_appear_at_their_projection(balls: Renderer) -> None:
    image = balls.render(CAMERA, POSE, RenderOptions(samples=64))
    depth = balls.depth(CAMERA, POSE)
    centres = POSE.inverse().apply(CENTRES)
    value = image[..., 0] / 255.0
    weight = np.where(value > 0.04045, ((value + 0.055) / 1.055) ** 2.4, value / 12.92)
    v, u = np.mgrid[0:72, 0:96]
    for centre, pixel in zip(centres, CAMERA.project(centres), strict=True):
        w = weight * (np.hypot(u - pixel[0], v - pixel[1]) < 6)
        centroid = np.array([(u * w).sum(), (v * w).sum()]) / w.sum()
        assert np.abs(centroid - pixel).max() < 0.2
        near = np.hypot(u - pixel[0], v - pixel[1]) < 0.71
        # The front of a ball is one radius in front of its centre.
        front = depth[near][depth[near] > 0].min()
        assert front == pytest.approx(
            centre[2] * (1 - RADIUS / np.linalg.norm(centre)), abs=2e-3
        )


def test_depth_is_exact_along_the_optical_axis() -> None:
    grey = plain("grey", (0.5, 0.5, 0.5))
    renderer = Renderer([(box(4.0, 4.0, 0.5, 1e-3).shifted(0, 0, -0.5), grey)])
    pose = look_at(np.array([0.3, 0.2, 1.5]), np.array([0.0, 0.0, 0.0]), 0.3)
    depth = renderer.depth(CAMERA, pose)
    v, u = np.mgrid[0:72, 0:96]
    rays = CAMERA.unproject(np.stack([u, v], -1)) @ pose.rotation_matrix().T
    expected = -pose.translation_m[2] / rays[..., 2]
    np.testing.assert_allclose(depth, expected, atol=1e-3)


def test_same_seed_same_pixels(balls: Renderer) -> None:
    options = RenderOptions(samples=4, noise=0.02)
    a, b, c = (balls.render(CAMERA, POSE, options, seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(a, b)
    assert (a != c).any()


def test_moved_meshes_change_the_depth() -> None:
    grey = plain("grey", (0.5, 0.5, 0.5))
    cube = box(0.2, 0.2, 0.2)
    named = type(cube)(cube.vertices_m, cube.faces, cube.normals, cube.uv, "cube")
    renderer = Renderer([(named, grey)])
    pose = SE3(np.array([1.0, 0, 0, 0]), np.array([0.0, 0.0, -2.0]))
    camera = Camera(48, 48, 60.0, 60.0, 23.5, 23.5)
    before = renderer.depth(camera, pose)[24, 24]
    renderer.move([(named.shifted(0, 0, 0.5), grey)])
    assert renderer.depth(camera, pose)[24, 24] - before == pytest.approx(0.5, abs=1e-4)


@pytest.mark.parametrize("side", range(4))
def test_pictures_are_neither_mirrored_nor_upside_down(side: int) -> None:
    texture = np.full((64, 64, 3), 20, np.uint8)
    texture[:32, :, 0] = 250  # red above
    texture[:, 32:, 2] = 250  # blue on the right
    poster = Material("poster", texture, tile_m=0.4)
    cube = box(0.4, 0.4, 0.4, 1e-3)
    cube = replace(cube, uv=cube.uv + 0.2)
    lamp = plain("lamp", (1, 1, 1), emission=20.0)
    lamps = [
        (ball(0.3).shifted(x, y, 1.5), lamp)
        for x, y in ((3, 0), (0, 3), (-3, 0), (0, -3))
    ]
    angle = np.pi / 2 * side
    pose = look_at(
        np.array([2 * np.cos(angle), 2 * np.sin(angle), 0.2]), np.array([0, 0, 0.2])
    )
    image = Renderer([(cube, poster), *lamps]).render(CAMERA, pose).astype(float)
    red = image[30:47, 36:53, 0]
    blue = image[30:47, 36:53, 2]  # the face is 20 pixels wide
    assert red[:7].min() > red[-7:].max() + 50
    assert blue[:, -7:].min() > blue[:, :7].max() + 50


def test_denoising_reduces_the_error_of_few_samples() -> None:
    grey = plain("grey", (0.5, 0.5, 0.5))
    lamp = plain("lamp", (1, 1, 1), emission=20.0)
    plane = box(6.0, 6.0, 0.1, 1e-3).shifted(0, 0, -0.1)
    scene = Renderer([(plane, grey), (ball(0.2).shifted(1.0, 0.0, 2.0), lamp)])
    pose = look_at(np.array([-0.5, 0.0, 1.5]), np.zeros(3))
    few, clean, many = (
        scene.render(CAMERA, pose, RenderOptions(samples, denoise=denoise)).astype(
            float
        )
        for samples, denoise in ((4, False), (4, True), (256, False))
    )
    assert np.abs(clean - many).mean() < 0.4 * np.abs(few - many).mean()
