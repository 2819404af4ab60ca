"""The camera against OpenCV, against closed forms, and against itself at other sizes."""

from dataclasses import replace
from itertools import product

import cv2
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from evercal.choices import CameraModel
from evercal.geometry import Camera

KINECT = (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
RATIONAL = (0.1, -0.05, 0.001, -0.002, 0.01, 0.05, 0.01, 0.002)
LENSES = [(), (-0.2, 0.05, 0.001, -0.0005), KINECT, RATIONAL]
FISHEYES = [(0.0,) * 4, (0.1, -0.02, 0.003, -0.0005), (-0.05, 0.01, -0.004, 0.0007)]


def camera_with(distortion: tuple[float, ...]) -> Camera:
    return Camera(640, 480, 517.3, 516.5, 318.6, 255.3, distortion)


@pytest.mark.parametrize("distortion", LENSES)
def test_project_agrees_with_opencv(distortion: tuple[float, ...]) -> None:
    camera = camera_with(distortion)
    points = np.random.default_rng(0).uniform([-1, -0.8, 2], [1, 0.8, 4], size=(200, 3))
    twin, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), camera.matrix(), np.array(distortion)
    )
    np.testing.assert_allclose(camera.project(points), twin[:, 0], atol=1e-9)


@pytest.mark.parametrize("distortion", LENSES)
def test_unproject_inverts_project_over_the_whole_image(
    distortion: tuple[float, ...],
) -> None:
    camera = camera_with(distortion)
    x, y = np.meshgrid(np.linspace(0, 639, 17), np.linspace(0, 479, 13))
    pixels = np.stack([x, y], axis=-1)
    rays = camera.unproject(pixels)
    assert rays.shape == (13, 17, 3)
    assert np.all(rays[..., 2] == 1.0)
    np.testing.assert_allclose(camera.project(rays * 3.7), pixels, atol=1e-6)


@given(
    size=st.tuples(st.integers(8, 4000), st.integers(8, 4000)),
    new=st.tuples(st.integers(8, 4000), st.integers(8, 4000)),
    lens=st.sampled_from(LENSES),
)
@settings(max_examples=80)
def test_resized_camera_projects_points_to_the_same_part_of_the_image(
    size: tuple[int, int], new: tuple[int, int], lens: tuple[float, ...]
) -> None:
    camera = Camera(
        *size, 0.9 * size[0], 1.1 * size[0], 0.4 * size[0], 0.6 * size[1], lens
    )
    points = np.array([[0.1, -0.2, 1.0], [0.3, 0.1, 2.0], [-0.5, 0.4, 1.5]])
    # Measured from the image's corner, half a pixel outside the first centre.
    before = (camera.project(points) + 0.5) / size
    after = (camera.resized(*new).project(points) + 0.5) / new
    np.testing.assert_allclose(after, before, atol=1e-10)
    back = camera.resized(*new).resized(*size)
    np.testing.assert_allclose(back.matrix(), camera.matrix(), rtol=1e-9, atol=1e-7)


def test_resizing_agrees_with_opencv() -> None:
    """A bright spot's centre of mass moves as the principal point does."""
    image = np.zeros((48, 64), np.float32)
    image[10:14, 40:44] = 1.0
    camera = Camera(64, 48, 50.0, 50.0, 41.5, 11.5)
    small = cv2.resize(image, (32, 24), interpolation=cv2.INTER_AREA)
    y, x = np.indices(small.shape)
    centre = (x * small).sum() / small.sum(), (y * small).sum() / small.sum()
    resized = camera.resized(32, 24)
    assert centre == pytest.approx((resized.cx, resized.cy), abs=1e-6)


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        ((640, 480), (320, 240)),
        ((1920, 1080), (427, 240)),
        ((1080, 1920), (240, 427)),
        ((10000, 3), (800000, 240)),
    ],
)
def test_short_side(size: tuple[int, int], expected: tuple[int, int]) -> None:
    camera = Camera(*size, 500.0, 500.0, size[0] / 2, size[1] / 2).short_side_resized(
        240
    )
    assert (camera.width, camera.height) == expected


