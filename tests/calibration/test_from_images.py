"""Cameras calibrated in a map: fixed, on the gripper, in rigs; drift and audits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evercal.calibration.audit import audit
from evercal.calibration.calibration import Calibration, ErrorTerm, largest_term, rig_of
from evercal.calibration.drift import check
from evercal.calibration.from_images import _lens_advice as lens_advice, calibrate
from evercal.calibration.from_map.spots import _spots as spots_of, from_many_spots
from evercal.calibration.image_source import Images
from evercal.calibration.located import ImagePose, fuse, in_parent_frame
from evercal.errors import InputError
from evercal.geometry import SE3, UncertainPose, deviations, pose_distance
from evercal.localization.estimate import PoseEstimate
from evercal.localization.localizer import Localizer
from evercal.mapping.scene_map import MapContents
from evercal.recordings import write_image
from evercal.recordings.formats import generic
from evercal.recordings.frame import Frame, Recording
from evercal.robot.mount import MountName

CAUSES = ["view", "lens", "map", "stated poses", "base frame"]
Draw = Callable[[Frame, int, int], list[tuple[str, np.ndarray]]]


@pytest.fixture(scope="module")
def localizer(hall_map: MapContents) -> Localizer:
    return Localizer(hall_map)


@pytest.fixture(scope="module")
def noisy() -> Draw:
    """Repeated images of a frame with sensor noise."""

    def draw(frame: Frame, count: int, seed: int) -> list[tuple[str, np.ndarray]]:
        rng = np.random.default_rng(seed)
        image = frame.read_image().astype(float)
        return [
            (
                f"{seed}-{i}.png",
                (image + rng.normal(0, 4, image.shape)).clip(0, 255).astype("u1"),
            )
            for i in range(count)
        ]

    return draw


def truth_of(frame: Frame) -> SE3:
    assert frame.base_from_camera is not None
    return frame.base_from_camera


@pytest.fixture(scope="module")
def fixed(localizer: Localizer, hall: Recording, noisy: Draw) -> Calibration:
    """A fixed camera from six images."""
    frame = hall.test[3]
    return calibrate(localizer, Images(noisy(frame, 6, 0), frame.camera))


def rms_variances(calibration: Calibration) -> tuple[float, float]:
    """Sums of the squared terms, millimetres and degrees."""
    terms = calibration.error_terms
    return sum(t.translation_mm**2 for t in terms), sum(
        t.rotation_deg**2 for t in terms
    )


def test_fixed_camera_within_its_uncertainty(
    fixed: Calibration, hall: Recording
) -> None:
    metres, radians = pose_distance(fixed.parent_from_child, truth_of(hall.test[3]))
    assert (fixed.mount, fixed.parent_frame) == ("eye_to_hand", "base")
    assert metres < 0.004
    assert metres < 4 * fixed.sigma_mm / 1000
    assert radians < 4 * np.deg2rad(fixed.sigma_deg)
    assert "will not help" in fixed.verdict
    assert [image.used for image in fixed.images] == [True] * 6


def test_terms_of_a_fixed_camera_are_its_images_causes(
    fixed: Calibration, localizer: Localizer, hall: Recording, noisy: Draw
) -> None:
    frame = hall.test[3]
    rows = rms_variances(fixed)
    assert [term.name for term in fixed.error_terms] == [*CAUSES, "scatter of 6 images"]
    assert rows == pytest.approx((fixed.sigma_mm**2, fixed.sigma_deg**2))
    images = noisy(frame, 6, 0)
    estimates = [localizer.localize(image, frame.camera) for _, image in images]
    for number, term in enumerate(fixed.error_terms[:-1]):
        own = [estimate.terms[number].covariance for estimate in estimates]
        assert term == ErrorTerm.of(term.name, np.mean(own, axis=0))
    # More images from one spot hardly reduce the uncertainty.
    few = calibrate(localizer, Images(images[:2], frame.camera))
    assert fixed.sigma_mm > 0.7 * few.sigma_mm


def test_terms_of_a_camera_on_the_gripper_contain_the_arm(
    localizer: Localizer, hall: Recording
) -> None:
    frames = hall.test[::3]
    rng = np.random.default_rng(0)
    noise = SE3.from_translation(rng.normal(0, 0.01, (len(frames), 3)))
    grippers = SE3.stack([truth_of(f) for f in frames]) @ noise
    images = [(f.name, f.read_image()) for f in frames]
    calibration = calibrate(localizer, Images(images, frames[0].camera, grippers))
    *own, arm = calibration.error_terms
    assert [term.name for term in own] == CAUSES
    assert arm.name.startswith("arm, and scatter among ")
    assert rms_variances(calibration) == pytest.approx(
        (calibration.sigma_mm**2, calibration.sigma_deg**2)
    )
    assert arm.translation_mm > 2 * max(term.translation_mm for term in own)


@pytest.mark.parametrize(
    ("mount", "intrinsics", "advice"),
    [
        ("eye_to_hand", "map", "give `camera` with intrinsics from images of a board"),
        ("eye_in_hand", "given", "; images from more spots determine it better."),
    ],
)
def test_advice_where_the_lens_is_the_largest_term(
    mount: MountName, intrinsics: str, advice: str
) -> None:
    def words(lens_mm: float) -> str:
        terms = (ErrorTerm("view", 1.0, 0.1), ErrorTerm("lens", lens_mm, 0.1))
        calibration = Calibration(
            mount,
            SE3.identity(),
            np.eye(6),
            error_terms=terms,
            source={"intrinsics": intrinsics},
        )
        return " ".join(lens_advice(calibration))

    assert words(0.9) == ""
    assert words(2.0).startswith(
        "The lens is the largest term, 80 % of the position's variance: "
    )
    assert advice in words(2.0)


@pytest.fixture(scope="module")
def adjusted(hall_map: MapContents) -> Localizer:
    """A map whose bundle adjustment changed the focal length by 3 %."""
    scene = hall_map.scenes[0]
    camera = replace(scene.camera, fx=1.03 * scene.camera.fx, fy=1.03 * scene.camera.fy)
    scene = replace(scene, adjusted_camera=camera)
    return Localizer(MapContents(hall_map.encoder, hall_map.short_side, [scene]))


def test_given_camera_is_used_and_saved(
    adjusted: Localizer, hall: Recording, noisy: Draw
) -> None:
    frame = hall.test[3]
    stated = adjusted.contents.scenes[0].camera
    camera = replace(stated, fx=1.0005 * stated.fx, fy=1.0005 * stated.fy)
    calibration = calibrate(adjusted, Images(noisy(frame, 2, 0), camera))
    assert pose_distance(calibration.parent_from_child, truth_of(frame))[0] < 0.006
    assert calibration.camera == camera
    # `check` takes this camera, not the other one of the map.
    assert not check(adjusted, noisy(frame, 2, 1), calibration).moved
    assert calibration.source["intrinsics"] == "given"
    assert "give `camera`" not in calibration.verdict
    lens = largest_term(calibration.error_terms)[0] == "lens"
    assert lens == ("The lens is the largest term" in calibration.verdict)
    assert lens  # where stated intrinsics are believed to 0.2 %


def test_intrinsics_that_the_images_contradict_are_replaced(
    localizer: Localizer, hall: Recording, noisy: Draw
) -> None:
    frame = hall.test[3]
    wrong = frame.camera.zoomed(0.95)
    calibration = calibrate(localizer, Images(noisy(frame, 2, 0), wrong))
    assert pose_distance(calibration.parent_from_child, truth_of(frame))[0] < 0.01
    assert calibration.camera is not None
    assert calibration.camera.fx == pytest.approx(frame.camera.fx, rel=0.01)
    words = (
        f"The stated intrinsics (focal length {wrong.fx:.1f} px) do not fit the images"
    )
    assert words in calibration.verdict


def test_without_a_camera_that_of_the_map_is_saved_at_the_size_of_the_images(
    localizer: Localizer, hall: Recording
) -> None:
    image = np.repeat(np.repeat(hall.test[3].read_image(), 2, 0), 2, 1)
    calibration = calibrate(localizer, Images([("a", image)]))
    assert calibration.camera == localizer.contents.scenes[0].adjusted_camera.resized(
        640, 480
    )
    assert calibration.source["intrinsics"] == "map"
    assert (
        "The intrinsics are those of the camera that recorded hall"
        in calibration.verdict
    )
    assert "It rests on one image" in calibration.verdict


def test_camera_on_the_gripper(localizer: Localizer, hall: Recording) -> None:
    gripper_from_camera = SE3.exp([0.05, -0.02, 0.1, 0.3, 0.2, -1.0])
    frames = hall.test[::3]
    grippers = SE3.stack([truth_of(f) @ gripper_from_camera.inverse() for f in frames])
    images = [(f.name, f.read_image()) for f in frames]
    calibration = calibrate(localizer, Images(images, frames[0].camera, grippers))
    assert calibration.mount == "eye_in_hand"
    assert calibration.parent_frame == "gripper"
    metres, _ = pose_distance(calibration.parent_from_child, gripper_from_camera)
    assert metres < 0.004
    assert metres < 4 * calibration.sigma_mm / 1000


def test_spots_differ_in_position_or_rotation() -> None:
    turned = SE3.exp([0, 0, 0, 0, 0, 0.5])
    away = SE3.exp([0.5, 0, 0, 0, 0, 0])
    assert spots_of([SE3.identity(), turned, away, SE3.identity()]).tolist() == [
        0,
        1,
        2,
        0,
    ]


def test_eye_in_hand_needs_a_pose_for_every_image(
    localizer: Localizer, hall: Recording
) -> None:
    images = [("a", hall.test[0].read_image())]
    with pytest.raises(InputError, match="`robot_poses`"):
        calibrate(localizer, Images(images), "eye_in_hand")
    with pytest.raises(InputError, match="1 images and 2 robot poses"):
        calibrate(localizer, Images(images, base_from_gripper=SE3.identity((2,))))
    with pytest.raises(InputError, match="state it with `mount`"):
        calibrate(localizer, Images(images, base_from_gripper=SE3.identity((1,))))


def test_images_from_files_and_arrays(hall: Recording, tmp_path: Path) -> None:
    frames = hall.test[:3]
    for number, frame in zip((2, 10, 1), frames, strict=True):
        write_image(tmp_path / f"{number}.png", frame.read_image())
    in_order = [f.read_image() for f in (frames[2], frames[0], frames[1])]
    files = [tmp_path / f"{i}.png" for i in (1, 2, 10)]
    assert Images.of(tmp_path).images == [(str(file), file) for file in files]
    for (_, image), expected in zip(
        Images.of(np.stack(in_order)).images, in_order, strict=True
    ):
        np.testing.assert_array_equal(image, expected)
    [(_, image)] = Images.of(in_order[0]).images
    np.testing.assert_array_equal(image, in_order[0])
    with pytest.raises(InputError, match=r"poses\.csv: .*give poses \(n,\)"):
        Images.of(in_order, robot_poses=tmp_path / "poses.csv")
    with pytest.raises(InputError, match="no image given"):
        Images.of([])


def test_motion_is_detected_and_rest_is_not(
    fixed: Calibration, localizer: Localizer, hall: Recording, noisy: Draw
) -> None:
    now = noisy(hall.test[3], 4, 1)
    own = check(localizer, now, fixed)
    assert own.same_map
    assert not own.moved
    for tangent in ([0.002, 0, 0, 0, 0, 0], [0, 0, 0, 0, np.deg2rad(0.1), 0]):
        # The camera has not moved; the reference states another pose.
        pose = fixed.parent_from_child @ SE3.exp(tangent)
        shift = check(localizer, now, replace(fixed, parent_from_child=pose))
        assert shift.moved
        assert shift.translation_mm == pytest.approx(
            1000 * np.linalg.norm(tangent[:3]), abs=0.5
        )
    [hall_scene] = localizer.contents.scenes
    renamed = replace(localizer.contents, scenes=[replace(hall_scene, name="lobby")])
    assert check(Localizer(renamed), now, fixed).same_map
    # A reference of another map adds its uncertainty.
    other = check(localizer, now, replace(fixed, source={"command": "solve"}))
    assert not other.same_map
    assert other.sigma_mm > 1.1 * own.sigma_mm
    with pytest.raises(InputError, match="on the gripper"):
        check(localizer, now[:1], replace(fixed, mount="eye_in_hand"))


def test_rig_contains_relative_poses(
    localizer: Localizer, hall: Recording, noisy: Draw
) -> None:
    frames = {"left": hall.test[2], "right": hall.test[5]}
    cameras = {
        name: calibrate(localizer, Images(noisy(f, 2, 0))) for name, f in frames.items()
    }
    [pair] = rig_of(cameras).relative
    truth = truth_of(frames["left"]).inverse() @ truth_of(frames["right"])
    assert (pair.first, pair.second) == ("left", "right")
    assert pose_distance(pair.first_from_second.pose, truth)[0] < 0.006
    assert (
        pair.first_from_second.sigma_mm
        > max(each.sigma_mm for each in cameras.values()) * 0.7
    )
    with pytest.raises(InputError, match="at least two"):
        rig_of({"left": cameras["left"]})


def test_episodes_with_wrong_poses_are_reported(
    localizer: Localizer, hall: Recording, tmp_path: Path
) -> None:
    frame = hall.test[3]
    for name, offset in (("good", 0.0), ("moved", 0.03)):
        (tmp_path / name).mkdir()
        write_image(tmp_path / name / "0.png", frame.read_image())
        stated = truth_of(frame) @ SE3.exp([offset, 0, 0, 0, 0, 0])
        np.savetxt(tmp_path / name / "base_from_camera.txt", stated.matrix())
    (tmp_path / "dark").mkdir()
    write_image(tmp_path / "dark" / "0.png", np.zeros((240, 320, 3), np.uint8))
    np.savetxt(tmp_path / "dark" / "base_from_camera.txt", np.eye(4))
    generic.write(tmp_path / "recording", Recording("recording", (hall.test[1],), ()))
    episodes = {episode.name: episode for episode in audit(localizer, tmp_path)}
    assert {name: episode.verdict for name, episode in episodes.items()} == {
        "good": "right",
        "moved": "wrong",
        "dark": "unknown",
        "recording": "right",
    }
    assert episodes["moved"].translation_mm == pytest.approx(30, abs=4)
    (tmp_path / "bare").mkdir()
    write_image(tmp_path / "bare" / "0.png", frame.read_image())
    with pytest.raises(InputError, match=r"bare: states no camera pose.*`calibration`"):
        audit(localizer, tmp_path)
    (tmp_path / "bare" / "scene.json").write_text("{")
    with pytest.raises(InputError, match=r"scene\.json"):
        audit(localizer, tmp_path, stated=truth_of(frame))


GRIPPER_FROM_CAMERA = SE3.exp([0.05, 0.02, 0.1, 0.1, 0.2, -0.3])
DOWN = SE3.exp([0, 0, 0, np.pi, 0, 0])


def drawn(pose: SE3, error: np.ndarray) -> SE3:
    """A pose with errors of its position, and about camera axes."""
    turned = pose @ SE3.exp(np.r_[0, 0, 0, error[3:]])
    return SE3(turned.rotation_wxyz, pose.translation_m + error[:3])


def squared_distance(seed: int, base_mm: float) -> float:
    """Squared Mahalanobis distance of one calibration from 15 spots."""
    rng = np.random.default_rng(seed)
    sigma = np.repeat([base_mm / 1000, np.deg2rad(0.05) * base_mm], 3)
    base = np.diag(sigma**2) + 1e-16 * np.eye(6)
    own = np.diag(np.repeat([0.3e-3, np.deg2rad(0.02)], 3) ** 2)
    motion = drawn(SE3.identity(), rng.normal(0, sigma))
    places = np.array([0.5, 0, 0.5]) + rng.uniform(-0.25, 0.25, (15, 3))
    turns = SE3.exp(np.pad(rng.uniform(-0.5, 0.5, (15, 3)), ((0, 0), (3, 0))))
    grippers = SE3.from_translation(places) @ DOWN @ turns
    located = []
    for i, camera in enumerate(grippers @ GRIPPER_FROM_CAMERA):
        pose = motion @ drawn(camera, rng.multivariate_normal(np.zeros(6), own))
        answer = UncertainPose(SE3.identity(), base) @ UncertainPose(pose, own)
        estimate = PoseEstimate(
            "ok", "", "hall", pose, answer.covariance, 100, 0.5, 1.0
        )
        located.append(ImagePose(str(i), estimate, pose, answer.covariance))
    moved = in_parent_frame(located, grippers.inverse())
    fused = fuse(moved)
    covariance, terms = from_many_spots(located, moved, fused, grippers, base)
    assert sum(term.name == "base frame" for term in terms) == 1
    error = deviations(SE3.stack([fused.pose]), GRIPPER_FROM_CAMERA)[0]
    return float(error @ np.linalg.solve(covariance, error))


@pytest.mark.parametrize("base_mm", [0.0, 1.0])
def test_errors_are_as_large_as_stated(base_mm: float) -> None:
    # The mean of a chi-squared of six dimensions is 6; few spots and a robust mean add to it.
    assert 2 < np.mean([squared_distance(seed, base_mm) for seed in range(20)]) < 10
