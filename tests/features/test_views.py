"""Views equal images that are rendered for the same camera."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from evercal.features.views import (
    View,
    ViewOptions,
    augmented_view,
    cell_centres,
    frame_view,
    ideal_cell_pixels,
    working_image,
)
from evercal.geometry import SE3, Camera
from evercal.simulation.box_room import BoxRoom

PLAIN = Camera(160, 120, 131.0, 128.0, 83.0, 57.0)
LARGE = Camera(320, 240, 262.0, 256.0, 166.5, 114.5)
PORTRAIT = Camera(120, 160, 128.0, 131.0, 57.0, 83.0)
DISTORTED = replace(PLAIN, distortion=(-0.22, 0.07, 0.004, -0.003))
CAMERAS = {"plain": PLAIN, "large": LARGE, "portrait": PORTRAIT, "distorted": DISTORTED}
OPTIONS = ViewOptions(short_side=120, gamma=0.0)


def grey(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def shifts(image: np.ndarray, expected: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """(n, 2) shift of an image against the expected one in each quarter, pixels."""
    image, expected = (
        cv2.GaussianBlur(i.astype(float), (0, 0), 1.2) for i in (image, expected)
    )
    dv, du = np.gradient(expected)
    height, width = mask.shape
    moved = []
    for rows in (slice(0, height // 2), slice(height // 2, height)):
        for columns in (slice(0, width // 2), slice(width // 2, width)):
            part = np.zeros_like(mask)
            part[rows, columns] = mask[rows, columns]
            if part.sum() < 400:
                continue
            slopes = np.stack([-du[part], -dv[part], np.ones(part.sum())], -1)
            moved.append(
                np.linalg.lstsq(slopes, (image - expected)[part], rcond=None)[0][:2]
            )
    assert len(moved) >= 3
    return np.array(moved)


def inner(view: View) -> np.ndarray:
    """(h, w) bool: pixels of valid cells whose neighbours are valid too."""
    height, width = view.grey.shape
    cells = view.valid.reshape(height // 8, width // 8).astype(np.uint8)
    cells = cv2.erode(cells, np.ones((3, 3), np.uint8), borderValue=0)
    mask = np.zeros(view.grey.shape, bool)
    mask[: height // 8 * 8, : width // 8 * 8] = np.kron(cells, np.ones((8, 8))).astype(
        bool
    )
    return mask


def virtual_camera(view: View) -> tuple[Camera, SE3]:
    """The camera that took an augmented view, and `frame_from_view`, from the cell pixels alone."""
    fx, fy, cx, cy = view.intrinsics.astype(float)
    height, width = view.grey.shape
    frame = Camera(width, height, fx, fy, cx, cy)
    here = cell_centres(height, width, 8)
    matrix, _ = cv2.findHomography(here, view.cell_pixels.astype(float))
    # K R K_v^-1 with K_v = K diag(z, z, 1) leaves R diag(1/z, 1/z, 1) up to scale.
    scaled = np.linalg.inv(frame.matrix()) @ matrix @ frame.matrix()
    scaled = scaled / np.linalg.norm(scaled[:, 2])
    zoom = 1 / np.linalg.norm(scaled[:, 0])
    rotation = scaled * [zoom, zoom, 1]
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=2e-4)
    assert np.linalg.det(rotation) > 0
    pose = SE3.from_matrix(np.block([[rotation, np.zeros((3, 1))], [np.eye(4)[3:]]]))
    return Camera(width, height, zoom * fx, zoom * fy, cx, cy), pose


@pytest.mark.parametrize("kind", CAMERAS)
def test_augmented_view_is_the_image_of_its_virtual_camera(
    kind: str, box: BoxRoom, shoot
) -> None:
    rng = np.random.default_rng(3)
    zooms = []
    rotations = []
    for _ in range(4):
        frame = shoot(CAMERAS[kind], box.random_view(rng))
        view = augmented_view(frame, 8, OPTIONS, rng)
        camera, frame_from_view = virtual_camera(view)
        zooms.append(camera.fx / view.intrinsics[0])
        rotations.append(np.abs(frame_from_view.log()[3:]))
        pose = frame.base_from_camera @ frame_from_view
        expected = grey(box.render(camera, pose))
        mask = inner(view)
        assert mask.mean() > 0.25
        moved = shifts(view.grey, expected, mask)
        assert np.abs(moved).max() < 0.15
        assert np.abs(moved.mean(0)).max() < 0.06
        difference = np.abs(view.grey.astype(float) - expected)[mask]
        assert np.median(difference) < 5
        # A view of another direction differs.
        back = frame.base_from_camera @ frame_from_view.inverse()
        wrong = np.abs(view.grey.astype(float) - grey(box.render(camera, back)))[mask]
        assert difference.mean() < 0.35 * wrong.mean()
    # The draws use the range of the options.
    assert 1 / 1.4 - 1e-3 < min(zooms) < 1 < max(zooms) < 1.4 + 1e-3
    assert (np.max(rotations, 0) <= np.deg2rad([6, 6, 20]) + 1e-3).all()
    assert (np.max(rotations, 0) > np.deg2rad([1, 1, 3])).all()


@pytest.mark.parametrize("kind", CAMERAS)
def test_pose_and_intrinsics_are_those_of_the_frame(
    kind: str, box: BoxRoom, shoot
) -> None:
    frame = shoot(CAMERAS[kind], box.random_view(np.random.default_rng(0)))
    small = frame.camera.short_side_resized(120)
    for view in (
        frame_view(frame, 8, OPTIONS),
        augmented_view(frame, 8, OPTIONS, np.random.default_rng(1)),
    ):
        np.testing.assert_allclose(
            view.intrinsics, [small.fx, small.fy, small.cx, small.cy]
        )
        np.testing.assert_allclose(
            view.base_from_camera.log(), frame.base_from_camera.log()
        )
        assert view.grey.shape == (small.height, small.width)
        cells = (small.height // 8) * (small.width // 8)
        assert view.cell_pixels.shape == (cells, 2)
        assert view.cell_pixels.dtype == np.float32
        assert view.valid.shape == (cells,)


@pytest.mark.parametrize("kind", CAMERAS)
def test_cells_of_a_plain_view_show_their_ideal_pixels(
    kind: str, box: BoxRoom, shoot
) -> None:
    rng = np.random.default_rng(5)
    actual = []
    expected = []
    for _ in range(3):
        frame = shoot(CAMERAS[kind], box.random_view(rng))
        view = frame_view(frame, 8, OPTIONS)
        assert view.valid.all()
        fx, fy, cx, cy = view.intrinsics.astype(float)
        height, width = view.grey.shape
        margin = 30  # the ideal image of a barrel lens is larger
        ideal = Camera(width + 60, height + 60, fx, fy, cx + margin, cy + margin)
        drawn = cv2.GaussianBlur(
            grey(box.render(ideal, frame.base_from_camera)), (0, 0), 1.5
        )
        where = (view.cell_pixels + margin)[:, None]
        expected.append(cv2.remap(drawn, where, None, cv2.INTER_LINEAR))  # type: ignore[call-overload]
        centres = cell_centres(height, width, 8).astype(np.float32)[:, None]
        blurred = cv2.GaussianBlur(view.grey, (0, 0), 1.5)
        actual.append(cv2.remap(blurred, centres, None, cv2.INTER_LINEAR))  # type: ignore[call-overload]
    a, b = (np.concatenate(x).ravel().astype(float) for x in (actual, expected))
    assert np.corrcoef(a, b)[0, 1] > 0.97
    assert np.median(np.abs(a - b)) < 3


@pytest.mark.parametrize("kind", CAMERAS)
def test_cell_pixels_are_free_of_distortion(kind: str) -> None:
    """A point on the ray of an ideal pixel projects to the cell's centre."""
    camera = CAMERAS[kind]
    ideal = replace(camera, distortion=())
    pixels = ideal_cell_pixels(camera, 8)
    projected = camera.project(2.5 * ideal.unproject(pixels))
    centres = cell_centres(camera.height, camera.width, 8)
    np.testing.assert_allclose(projected, centres, atol=1e-3)
    shift = np.abs(pixels - centres).max()
    assert shift > 3 if camera.distortion else shift < 1e-4


