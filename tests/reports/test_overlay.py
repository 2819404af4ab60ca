"""Points and lines are drawn at their pixels in their colours."""

import cv2
import numpy as np
import pytest

from evercal.reports.overlay import encode_image, overlay_lines, overlay_points

GREY = np.full((60, 80, 3), 128, np.uint8)


def changed(image: np.ndarray) -> np.ndarray:
    return np.argwhere((image != GREY).any(axis=2))


def test_dot_is_centred_with_the_area_of_its_radius() -> None:
    drawn = overlay_points(GREY, [[40.0, 20.0]], np.array([[255, 0, 0]], np.uint8), radius=5)
    weight = (drawn[..., 0].astype(float) - 128) / 127
    y, x = np.indices(weight.shape)
    centre = (x * weight).sum() / weight.sum(), (y * weight).sum() / weight.sum()
    assert centre == pytest.approx((40.0, 20.0), abs=0.1)
    assert weight.sum() == pytest.approx(np.pi * 5.5**2, rel=0.1)  # out to the far side of a pixel
    assert drawn[20, 40].tolist() == [255, 0, 0]
    assert (GREY == 128).all()


def test_dots_are_placed_with_subpixel_accuracy() -> None:
    centres = []
    for x in (40.0, 40.25, 40.5):
        drawn = overlay_points(GREY, [[x, 20.0]], [[255, 255, 255]], radius=4)
        weight = drawn[..., 0].astype(float) - 128
        centres.append((np.arange(80) * weight.sum(axis=0)).sum() / weight.sum())
    assert np.diff(centres) == pytest.approx([0.25, 0.25], abs=0.12)


def test_later_points_cover_earlier_ones() -> None:
    at = [[40, 20], [40, 20]]
    assert overlay_points(GREY, at, [[255, 0, 0], [0, 255, 0]])[20, 40].tolist() == [0, 255, 0]


def test_points_outside_or_not_finite_are_omitted() -> None:
    away = [[-9, 20], [40, 1e12], [np.nan, 3], [np.inf, 3], [40, -np.inf], [89, 20]]
    assert len(changed(overlay_points(GREY, away, np.zeros((6, 3), np.uint8)))) == 0
    edge = overlay_points(GREY, [[-1, 20]], [[0, 0, 0]], radius=3)
    assert len(changed(edge)) > 0  # its centre is outside, its rim is not
    assert len(changed(overlay_points(GREY, np.zeros((0, 2)), []))) == 0


def test_values_run_from_dark_to_light_and_are_clipped() -> None:
    at = [[10, 10], [20, 10], [30, 10], [40, 10], [50, 10], [60, 10]]
    values = [-5.0, 0.0, 0.5, 1.0, 9.0, np.nan]
    drawn = overlay_points(GREY, at, values, limits=(0.0, 1.0)).astype(int)
    colours = [drawn[10, x].tolist() for x, _ in at]
    assert colours[0] == colours[1]
    assert colours[3] == colours[4]
    assert sum(colours[1]) < sum(colours[2]) < sum(colours[3])
    assert colours[1][2] > colours[1][1]  # viridis starts blue
    assert colours[3][0] > 200 > 100 > colours[3][2]  # and ends yellow
    assert len(set(colours[5])) == 1


def test_image_below_values_is_grey() -> None:
    photo = np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8)
    drawn = overlay_points(photo, [[10, 10]], [1.0])
    assert (drawn[30:, :, 0] == drawn[30:, :, 2]).all()
    coloured = overlay_points(photo, [[10, 10]], [[1, 2, 3]])
    np.testing.assert_array_equal(coloured[30:], photo[30:])


@pytest.mark.parametrize("shape", [(240, 320), (40, 60), (12, 400), (3, 3)])
def test_a_legend_stays_in_the_corner_of_any_image(shape: tuple[int, int]) -> None:
    image = np.zeros((*shape, 3), np.uint8)
    drawn = overlay_points(image, np.zeros((1, 2)), [0.5], limits=(0, 1), legend="depth (m)")
    assert drawn.shape == image.shape
    if shape == (240, 320):
        assert (drawn[-20:, -40:] > 0).any()
        assert (drawn[100:150] == 0).all()


def test_encoded_images_read_back() -> None:
    photo = np.random.default_rng(1).integers(0, 255, (20, 30, 3), np.uint8)
    read = cv2.imdecode(np.frombuffer(encode_image(photo), np.uint8), cv2.IMREAD_COLOR)
    assert read is not None
    np.testing.assert_array_equal(read[..., ::-1], photo)
    flat = np.full((20, 30, 3), (200, 100, 50), np.uint8)
    data = encode_image(flat, "jpg")
    lossy = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert lossy is not None
    assert np.abs(lossy[..., ::-1].astype(int) - flat).max() < 6


def test_line_without_rims_has_its_colour_only() -> None:
    line = [[10.0, 30.0], [30.0, 30.0]]
    drawn = overlay_lines(GREY, [line], [(0, 0, 0)], width=1, rims=False)
    assert drawn.max() == GREY.max()
    assert overlay_lines(GREY, [line], [(0, 0, 0)], width=1).max() == 255


def test_line_has_colour_rim_and_gaps() -> None:
    line = [[10, 30], [40, 30], [np.nan, 30], [60, 30], [70, 30]]
    drawn = overlay_lines(GREY, [line], [(200, 10, 20)], width=3)
    assert drawn[30, 25].tolist() == [200, 10, 20]
    assert drawn[30, 65].tolist() == [200, 10, 20]
    assert drawn[30, 50].tolist() == [128, 128, 128]
    assert (drawn[27:29, 25] > 128).any()  # the white rim
    assert (GREY == 128).all()


def test_half_of_a_dashed_line_is_drawn() -> None:
    drawn = overlay_lines(GREY, [[[0, 30], [80, 30]]], [(255, 0, 0)], width=1, dash=8)
    red = (drawn[30, :, 0] > 200) & (drawn[30, :, 1] < 60)
    assert 33 <= red.sum() <= 47
    switches = np.abs(np.diff(red.astype(int))).sum()
    assert switches == 10  # five dashes


def test_lines_without_finite_points_are_omitted() -> None:
    for line in ([[np.nan, 1], [np.inf, 2]], [[3, 3]], np.zeros((0, 2)), [[1e9, 1], [1e12, 5]]):
        assert len(changed(overlay_lines(GREY, [line], [(0, 0, 0)]))) == 0
        assert len(changed(overlay_lines(GREY, [line], [(0, 0, 0)], dash=3))) == 0
