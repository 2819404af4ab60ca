"""Cameras calibrated in a map: fixed, on the gripper, in rigs; outliers, drift and audits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evercal.calibration.audit import audit
from evercal.calibration.drift import check, shift_between
from evercal.calibration.from_images import Images, calibrate
from evercal.calibration.located import Located, fuse, halves_apart
from evercal.calibration.rig import rig_of
from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance
from evercal.localization.estimate import PoseEstimate
from evercal.localization.localizer import Localizer
from evercal.mapping.scene_maps import SceneMaps
from evercal.recordings import write_image
from evercal.recordings.frame import Frame, Recording

Draw = Callable[[Frame, int, int], list[tuple[str, np.ndarray]]]


def estimate(scene: str | None, reason: str = "") -> PoseEstimate:
    pose = None if scene is None else SE3.identity()
    status = "unknown_scene" if scene is None else "ok"
    return PoseEstimate(status, reason, scene, pose, np.eye(6) * 1e-6, 100, 0.5, 1.0)


def located(poses: SE3, scenes: Sequence[str | None] | None = None) -> list[Located]:
    names = scenes or ["room"] * len(poses)
    return [
        Located(f"{i}.png", estimate(names[i], "too dark"), pose, np.eye(6) * 1e-6)
        for i, pose in enumerate(poses)
    ]


def scattered(count: int, seed: int = 0, sigma: float = 5e-4) -> tuple[SE3, SE3]:
    rng = np.random.default_rng(seed)
    truth = SE3.exp(rng.normal(0, 1, 6))
    return truth, truth @ SE3.exp(rng.normal(0, sigma, (count, 6)))


def test_poses_are_put_together_without_the_outliers() -> None:
    truth, poses = scattered(20)
    far = truth @ SE3.exp([0.03, 0, 0, 0, 0, 0])
    turned = truth @ SE3.exp([0, 0, 0, 0, 0.05, 0])
    fused = fuse(located(SE3.stack([*poses, far, turned])))
    assert fused.used.tolist() == [True] * 20 + [False] * 2
    assert "30.0 mm" in fused.uses[20].reason
    assert "2.8" in fused.uses[21].reason
    metres, radians = pose_distance(fused.pose, truth)
    assert metres < 5e-4
    assert radians < 5e-4


def test_the_order_of_images_does_not_matter() -> None:
    _, poses = scattered(15)
    order = np.random.default_rng(1).permutation(15)
    one, other = fuse(located(poses)), fuse(located(poses[order]))
    assert max(pose_distance(one.pose, other.pose)) < 1e-9
    assert one.scatter == pytest.approx(other.scatter)


def test_the_scatter_is_that_of_one_image() -> None:
    _, poses = scattered(400, sigma=1e-3)
    scatter = fuse(located(poses)).scatter
    assert np.sqrt(np.diag(scatter)) == pytest.approx([1e-3] * 6, rel=0.15)


def test_images_of_other_places_are_named() -> None:
    _, poses = scattered(5)
    fused = fuse(located(poses, ["room", "hall", None, "room", "room"]))
    assert fused.scene == "room"
    assert fused.used.tolist() == [True, False, False, True, True]
    assert fused.uses[1].reason == "shows scene hall, most images show room"
    assert fused.uses[2].reason == "unknown scene: too dark"


def test_no_image_of_a_known_place_is_an_error() -> None:
    _, poses = scattered(2)
    with pytest.raises(InputError, match="none of 2 images was located"):
        fuse(located(poses, [None, None]))


def test_halves_need_four_images() -> None:
    _, poses = scattered(40, sigma=1e-3)
    assert halves_apart(poses[:3]) is None
    halves = halves_apart(poses)
    assert halves is not None
    # Two means of 20 with 1 mm an axis lie some tenths of a millimetre apart.
    assert 0.05 < halves[0] < 2.0


@pytest.fixture(scope="module")
def localizer(hall_maps: SceneMaps) -> Localizer:
    return Localizer(hall_maps)


@pytest.fixture(scope="module")
def noisy() -> Draw:
    """Images of a frame as a camera takes them again and again."""

    def draw(frame: Frame, count: int, seed: int) -> list[tuple[str, np.ndarray]]:
        rng, image = np.random.default_rng(seed), frame.read_image().astype(float)
        return [
            (f"{seed}-{i}.png", (image + rng.normal(0, 4, image.shape)).clip(0, 255).astype("u1"))
            for i in range(count)
        ]

    return draw


def truth_of(frame: Frame) -> SE3:
    assert frame.base_from_camera is not None
    return frame.base_from_camera


def test_a_fixed_camera_is_found_within_its_uncertainty(
    localizer: Localizer, hall: Recording, noisy: Draw
) -> None:
    frame = hall.test[3]
    found = calibrate(localizer, Images(noisy(frame, 6, 0), frame.camera))
    metres, radians = pose_distance(found.parent_from_child, truth_of(frame))
    assert found.mount == "eye_to_hand"
    assert metres < 0.004
    assert metres < 4 * found.sigma_mm / 1000
    assert radians < 4 * np.deg2rad(found.sigma_deg)
    assert "will not help" in found.verdict
    assert [image.used for image in found.images] == [True] * 6


def test_many_images_from_one_spot_are_hardly_better_than_few(
    localizer: Localizer, hall: Recording, noisy: Draw
) -> None:
    frame = hall.test[3]
    few = calibrate(localizer, Images(noisy(frame, 2, 0), frame.camera))
    many = calibrate(localizer, Images(noisy(frame, 12, 0), frame.camera))
    assert many.sigma_mm > 0.7 * few.sigma_mm


def test_a_camera_on_the_gripper_is_told_from_its_motion(
    localizer: Localizer, hall: Recording
) -> None:
    gripper_from_camera = SE3.exp([0.05, -0.02, 0.1, 0.3, 0.2, -1.0])
    frames = hall.test[::3]
    grippers = SE3.stack([truth_of(f) @ gripper_from_camera.inverse() for f in frames])
    images = [(f.name, f.read_image()) for f in frames]
    found = calibrate(localizer, Images(images, frames[0].camera, grippers))
    assert found.mount == "eye_in_hand"
    assert found.parent_frame == "gripper"
    metres, _ = pose_distance(found.parent_from_child, gripper_from_camera)
    assert metres < 0.004
    assert metres < 4 * found.sigma_mm / 1000


def test_eye_in_hand_needs_a_pose_for_every_image(localizer: Localizer, hall: Recording) -> None:
    images = [("a", hall.test[0].read_image())]
    with pytest.raises(InputError, match="--robot-poses"):
        calibrate(localizer, Images(images), "eye_in_hand")
    with pytest.raises(InputError, match="1 images and 2 robot poses"):
        calibrate(localizer, Images(images, base_from_gripper=SE3.identity((2,))))


def test_drift_is_seen_and_rest_is_not(localizer: Localizer, hall: Recording, noisy: Draw) -> None:
    frame = hall.test[3]
    reference = calibrate(localizer, Images(noisy(frame, 10, 0), frame.camera))
    now = noisy(frame, 5, 1)
    shift, _ = check(localizer, now, reference)
    assert shift.same_map
    assert not shift.moved
    for six in ([0.002, 0, 0, 0, 0, 0], [0, 0, 0, 0, np.deg2rad(0.1), 0]):
        # The camera is where it was, and the reference says elsewhere.
        elsewhere = replace(reference, parent_from_child=reference.parent_from_child @ SE3.exp(six))
        shift, _ = check(localizer, now, elsewhere)
        assert shift.moved
        assert shift.translation_mm == pytest.approx(1000 * np.linalg.norm(six[:3]), abs=0.5)


def test_a_reference_of_another_map_counts_with_its_whole_uncertainty(
    localizer: Localizer, hall: Recording, noisy: Draw
) -> None:
    frame = hall.test[3]
    reference = calibrate(localizer, Images(noisy(frame, 5, 0), frame.camera))
    foreign = replace(reference, source={"command": "solve"})
    items = [
        Located(name, found, found.base_from_camera or SE3.identity(), found.covariance)
        for name, image in noisy(frame, 5, 1)
        if (found := localizer.localize(image, frame.camera)).covariance is not None
    ]
    own = shift_between(reference, fuse(items), items, localizer)
    other = shift_between(foreign, fuse(items), items, localizer)
    assert not other.same_map
    assert other.sigma_mm > 1.1 * own.sigma_mm
    with pytest.raises(InputError, match="on the gripper"):
        shift_between(replace(reference, mount="eye_in_hand"), fuse(items), items, localizer)


def test_a_rig_knows_its_cameras_relative_to_each_other(
    localizer: Localizer, hall: Recording, noisy: Draw
) -> None:
    frames = {"left": hall.test[2], "right": hall.test[5]}
    rig = rig_of({name: calibrate(localizer, Images(noisy(f, 2, 0))) for name, f in frames.items()})
    [pair] = rig.relative
    truth = truth_of(frames["left"]).inverse() @ truth_of(frames["right"])
    metres, _ = pose_distance(pair.first_from_second, truth)
    assert (pair.first, pair.second) == ("left", "right")
    assert metres < 0.006
    assert pair.sigma_mm > max(found.sigma_mm for found in rig.cameras.values()) * 0.7
    with pytest.raises(InputError, match="at least two"):
        rig_of({"left": rig.cameras["left"]})


def test_episodes_with_wrong_poses_are_listed(
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
    found = {episode.name: episode for episode in audit(localizer, tmp_path)}
    assert {name: e.verdict for name, e in found.items()} == {
        "good": "right",
        "moved": "wrong",
        "dark": "unknown",
    }
    assert found["moved"].translation_mm == pytest.approx(30, abs=4)
    (tmp_path / "bare").mkdir()
    write_image(tmp_path / "bare" / "0.png", frame.read_image())
    with pytest.raises(InputError, match=r"bare: states no camera pose.*--calibration"):
        audit(localizer, tmp_path)


def test_an_episode_inside_a_bag_is_audited_too(
    localizer: Localizer, hall: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "bag").mkdir()
    frames = tuple(replace(frame, image=frame.read_image()) for frame in hall.test[3:4])
    monkeypatch.setattr(
        "evercal.calibration.audit.load_recording", lambda _: Recording("bag", frames, ())
    )
    [episode] = audit(localizer, tmp_path)
    assert episode.verdict == "right"