@pytest.mark.parametrize("kind", CAMERAS)
def test_valid_cells_lie_in_the_distorted_image(kind: str, box: BoxRoom, shoot) -> None:
    rng = np.random.default_rng(7)
    small = CAMERAS[kind].short_side_resized(120)
    ideal = replace(small, distortion=())
    share = []
    for _ in range(12):
        frame = shoot(CAMERAS[kind], box.random_view(rng))
        view = augmented_view(frame, 8, replace(OPTIONS, zoom=2.0), rng)
        u, v = small.project(ideal.unproject(view.cell_pixels)).T
        edge = np.minimum.reduce([u, v, small.width - 1 - u, small.height - 1 - v])
        clear = np.abs(edge) > 0.01
        np.testing.assert_array_equal(view.valid[clear], (edge >= 0)[clear])
        share.append(view.valid.mean())
    assert min(share) < 0.7  # zoomed out, some of the view lies outside the image
    assert max(share) == 1.0


def test_gamma_changes_the_brightness_only(box: BoxRoom, shoot) -> None:
    frame = shoot(PLAIN, box.random_view(np.random.default_rng(0)))
    dark = augmented_view(
        frame, 8, replace(OPTIONS, gamma=0.8), np.random.default_rng(4)
    )
    plain = augmented_view(frame, 8, OPTIONS, np.random.default_rng(4))
    np.testing.assert_array_equal(dark.cell_pixels, plain.cell_pixels)
    table = {
        (int(a), int(b)) for a, b in zip(plain.grey.flat, dark.grey.flat, strict=True)
    }
    levels = dict(table)
    assert len(levels) == len(table)  # a function of the grey value
    ordered = [levels[key] for key in sorted(levels)]
    assert ordered == sorted(ordered)
    assert any(a != b for a, b in table)


