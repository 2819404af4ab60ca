"""Images located in a map: millimetres on new views, and a rejection for other rooms."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from evercal.errors import InputError
from evercal.geometry import SE3, Camera, pose_distance
from evercal.localization import acceptance
from evercal.localization.estimate import PoseEstimate
from evercal.localization.intrinsics import (
    cameras_in_scenes,
    prior_of,
)
from evercal.localization.localizer import Localizer
from evercal.localization.options import Attempt, LocalizeOptions
from evercal.localization.parallel import in_parallel
from evercal.localization.pnp import PnpOptions
from evercal.mapping.map_frame import MapFrame, Similarity
from evercal.mapping.scene_map import MapContents, SceneMap
from evercal.mapping.store import MapStore
from evercal.recordings.frame import Frame, Recording
from evercal.simulation.box_room import BoxRoom, default_camera

CAMERA = default_camera(320, 240)


def everything(estimate: PoseEstimate) -> list[bytes | object]:
    """An estimate without its time."""
    arrays = [estimate.covariance, estimate.pixels, estimate.points_m]
    if estimate.base_from_camera is not None:
        arrays.append(estimate.base_from_camera.matrix())
    plain = [
        estimate.status,
        estimate.reason,
        estimate.scene,
        estimate.inliers,
        estimate.support,
    ]
    return [*plain, *(None if array is None else array.tobytes() for array in arrays)]


def with_scene(contents: MapContents, scene: SceneMap) -> MapContents:
    """A map of one scene."""
    return MapContents(contents.encoder, contents.short_side, [scene])


def error(estimate: PoseEstimate, truth: SE3 | None) -> tuple[float, float]:
    """Metres and radians from the true pose; infinite without an estimate."""
    assert truth is not None
    if estimate.base_from_camera is None:
        return np.inf, np.inf
    metres, radians = pose_distance(estimate.base_from_camera, truth)
    return float(metres), float(radians)


def resized(frame: Frame, width: int, height: int) -> np.ndarray:
    return cv2.resize(frame.read_image(), (width, height), interpolation=cv2.INTER_AREA)


@pytest.fixture(scope="module")
def localizer(hall_map: MapContents) -> Localizer:
    return Localizer(hall_map)


@pytest.fixture(scope="module")
def views(hall: Recording) -> tuple[Frame, ...]:
    """Views of the hall that were not learned."""
    return hall.test[1::2]


@pytest.fixture(scope="module")
def estimates(localizer: Localizer, views: tuple[Frame, ...]) -> list[PoseEstimate]:
    return [localizer.localize(frame.read_image(), frame.camera) for frame in views]


def test_new_views_are_located_to_millimetres(
    estimates: list[PoseEstimate], views: tuple[Frame, ...]
) -> None:
    errors = np.array(
        [error(e, f.base_from_camera) for e, f in zip(estimates, views, strict=True)]
    )
    assert np.median(errors[:, 0]) < 0.003
    assert errors[:, 0].max() < 0.02
    assert np.median(errors[:, 1]) < np.deg2rad(0.1)
    for estimate in estimates:
        assert (estimate.status, estimate.reason, estimate.scene) == ("ok", "", "hall")
        assert estimate.milliseconds > 0
        assert estimate.pixels is not None
        assert estimate.points_m is not None
        assert estimate.base_from_camera is not None
        assert len(estimate.pixels) == len(estimate.points_m) == estimate.inliers > 100
        assert 0.3 < estimate.inlier_ratio <= 1
        projected = CAMERA.project(
            estimate.base_from_camera.inverse().apply(estimate.points_m)
        )
        assert np.linalg.norm(projected - estimate.pixels, axis=1).max() < 1.1


def test_alignment_halves_the_error_of_pnp(
    estimates: list[PoseEstimate], views: tuple[Frame, ...], hall_map: MapContents
) -> None:
    rough = Localizer(hall_map, LocalizeOptions(align=False))
    by_pnp = []
    aligned = []
    for f, estimate in list(zip(views, estimates, strict=True))[::2]:
        located = rough.localize(f.read_image(), f.camera)
        by_pnp.append(error(located, f.base_from_camera))
        aligned.append(error(estimate, f.base_from_camera))
    assert np.median(by_pnp, 0)[0] > 2 * np.median(aligned, 0)[0]


def test_covariance_matches_the_errors(
    estimates: list[PoseEstimate], views: tuple[Frame, ...]
) -> None:
    squares = []
    for estimate, frame in zip(estimates, views, strict=True):
        assert estimate.uncertain_pose is not None
        assert estimate.covariance is not None
        assert frame.base_from_camera is not None
        np.testing.assert_allclose(
            estimate.covariance, estimate.covariance.T, atol=1e-12
        )
        squares.append(
            estimate.uncertain_pose.squared_mahalanobis(frame.base_from_camera)
        )
    # The median is 5.3 for six Gaussian axes. A rendered room without clutter gives smaller errors.
    # A covariance that is wrong by a factor of three is outside of the bounds.
    assert 0.3 < np.median(squares) < 4.5


@pytest.mark.parametrize("seed", [77, 78, 79])
def test_other_rooms_are_rejected(seed: int, localizer: Localizer) -> None:
    room = BoxRoom(seed, texture_px=192)
    rng = np.random.default_rng(seed)
    for _ in range(2):
        estimate = localizer.localize(
            room.render(CAMERA, room.random_view(rng)), CAMERA
        )
        assert estimate.status in ("unknown_scene", "failed")
        assert estimate.reason
        assert estimate.scene is None
        assert estimate.base_from_camera is None
        assert estimate.covariance is None


@pytest.mark.parametrize("level", [0, 128, 255, None])
def test_blank_images_and_noise_are_rejected(
    level: int | None, localizer: Localizer
) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (240, 320, 3)).astype(np.uint8)
    image = noise if level is None else np.full((240, 320, 3), level, np.uint8)
    estimate = localizer.localize(image, CAMERA)
    assert estimate.status in ("unknown_scene", "failed")
    assert estimate.base_from_camera is None


def test_image_without_six_inliers_fails(
    hall_map: MapContents, hall: Recording
) -> None:
    strict = LocalizeOptions(pnp=PnpOptions(threshold_px=1e-7))
    estimate = Localizer(hall_map, strict).localize(hall.test[1].read_image())
    assert estimate.status == "failed"
    assert estimate.reason == "fewer than 6 inliers"
    assert estimate.inliers == estimate.inlier_ratio == estimate.support == 0


def test_estimates_do_not_depend_on_earlier_images(
    estimates: list[PoseEstimate],
    views: tuple[Frame, ...],
    localizer: Localizer,
    hall_map: MapContents,
) -> None:
    few = Localizer(hall_map, LocalizeOptions(loaded_keyframes=1))
    for frame, first in list(zip(views, estimates, strict=True))[::8]:
        image = frame.read_image()
        assert everything(localizer.localize(image, frame.camera)) == everything(first)
        assert everything(few.localize(image, frame.camera)) == everything(first)


@pytest.mark.usefixtures("two_threads")
def test_batch_equals_single_images(hall: Recording, hall_map: MapContents) -> None:
    frames = hall.test[1:13:4]
    single = Localizer(hall_map)
    fresh = Localizer(hall_map)
    # A localizer without decoded keyframes loads them in both threads at once.
    batch = in_parallel(lambda f: fresh.localize(f.read_image(), f.camera), frames)
    for frame, estimate in zip(frames, batch, strict=True):
        expected = single.localize(frame.read_image(), frame.camera)
        assert everything(estimate) == everything(expected)


def test_map_on_disk_gives_the_same_poses(
    estimates: list[PoseEstimate],
    views: tuple[Frame, ...],
    hall_map: MapContents,
    tmp_path: Path,
) -> None:
    MapStore(tmp_path / "map", hall_map.empty()).commit(hall_map.scenes[0], {})
    opened = Localizer.open(tmp_path / "map")
    for frame, first in list(zip(views, estimates, strict=True))[::6]:
        # Landmarks are stored in single precision.
        again = opened.localize(frame.read_image(), frame.camera)
        assert max(error(again, first.base_from_camera)) < 1e-4


def test_pose_and_points_are_in_the_base_frame_of_an_aligned_scene(
    estimates: list[PoseEstimate], views: tuple[Frame, ...], hall_map: MapContents
) -> None:
    similarity = Similarity(SE3.exp([9.0, -3.0, 1.0, 0.2, -0.1, 1.2]), 2.5)
    scene = hall_map.scenes[0]
    frame: MapFrame = replace(scene.frame, similarity=similarity)
    localizer = Localizer(with_scene(hall_map, replace(scene, frame=frame)))
    estimate = localizer.localize(views[0].read_image(), views[0].camera)
    assert estimates[0].base_from_camera is not None
    assert estimates[0].points_m is not None
    assert estimate.points_m is not None
    assert max(error(estimate, similarity.pose(estimates[0].base_from_camera))) < 1e-9
    np.testing.assert_allclose(
        estimate.points_m, similarity.points(estimates[0].points_m)
    )


def test_support_below_the_threshold_is_rejected(
    views: tuple[Frame, ...],
    localizer: Localizer,
    estimates: list[PoseEstimate],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for factor, status in ((0.9, "ok"), (1.1, "unknown_scene")):
        least = factor * estimates[0].support
        monkeypatch.setattr(acceptance, "FALSE_ACCEPTS", 10**-least)
        estimate = localizer.localize(views[0].read_image(), views[0].camera)
        assert estimate.status == status
        assert (f"{least:.1f} is required" in estimate.reason) == (status != "ok")


def test_default_camera_is_the_adjusted_one(
    hall_map: MapContents, views: tuple[Frame, ...]
) -> None:
    scene = hall_map.scenes[0]
    longer = replace(scene.camera, fx=1.03 * scene.camera.fx, fy=1.03 * scene.camera.fy)
    localizer = Localizer(with_scene(hall_map, replace(scene, adjusted_camera=longer)))
    image = views[0].read_image()
    for stated in (None, views[0].camera, longer):
        cameras = cameras_in_scenes(stated, image, localizer.contents.scenes)
        assert cameras == [longer]
    # Another scene has its own adjusted camera.
    both = [replace(scene, adjusted_camera=longer), replace(scene, camera=longer)]
    expected = [longer, scene.adjusted_camera]
    assert cameras_in_scenes(longer, image, both) == expected


@pytest.mark.parametrize("factor", [0.95, 0.995, 1.02])
def test_wrong_focal_length_is_corrected(
    factor: float, localizer: Localizer, views: tuple[Frame, ...]
) -> None:
    for frame in views[:3]:
        estimate = localizer.localize(frame.read_image(), frame.camera.zoomed(factor))
        assert error(estimate, frame.base_from_camera)[0] < 0.01
        assert estimate.camera is not None
        assert estimate.camera.fx == pytest.approx(frame.camera.fx, rel=0.01)
        assert estimate.uncertain_pose is not None
        assert frame.base_from_camera is not None
        assert (
            estimate.uncertain_pose.squared_mahalanobis(frame.base_from_camera) < 22.5
        )


def test_camera_of_a_crop_is_estimated(
    localizer: Localizer, views: tuple[Frame, ...]
) -> None:
    for frame in views[:3]:
        image = np.ascontiguousarray(frame.read_image()[20:220, 40:280])
        estimate = localizer.localize(image)
        assert error(estimate, frame.base_from_camera)[0] < 0.03
        assert estimate.camera is not None
        assert (estimate.camera.width, estimate.camera.height) == (240, 200)
        assert estimate.camera.fx == pytest.approx(frame.camera.fx, rel=0.02)


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_turned_images_are_located(
    turns: int, localizer: Localizer, views: tuple[Frame, ...]
) -> None:
    frame = views[0]
    assert frame.base_from_camera is not None
    image = np.ascontiguousarray(np.rot90(frame.read_image(), -turns))
    turned = frame.base_from_camera @ SE3.exp([0, 0, 0, 0, 0, -turns * np.pi / 2])
    assert error(localizer.localize(image), turned)[0] < 0.02


def test_prior_of_a_stated_camera(
    localizer: Localizer, views: tuple[Frame, ...]
) -> None:
    scene = localizer.contents.scenes[0]
    image = views[0].read_image()
    recorded = scene.camera
    other = replace(recorded, fx=1.0005 * recorded.fx)
    cameras = (recorded, scene.adjusted_camera, other, None)
    kinds = [prior_of(camera, image, scene).kind for camera in cameras]
    assert kinds == ["own", "own", "stated", "not stated"]


@pytest.mark.parametrize("size", [(640, 480), (200, 150)])
def test_images_and_cameras_have_any_size(
    size: tuple[int, int], localizer: Localizer, views: tuple[Frame, ...]
) -> None:
    image = resized(views[0], *size)
    camera = views[0].camera
    for given in (None, camera, camera.resized(1280, 960)):
        assert (
            error(localizer.localize(image, given), views[0].base_from_camera)[0] < 0.01
        )


def test_portrait_image_of_a_given_camera(
    localizer: Localizer, hall_room: BoxRoom
) -> None:
    camera = Camera(240, 320, 262.0, 262.0, 119.5, 159.5)
    truth = hall_view(hall_room)
    estimate = localizer.localize(hall_room.render(camera, truth), camera)
    assert error(estimate, truth)[0] < 0.02
    # Before a flat wall the focal length trades against the distance.
    unknown = localizer.localize(hall_room.render(camera, truth))
    assert unknown.status == "uncertain"
    assert "its position is uncertain by" in unknown.reason


def test_terms_sum_to_the_covariance(
    localizer: Localizer, views: tuple[Frame, ...]
) -> None:
    image = views[1].read_image()
    camera = views[1].camera
    own = localizer.localize(image, camera)
    stated = localizer.localize(image, replace(camera, fx=1.0001 * camera.fx))
    for estimate in (own, stated):
        names = [term.name for term in estimate.terms]
        assert names == ["view", "lens", "map", "stated poses", "base frame"]
        assert estimate.covariance is not None
        total = np.sum([term.covariance for term in estimate.terms], 0)
        np.testing.assert_allclose(total, estimate.covariance, atol=1e-15)
        for term in estimate.terms:
            assert np.linalg.eigvalsh(term.covariance).min() > -1e-12
    lens = [float(np.trace(e.terms[1].covariance[:3, :3])) for e in (own, stated)]
    assert lens[1] > 1.5 * lens[0]


def hall_view(room: BoxRoom) -> SE3:
    """A pose in the middle of the walk through the hall."""
    from evercal.simulation.box_room import look_at

    eye = np.array([0.0, 0.0, 1.3])
    heading = 34 + 0.45
    return look_at(eye, eye + np.array([np.cos(heading), np.sin(heading), -0.1]), 0.0)


def test_grey_image_equals_its_rgb_image(
    localizer: Localizer, views: tuple[Frame, ...]
) -> None:
    grey = cv2.cvtColor(views[0].read_image(), cv2.COLOR_RGB2GRAY)
    rgb = np.repeat(grey[..., None], 3, -1)
    assert everything(localizer.localize(grey)) == everything(localizer.localize(rgb))


def test_camera_of_another_aspect_ratio_is_refused(localizer: Localizer) -> None:
    image = np.zeros((90, 160, 3), np.uint8)
    with pytest.raises(
        InputError, match="camera 320x240 does not fit the image 160x90"
    ):
        localizer.localize(image, CAMERA)
    with pytest.raises(InputError, match="image"):
        localizer.localize(image[..., :2])


def test_a_wider_attempt_locates_what_the_first_rejects(
    hall_map: MapContents, views: tuple[Frame, ...]
) -> None:
    """One wrong keyframe is proposed first; the second attempt proposes all."""
    narrow = LocalizeOptions(attempts=(Attempt(1, 8), Attempt(48, 1)), keyframes=1)
    for view in views[::5]:
        estimate = Localizer(hall_map, narrow).localize(view.read_image(), view.camera)
        assert error(estimate, view.base_from_camera)[0] < 0.02


def test_unusable_paths_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=str(tmp_path)):
        Localizer.open(tmp_path)
    with pytest.raises(InputError, match="missing"):
        Localizer.open(str(tmp_path / "missing"))
