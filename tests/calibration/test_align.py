"""A map in a frame of its own is aligned to the robot's base frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evercal.calibration.drift import check
from evercal.calibration.from_images import calibrate
from evercal.calibration.from_map.align import MapAlignment, align_by_gripper
from evercal.calibration.from_map.by_points import Picks, align_by_points, fit_picks
from evercal.calibration.from_map.known_distance import by_distances
from evercal.calibration.image_source import Images
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, UncertainPose, pose_distance
from evercal.localization.localizer import Localizer
from evercal.map import Map
from evercal.mapping.map_frame import Similarity
from evercal.mapping.scene_map import MapContents
from evercal.mapping.store import MapStore
from evercal.recordings import write_image
from evercal.recordings.frame import Recording
from evercal.simulation.box_room import BoxRoom

NamedImages = list[tuple[str, np.ndarray]]
BASE_FROM_MAP = SE3.exp([0.8, -0.3, 0.1, 0.2, -0.1, 1.2])
GRIPPER_FROM_CAMERA = SE3.exp([0.05, 0.02, 0.08, 0.1, 0.2, -0.4])


@pytest.fixture(scope="module")
def arm_views(hall: Recording, hall_room: BoxRoom) -> tuple[NamedImages, SE3]:
    """Ten images with tilted cameras along the walk of the hall, and their map_from_camera."""
    rng = np.random.default_rng(3)
    poses = []
    images = []
    camera = hall.train[0].camera
    for i, frame in enumerate(hall.train[2::3]):
        assert frame.base_from_camera is not None
        tilt = SE3.exp([0, 0, 0, *rng.normal(0, np.deg2rad(9), 3)])
        poses.append(frame.base_from_camera @ tilt)
        images.append((f"{i}.png", hall_room.render(camera, poses[-1])))
    return images, SE3.stack(poses)


@pytest.fixture
def localizer(hall_map: MapContents) -> Localizer:
    return Localizer(hall_map)


def gripper_poses(map_from_camera: SE3, scale: float = 1.0) -> SE3:
    similarity = Similarity(BASE_FROM_MAP, scale)
    base_from_camera = SE3.stack([similarity.pose(pose) for pose in map_from_camera])
    return base_from_camera @ GRIPPER_FROM_CAMERA.inverse()


def aligned(contents: MapContents, alignment: MapAlignment) -> MapContents:
    """The map with its only scene aligned."""
    scene = alignment.applied_to(contents.scenes[0])
    return MapContents(contents.encoder, contents.short_side, [scene])


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_camera_on_the_gripper_determines_the_base(
    scale: float, arm_views: tuple[NamedImages, SE3], localizer: Localizer
) -> None:
    images, map_from_camera = arm_views
    alignment = align_by_gripper(
        localizer, "hall", images, gripper_poses(map_from_camera, scale), scale == 1.0
    )
    assert alignment.given == 10
    assert alignment.warnings == ()
    assert alignment.used >= 8
    assert alignment.used + len(alignment.left_out) == 10
    assert alignment.similarity.scale == pytest.approx(scale, rel=0.01)
    assert alignment.gripper_from_camera is not None
    assert pose_distance(alignment.gripper_from_camera, GRIPPER_FROM_CAMERA)[0] < 0.01
    # An exact pose in the middle of the scene has the error of the alignment alone.
    truth = Similarity(BASE_FROM_MAP, scale).pose(map_from_camera[5])
    frame = alignment.applied_to(localizer.contents.scenes[0]).frame
    exact = replace(
        frame, common=SE3.identity(), correction=None, pose_sigma=(0.0, 0.0)
    )
    estimate = exact.to_base(UncertainPose.exact(map_from_camera[5]))
    metres, _ = pose_distance(estimate.pose, truth)
    assert metres < 0.004 * scale
    assert metres < 4 * np.sqrt(np.trace(estimate.covariance[:3, :3]))


def test_a_scale_that_the_arm_contradicts_is_estimated_and_named(
    arm_views: tuple[NamedImages, SE3], localizer: Localizer
) -> None:
    images, map_from_camera = arm_views
    alignment = align_by_gripper(
        localizer, "hall", images, gripper_poses(map_from_camera, 1.05)
    )
    assert alignment.similarity.scale == pytest.approx(1.05, rel=0.01)
    (warning,) = alignment.warnings
    assert "too short, by the robot's motions" in warning
    frame = alignment.applied_to(localizer.contents.scenes[0]).frame
    exact = replace(frame, pose_sigma=(0.0, 0.0))
    for pose in map_from_camera[::3]:
        estimate = exact.to_base(UncertainPose.exact(pose))
        metres, _ = pose_distance(
            estimate.pose, Similarity(BASE_FROM_MAP, 1.05).pose(pose)
        )
        assert metres < 4 * np.sqrt(np.trace(estimate.covariance[:3, :3]))


def test_board_in_the_gripper_determines_the_base(
    arm_views: tuple[NamedImages, SE3], localizer: Localizer
) -> None:
    images, map_from_camera = arm_views
    rng = np.random.default_rng(0)
    gripper_from_board = SE3.exp([0.0, 0.1, 0.05, 0.3, 0.0, 0.5])
    grippers = SE3.exp(rng.normal(0, np.repeat([0.2, 0.5], 3), (len(images), 6)))
    boards = (
        map_from_camera.inverse()
        @ BASE_FROM_MAP.inverse()
        @ grippers
        @ gripper_from_board
    )
    board_poses = {name: pose for (name, _), pose in zip(images, boards, strict=True)}
    alignment = align_by_gripper(localizer, "hall", images, grippers, True, board_poses)
    metres, radians = pose_distance(alignment.similarity.base_from_map, BASE_FROM_MAP)
    assert metres < 0.01
    assert np.rad2deg(radians) < 0.5
    with pytest.raises(InputError, match="board"):
        align_by_gripper(localizer, "hall", images, grippers, False, board_poses)


@pytest.mark.parametrize(("scale", "longer"), [(0.4, 1.0), (1.0, 1.1)])
def test_touched_points_determine_the_base(
    scale: float,
    longer: float,
    arm_views: tuple[NamedImages, SE3],
    localizer: Localizer,
    hall_room: BoxRoom,
) -> None:
    """Also by images of another camera, whose focal length is longer than that of the map."""
    images, map_from_camera = arm_views
    similarity = Similarity(BASE_FROM_MAP, scale)
    camera = localizer.contents.scenes[0].camera
    if longer != 1:
        camera = replace(camera, fx=longer * camera.fx, fy=longer * camera.fy)
        images = [
            (f"{i}.png", hall_room.render(camera, p))
            for i, p in enumerate(map_from_camera)
        ]
    # A flat wall leaves another focal length open, so the later images are refused then.
    some, seen_from = (slice(2, 9, 2), 5) if longer == 1 else (slice(0, 5), 2)
    eye = map_from_camera[seen_from].translation_m
    rotation = map_from_camera[seen_from].rotation_matrix()
    corners = np.array([[80, 60], [240, 60], [80, 180], [240, 180], [160, 120]], float)
    in_map, _ = hall_room.intersect(eye, camera.unproject(corners) @ rotation.T)
    points = {f"p{i}": similarity.points(point) for i, point in enumerate(in_map)}
    picks = []
    for (name, image), pose in list(zip(images, map_from_camera, strict=True))[some]:
        pixels = camera.project(pose.inverse().apply(in_map))
        inside = ((pixels > 0) & (pixels < [319, 239])).all(1)
        visible = {f"p{i}": pixels[i] for i in np.flatnonzero(inside)}
        picks += [(name, image, visible)] if visible else []
    alignment = align_by_points(
        localizer, "hall", points, picks, scale_known=scale == 1.0
    )
    assert alignment.similarity.scale == pytest.approx(scale, rel=0.01)
    np.testing.assert_allclose(
        alignment.similarity.points(in_map), list(points.values()), atol=0.01
    )
    with pytest.raises(InputError, match="of 1 images with picks"):
        align_by_points(localizer, "hall", points, picks[:1])
    apart = float(np.linalg.norm(points["p1"] - points["p0"]))
    other = float(np.linalg.norm(points["p2"] - points["p0"]))
    distances = {("p0", "p1"): apart, ("p0", "p2"): other}
    by_distance = by_distances(localizer, "hall", distances, picks)
    near = 0.01 if longer == 1 else 0.03
    assert by_distance.similarity.scale == pytest.approx(scale, rel=near)
    assert not by_distance.warnings
    assert by_distance.sigma[0] > 0
    distances["p0", "p1"] *= 1.5
    wrong = by_distances(localizer, "hall", distances, picks)
    # The lens that is 10 % longer than stated leaves the scale of a flat wall too open.
    assert (longer != 1) or "the distances disagree by" in wrong.warnings[0]
    with pytest.raises(InputError, match="point nowhere was not picked"):
        by_distances(localizer, "hall", {("p0", "nowhere"): 1.0}, picks)


def test_too_few_images_and_unknown_scenes_are_refused(
    arm_views: tuple[NamedImages, SE3], localizer: Localizer
) -> None:
    images, map_from_camera = arm_views
    with pytest.raises(
        InputError, match="2 of 2 images were located in hall; give at least 5"
    ):
        align_by_gripper(
            localizer, "hall", images[:2], gripper_poses(map_from_camera[:2])
        )
    with pytest.raises(InputError, match="scene 'attic': the map has only hall"):
        align_by_gripper(localizer, "attic", images, gripper_poses(map_from_camera))


def test_aligning_again_starts_from_the_map_and_leaves_the_localizer_unchanged(
    arm_views: tuple[NamedImages, SE3], hall_map: MapContents
) -> None:
    images, map_from_camera = arm_views
    elsewhere = Similarity(SE3.exp([5.0, 0, 0, 0, 0, 0.5]), 1.5)
    first = aligned(hall_map, MapAlignment(elsewhere, np.eye(6) * 1e-6, 10, 10, ""))
    # What the recording's poses were off is not added to later answers.
    off = replace(
        first.scenes[0].frame, common=SE3.exp([0.02, -0.01, 0.01, 0.01, 0, 0])
    )
    first = replace(first, scenes=[replace(first.scenes[0], frame=off)])
    localizer = Localizer(first)
    before = localizer.localize(images[4][1])
    alignment = align_by_gripper(
        localizer, "hall", images, gripper_poses(map_from_camera)
    )
    after = localizer.localize(images[4][1])
    again = Localizer(aligned(first, alignment)).localize(images[4][1])
    assert before.base_from_camera is not None
    assert after.base_from_camera is not None
    assert again.base_from_camera is not None
    np.testing.assert_array_equal(
        before.base_from_camera.matrix(), after.base_from_camera.matrix()
    )
    truth = BASE_FROM_MAP @ map_from_camera[4]
    assert pose_distance(again.base_from_camera, truth)[0] < 0.006


def test_calibration_before_a_second_alignment_is_of_another_map(
    arm_views: tuple[NamedImages, SE3], hall_map: MapContents
) -> None:
    images, _ = arm_views
    now = images[4:5] * 3
    similarity = Similarity(BASE_FROM_MAP)
    first = MapAlignment(similarity, np.eye(6) * 1e-8, 10, 10, "")
    localizer = Localizer(aligned(hall_map, first))
    reference = calibrate(localizer, Images(now))
    assert check(localizer, now, reference).same_map
    # The base moves by half a millimetre, within the uncertainty of its alignment.
    nudged = Similarity(SE3.exp([5e-4, 0, 0, 0, 0, 0]) @ BASE_FROM_MAP)
    for other in (nudged, Similarity(BASE_FROM_MAP, 1.0001)):
        again = replace(first, similarity=other, base_covariance=np.eye(6) * 1e-6)
        shift = check(Localizer(aligned(hall_map, again)), now, reference)
        assert not shift.same_map
        assert not shift.moved


@pytest.mark.parametrize("form", ["verb", "method"])
def test_a_map_on_disk_is_aligned(
    form: str, arm_views: tuple[NamedImages, SE3], hall_map: MapContents, tmp_path: Path
) -> None:
    from evercal.cli import main

    images, map_from_camera = arm_views
    store = MapStore(
        tmp_path / "map", MapContents(hall_map.encoder, hall_map.short_side)
    )
    store.commit(hall_map.scenes[0], {})
    (tmp_path / "arm").mkdir()
    rows = ["image,x,y,z,qw,qx,qy,qz"]
    for (name, image), pose in zip(images, gripper_poses(map_from_camera), strict=True):
        write_image(tmp_path / "arm" / name, image)
        rows.append(
            ",".join(map(str, [name, *pose.translation_m, *pose.rotation_wxyz]))
        )
    (tmp_path / "poses.csv").write_text("\n".join(rows))
    words = [
        tmp_path / "map",
        "hall",
        tmp_path / "arm",
        "--robot-poses",
        tmp_path / "poses.csv",
    ]
    if form == "verb":
        assert main(["align", *map(str, words)]) == 0
    else:
        poses = gripper_poses(map_from_camera)
        Map.open(tmp_path / "map").align(
            "hall", [i for _, i in images], robot_poses=poses
        )
    estimate = Localizer.open(tmp_path / "map").localize(images[4][1])
    assert estimate.base_from_camera is not None
    truth = BASE_FROM_MAP @ map_from_camera[4]
    assert pose_distance(estimate.base_from_camera, truth)[0] < 0.006
    assert main(["align", str(tmp_path / "map"), "hall"]) == 2


CAMERA = Camera(640, 480, 600, 600, 320, 240)
MIDDLE = np.array([0.5, 0.0, 0.2])


def views(
    truth: Similarity, points: np.ndarray, sigma_px: float, rng: np.random.Generator
) -> list[Picks]:
    """Noisy picks in four located images around the points."""
    images = []
    for _ in range(4):
        eye = MIDDLE + 1.2 * Rotation.random(rng=rng).apply([0, 0, -1])
        z = (MIDDLE - eye) / 1.2
        x = np.cross([0, 0.3, 1], z)
        x /= np.linalg.norm(x)
        matrix = np.eye(4)
        matrix[:3, :3] = np.stack([x, np.cross(z, x), z], 1)
        matrix[:3, 3] = eye
        base_from_camera = SE3.from_matrix(matrix)
        pixels = CAMERA.project(base_from_camera.inverse().apply(points))
        pixels = pixels + rng.normal(0, sigma_px, pixels.shape)
        map_from_camera = truth.inverse_pose(base_from_camera)
        names = tuple(f"p{i}" for i in range(len(points)))
        images.append(Picks(map_from_camera, CAMERA, points, names, pixels))
    return images


def drawn(seed: int) -> tuple[Similarity, np.ndarray, np.random.Generator]:
    rng = np.random.default_rng(seed)
    truth = Similarity(SE3.exp(rng.normal(0, 1, 6)), float(np.exp(rng.normal(0, 0.5))))
    return truth, rng.uniform(-0.3, 0.3, (6, 3)) + MIDDLE, rng


def test_exact_picks_give_the_exact_similarity() -> None:
    truth, points, rng = drawn(0)
    similarity, _, _ = fit_picks(views(truth, points, 0.0, rng), scale_known=False)
    assert similarity.scale == pytest.approx(truth.scale, rel=1e-6)
    in_map = truth.base_from_map.inverse().apply(points) / truth.scale
    assert similarity.points(in_map) == pytest.approx(points, abs=1e-6)


def test_covariance_covers_the_errors() -> None:
    squared = []
    for seed in range(25):
        truth, points, rng = drawn(seed)
        similarity, covariance, _ = fit_picks(
            views(truth, points, 1.0, rng), scale_known=False
        )
        in_map = truth.base_from_map.inverse().apply(points) / truth.scale
        estimate = similarity.points(in_map)
        # The seven parameters that map the estimates to the points, by linear least squares.
        rows = []
        for x, y, z in estimate:
            rotation = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
            away = np.array([x, y, z]) - points.mean(0)
            rows.append(np.column_stack([np.eye(3), rotation, away]))
        error = np.linalg.lstsq(
            np.concatenate(rows), (points - estimate).ravel(), rcond=None
        )[0]
        squared.append(error @ np.linalg.solve(covariance, error))
    assert 2.5 < np.mean(squared) < 9.0  # 7 for an exact covariance


def test_too_few_points_and_points_on_a_line_are_refused() -> None:
    truth, points, rng = drawn(0)
    line = MIDDLE + np.linspace(-0.2, 0.2, 4)[:, None] * np.array([1.0, 0.5, 0.2])
    with pytest.raises(InputError, match="on one line"):
        fit_picks(views(truth, line, 0.0, rng), scale_known=True)
    with pytest.raises(InputError, match="2 points were picked"):
        fit_picks(views(truth, points[:2], 0.0, rng), scale_known=True)