@pytest.mark.parametrize(
    ("size", "expected"),
    [((320, 240), (160, 120)), ((90, 120), (120, 160)), ((160, 120), None)],
)
def test_working_image(size: tuple[int, int], expected: tuple[int, int] | None) -> None:
    image = (
        np.random.default_rng(0)
        .integers(0, 256, (size[1], size[0], 3))
        .astype(np.uint8)
    )
    camera = Camera(*size, 100.0, 100.0, 40.0, 50.0)
    resized, small = working_image(image, camera, 120)
    width, height = expected or size
    assert resized.shape == (height, width) == (small.height, small.width)
    assert small == camera.short_side_resized(120)
    again, _ = working_image(grey(image), camera, 120)
    np.testing.assert_array_equal(resized, again)


def test_shrinking_averages() -> None:
    image = np.zeros((240, 320), np.uint8)
    image[::2, ::2] = 255
    small, _ = working_image(image, LARGE, 120)
    assert np.abs(small.astype(float) - 255 / 4).max() <= 1


def test_enlarging_is_linear_to_a_grey_level() -> None:
    """OpenCV's own function for one channel errs by 3 levels on arm64."""
    noise = np.random.default_rng(0).integers(0, 256, (90, 120)).astype(np.uint8)
    for side in (93, 132, 180):
        large, _ = working_image(noise, Camera(120, 90, 131.0, 128.0, 60.0, 45.0), side)
        scale = 90 / side
        places = (np.indices(large.shape) + 0.5) * scale - 0.5
        expected = map_coordinates(noise.astype(float), places, order=1, mode="nearest")
        assert np.abs(large - expected).max() < 1
