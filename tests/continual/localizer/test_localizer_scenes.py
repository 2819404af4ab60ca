"""Which scene answers, and when none does; `world` is an oracle, see conftest."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from evercal.geometry.camera import Camera
from evercal.localization.localizer import LocalizeOptions, Localizer
from evercal.simulation.box_room import default_camera

CAMERA = default_camera(160, 120)


def test_noise_is_not_located(world: Any) -> None:
    # Every grey level is a known view, so every cell says a true point, but of another pose each.
    where = world(threshold=0.2)
    for scene in (0, 1) * 60:
        where.view(scene)
    localizer = Localizer(where.maps)
    for seed in range(5):
        rng = np.random.default_rng(seed)
        noise = rng.integers(0, 256, (120, 160, 3)).astype(np.uint8)
        noise[::2] //= 2  # levels from 10 to 130 in the mean of a cell
        found = localizer.localize(noise)
        assert found.status != "ok"
        assert found.reason
        assert found.scene is None
        assert found.base_from_camera is None
        assert found.covariance is None
        assert found.inlier_ratio < 0.2


def test_a_pose_outside_the_cell_of_its_scene_fails(world: Any) -> None:
    # Asked as scene 0, the head describes a place in the cell of scene 1.
    where = world()
    image = where.view(1, say=0)
    where.looks_like(image, [1.0, 0, 0, 0])
    found = Localizer(where.maps).localize(image)
    assert found.status == "failed"
    assert "cell" in found.reason
    assert found.scene is None
    assert found.base_from_camera is None
    assert found.inliers == 300  # and it had agreed with all of it


def test_too_few_cells_of_an_image(world: Any) -> None:
    where = world((default_camera(160, 120),))
    where.maps.short_side = 16  # 2 cells of 16 x 21 pixels: no pose has 6 inliers
    found = Localizer(where.maps).localize(where.view(0))
    assert found.status == "failed"
    assert "6 patches" in found.reason
    assert found.inliers == 0
    assert found.inlier_ratio == 0.0


@pytest.mark.parametrize(("right", "status"), [(0.35, "unknown_scene"), (0.75, "ok")])
def test_the_threshold_of_a_scene_decides(right: float, status: str, world: Any) -> None:
    where = world(threshold=0.5)
    found = Localizer(where.maps).localize(where.view(0, right=right))
    assert found.status == status
    assert found.inlier_ratio == pytest.approx(right, abs=0.03)
    assert (found.base_from_camera is None) == (status != "ok")
    if status == "unknown_scene":
        assert "50 %" in found.reason
        assert "scene-0" in found.reason
    # Each scene has its own: the other one believes less, or more.
    where.maps.scenes[0] = replace(where.maps.scenes[0], inlier_threshold=0.5 - 0.25)
    assert Localizer(where.maps).localize(where.view(0, right=right)).status == "ok"


def test_the_covariance_is_scaled_by_what_the_scene_learned(world: Any) -> None:
    found = []
    for scale in (1.0, 7.0):
        where = world()
        where.maps.scenes[0] = replace(where.maps.scenes[0], covariance_scale=scale)
        found.append(Localizer(where.maps).localize(where.view(0)))
    assert found[0].covariance is not None
    assert found[1].covariance is not None
    np.testing.assert_allclose(found[1].covariance, 7 * found[0].covariance, rtol=1e-9)


def test_candidates_are_chosen_by_prototypes(world: Any) -> None:
    where = world((CAMERA,) * 4)
    image = where.view(2)

    def asked(descriptor: list[float], options: LocalizeOptions) -> list[int]:
        where.looks_like(image, descriptor)
        where.oracle.asked.clear()
        Localizer(where.maps, options).localize(image)
        return list(where.oracle.asked)

    likes = [0.6, 0.5, 0.4, 0.3]  # length 0.927: cosines 0.647, 0.539, 0.431, 0.323
    assert asked(likes, LocalizeOptions(candidates=9, margin=2.0)) == [0, 1, 2, 3]
    assert asked(likes, LocalizeOptions(candidates=3, margin=2.0)) == [0, 1, 2]
    assert asked(likes, LocalizeOptions(candidates=9, margin=0.12)) == [0, 1]
    assert asked(likes, LocalizeOptions(candidates=9, margin=0.23)) == [0, 1, 2]
    assert asked([0.1, 0.2, 0.9, 0.3], LocalizeOptions(candidates=2, margin=2.0)) == [2, 3]
    # The best of a scene's prototypes speaks for it.
    record = where.maps.scenes[3]
    more = torch.tensor([[0.0, 0, 0, 1], [1, 0, 0, 0]]).half()
    where.maps.scenes[3] = replace(record, prototypes=more)
    assert sorted(asked([0.9, 0.1, 0.1, 0], LocalizeOptions(margin=0.1))) == [0, 3]


def test_of_the_candidates_the_one_with_most_inliers_wins(world: Any) -> None:
    where = world((CAMERA,) * 3)
    image = where.view(2)
    # It looks more like scene 0, but only scene 2 explains it.
    where.looks_like(image, [1.0, 0.9, 0.95, 0])
    where.assert_right(Localizer(where.maps).localize(image), image, "scene-2")
    assert where.oracle.asked == [0, 2, 1]
    blind = Localizer(where.maps, LocalizeOptions(candidates=1)).localize(image)
    assert blind.inlier_ratio < 0.1


def test_a_head_that_decides_itself_is_asked_once_and_the_atlas_tells_the_scene(world: Any) -> None:
    where = world((CAMERA,) * 3, condition="descriptor")
    for scene in (2, 0, 1):
        image = where.view(scene)
        where.oracle.asked.clear()
        where.assert_right(Localizer(where.maps).localize(image), image, f"scene-{scene}")
        assert len(where.oracle.asked) == 1
    image = where.view(1)
    told = where.oracle.told[1, int(image[0, 0, 0])]
    told += 500.0  # far from all cells
    found = Localizer(where.maps).localize(image)
    assert found.status == "failed"
    assert "cell" in found.reason


def test_a_head_that_decides_itself_takes_the_camera_of_the_scene_it_finds(world: Any) -> None:
    wide = Camera(640, 480, 400.0, 410.0, 300.0, 250.0)
    where = world((CAMERA, wide), condition="descriptor")
    for scene, camera in enumerate((CAMERA, wide)):
        image = where.view(scene, camera)
        where.assert_right(Localizer(where.maps).localize(image), image, f"scene-{scene}")