@pytest.mark.parametrize(
    ("distortion", "model"),
    [*product(LENSES, ["pinhole"]), *product(FISHEYES, ["fisheye"])],
)
def test_slopes_equal_finite_differences(
    distortion: tuple[float, ...], model: CameraModel
) -> None:
    camera = camera_with(())
    step = 1e-6
    camera = replace(camera, distortion=distortion, model=model)
    plane = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 2))

    def pixels_of(camera: Camera, move: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
        return camera.project(np.concatenate([plane + move, np.ones((20, 1))], 1))

    def changed(size: float) -> list[Camera]:
        return [camera.changed(row) for row in size * np.eye(8)]

    by_plane, by_lens = camera.slopes(plane, 5)
    np.testing.assert_array_equal(camera.slopes(plane)[1], by_lens[..., :5])
    ahead, behind = ([pixels_of(c) for c in changed(size)] for size in (step, -step))
    truth = np.stack([a - b for a, b in zip(ahead, behind, strict=True)], -1) / (
        2 * step
    )
    np.testing.assert_allclose(by_lens, truth, atol=1e-6 * np.abs(truth).max())
    moves = (step, 0.0), (0.0, step)
    along = [pixels_of(camera, m) - pixels_of(camera, (-m[0], -m[1])) for m in moves]
    truth = np.stack(along, -1) / (2 * step)
    np.testing.assert_allclose(by_plane, truth, atol=1e-6 * np.abs(truth).max())


BARREL = Camera(640, 480, 400.0, 400.0, 319.5, 239.5, (-0.35, 0.0, 0.0, 0.0))


def test_pixels_beyond_the_fold_have_no_ray() -> None:
    """x (1 - 0.35 x^2) is largest at x = 0.976, where it is 0.651."""
    assert BARREL.widest == pytest.approx((3 * 0.35) ** -0.5)
    points = np.array([[0.97, 0, 1], [0.98, 0, 1], [1.7, 0, 1]])
    pixels = BARREL.project(points)
    assert pixels[0] == pytest.approx(
        (319.5 + 400 * 0.97 * (1 - 0.35 * 0.97**2), 239.5)
    )
    assert np.isnan(pixels[1:]).all()
    x, y = np.meshgrid(np.arange(0, 640, 7.0), np.arange(0, 480, 7.0))
    pixels = np.stack([x, y], -1)
    rays = BARREL.unproject(pixels)
    there = np.isfinite(rays).all(-1)
    assert (there == (np.hypot(x - 319.5, y - 239.5) < 400 * 0.6506)).all()
    np.testing.assert_allclose(BARREL.project(rays)[there], pixels[there], atol=1e-6)


@pytest.mark.parametrize(
    ("distortion", "widest"),
    [
        ((), np.inf),
        (KINECT, np.inf),
        ((0.0, 0.0, 0.01, 0.01), np.inf),
        ((0.0, 0.0, 0.0, 0.0, 0.0, -0.25, 0.0, 0.0), 2.0),  # its denominator is 0 there
        (
            (0.0, 0.0, 0.0, 0.0, 0.0, 0.25, 0.0, 0.0),
            2.0,
        ),  # x / (1 + x^2 / 4) is largest there
    ],
)
def test_range_of_the_distortion(distortion: tuple[float, ...], widest: float) -> None:
    assert camera_with(distortion).widest == pytest.approx(widest)


def fisheye(distortion: tuple[float, ...], focal: float = 180.0) -> Camera:
    return Camera(640, 480, focal, 1.01 * focal, 318.6, 235.3, distortion, "fisheye")


@pytest.mark.parametrize("distortion", FISHEYES)
def test_a_fisheye_agrees_with_opencv(distortion: tuple[float, ...]) -> None:
    camera = fisheye(distortion)
    rng = np.random.default_rng(0)
    angle = np.deg2rad(rng.uniform(0, 84, 300))
    around = rng.uniform(0, 2 * np.pi, 300)
    points = np.stack(
        [np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)],
        -1,
    ) * rng.uniform(0.5, 3, (300, 1))
    lens = np.array(distortion)
    twin, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), camera.matrix(), lens
    )
    np.testing.assert_allclose(camera.project(points), twin[:, 0], atol=1e-9)
    np.testing.assert_allclose(
        camera.unproject(twin[:, 0]), points / points[:, 2:], rtol=1e-6, atol=1e-9
    )


def test_a_fisheye_ends_at_85_deg_or_where_its_polynomial_folds() -> None:
    assert fisheye((0.0,) * 4).widest == pytest.approx(np.tan(np.deg2rad(85)))
    folds = (-0.3, 0.0, 0.0, 0.0)  # 1 - 0.9 t^2 = 0
    assert fisheye(folds).widest == pytest.approx(np.tan((0.9) ** -0.5))
    far = np.array([[np.tan(np.deg2rad(84.9)), 0, 1], [np.tan(np.deg2rad(85.1)), 0, 1]])
    assert np.isfinite(fisheye((0.0,) * 4).project(far)).all(1).tolist() == [
        True,
        False,
    ]
    across = np.array(
        [[318.6 + 180 * np.deg2rad(deg), 235.3] for deg in (0, 84.9, 85.1, 120)]
    )
    rays = fisheye((0.0,) * 4).unproject(across)
    assert np.isfinite(rays).all(1).tolist() == [True, True, False, False]


@pytest.mark.parametrize("distortion", FISHEYES)
def test_a_fisheye_survives_sizes_dictionaries_and_changes(
    distortion: tuple[float, ...],
) -> None:
    camera = fisheye(distortion)
    assert Camera.from_dict(camera.to_dict()) == camera
    assert camera.resized(320, 240).resized(640, 480).model == "fisheye"
    assert camera.pinhole.distortion == ()
    assert camera.pinhole.model == "pinhole"
    changed = camera.changed([0.0, 1.0, 0.0, 0.01, -0.02])
    assert changed.distortion[:2] == pytest.approx(
        (distortion[0] + 0.01, distortion[1] - 0.02)
    )
    assert changed.cx == camera.cx + 1
    with pytest.raises(ValueError, match="k1 k2 k3 k4"):
        fisheye((0.1,) * 5)
    with pytest.raises(ValueError, match="pinhole or fisheye"):
        replace(camera, model="omni")  # pyright: ignore[reportArgumentType]


def test_zero_coefficients_and_points_behind_the_camera() -> None:
    for count in (4, 5, 8):
        assert camera_with((0.0,) * count) == camera_with(())
    assert camera_with(KINECT).coefficients == (*KINECT, 0.0, 0.0, 0.0)
    # Points behind the camera have no pixel.
    pixels = camera_with(()).project(
        [[0.0, 0.0, -1.0], [0.1, 0.1, 0.0], [0.0, 0.0, 1.0]]
    )
    assert np.isnan(pixels[:2]).all()
    assert pixels[2] == pytest.approx((318.6, 255.3))


def test_matrix_and_dict_round_trips() -> None:
    camera = camera_with(KINECT)
    assert Camera.from_matrix(camera.matrix(), 640, 480, KINECT) == camera
    assert Camera.from_dict(camera.to_dict()) == camera
    assert Camera.from_dict({**camera.to_dict(), "serial": "A1"}) == camera
    assert hash(Camera.from_dict(camera.to_dict())) == hash(camera)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx": 0.0}, "fx"),
        ({"cy": float("nan")}, "cy"),
        ({"width": 0}, "width"),
        ({"height": 10.5}, "height"),
        ({"distortion": [0.1, 0.2]}, "0, 4, 5 or 8"),
        ({"distortion": "none"}, "list"),
        ({"fy": "500"}, "'fy' is a number"),
    ],
)
def test_bad_intrinsics_are_refused_by_name(
    change: dict[str, object], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        Camera.from_dict({**camera_with(()).to_dict(), **change})


def test_a_matrix_that_is_not_pinhole_is_refused() -> None:
    skewed = camera_with(()).matrix()
    skewed[0, 1] = 0.5
    with pytest.raises(ValueError, match="skew"):
        Camera.from_matrix(skewed, 640, 480)
    with pytest.raises(ValueError, match="3x3"):
        Camera.from_matrix(np.eye(4), 640, 480)
