"""The protocol with a fake localizer that uses pixels only."""

import math
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.evaluation import evaluate
from evercal.evaluation.metrics import Status
from evercal.geometry import SE3, Camera
from evercal.localization.estimate import PoseEstimate
from evercal.recordings import Frame, Recording, generic

CAMERA = Camera(4, 3, 4.0, 4.0, 1.5, 1.0)


def estimate(
    status: Status,
    scene: str | None,
    base_from_camera: SE3 | None,
    inliers: int = 7,
    inlier_ratio: float = 0.25,
    covariance: np.ndarray | None = None,
) -> PoseEstimate:
    return PoseEstimate(
        status, "", scene, base_from_camera, covariance, inliers, inlier_ratio, 1.0
    )


@dataclass
class Fake:
    """Returns estimates by the first pixel of the image, and records their order."""

    estimates: dict[int, PoseEstimate]
    scenes: tuple[str, ...] = ("a", "b")
    calls: list[int] = field(default_factory=list)

    def localize(self, image: np.ndarray, camera: Camera | None = None) -> PoseEstimate:
        assert image.shape == (3, 4, 3)
        assert camera == CAMERA
        self.calls.append(int(image[0, 0, 0]))
        return self.estimates[self.calls[-1]]


def pose(x: float, degrees: float = 0.0) -> SE3:
    half = math.radians(degrees) / 2
    return SE3(
        np.array([math.cos(half), 0.0, 0.0, math.sin(half)]), np.array([x, 0.0, 0.0])
    )


def frame(number: int, base_from_camera: SE3 | None) -> Frame:
    image = np.full((3, 4, 3), number, np.uint8)
    return Frame(f"f{number}", image, CAMERA, base_from_camera)


def scene(name: str, *test: Frame, train: tuple[Frame, ...] = ()) -> Recording:
    return Recording(name, train, test)


def test_pose_in_a_scene_of_the_same_base_frame_is_measured() -> None:
    estimates = {0: estimate("ok", "b", pose(1.25)), 1: estimate("ok", "a", pose(9.0))}
    for base in ("kitchen", None):
        scenes = {
            "a": replace(scene("a", frame(0, pose(1.0))), base=base),
            "b": replace(scene("b", frame(1, pose(9.0))), base=base),
        }
        first, second = evaluate(Fake(estimates), scenes)
        expected = (0.25, 0.0) if base else (math.inf, math.inf)
        assert (first.translation_error_m, second.translation_error_m) == pytest.approx(
            expected
        )
        assert first.wrong_scene == (base is None)


def test_pose_in_another_scene_has_infinite_error() -> None:
    scenes = {
        "a": scene("x", frame(0, pose(1.0)), frame(1, pose(2.0)), frame(2, pose(3.0))),
        "b": scene("y", frame(3, pose(1.0)), frame(4, pose(1.0))),
    }
    estimates = {
        0: estimate("ok", "a", pose(1.03, 2.0)),
        1: estimate("ok", "b", pose(2.0)),
        2: estimate("unknown_scene", None, None),
        3: estimate("failed", "b", pose(1.0)),
        4: estimate("ok", "b", pose(1.0)),
    }
    results = evaluate(Fake(estimates), scenes)
    assert [r.frame for r in results] == ["f0", "f1", "f2", "f3", "f4"]
    assert [r.scene for r in results] == ["a", "a", "a", "b", "b"]
    assert results[0].translation_error_m == pytest.approx(0.03)
    assert results[0].rotation_error_rad == pytest.approx(math.radians(2.0))
    for r in results[1:4]:
        assert r.translation_error_m == r.rotation_error_rad == math.inf
    assert [r.wrong_scene for r in results] == [False, True, False, False, False]
    assert results[4].translation_error_m == 0.0
    assert (results[4].inliers, results[4].inlier_ratio) == (7, 0.25)


def test_images_of_all_scenes_are_shuffled_by_seed() -> None:
    count = 40
    estimates = {i: estimate("failed", None, None) for i in range(2 * count)}
    scenes = {
        "a": scene("a", *(frame(i, pose(0.0)) for i in range(count))),
        "b": scene("b", *(frame(i + count, pose(0.0)) for i in range(count))),
    }
    first = Fake(estimates)
    again = Fake(estimates)
    other = Fake(estimates)
    progress: list[tuple[int, int]] = []
    results = evaluate(
        first, scenes, on_frame=lambda done, total: progress.append((done, total))
    )
    evaluate(again, scenes)
    evaluate(other, scenes, seed=1)
    assert sorted(first.calls) == list(range(2 * count))
    assert first.calls == again.calls != other.calls
    early = sum(number < count for number in first.calls[:count])
    assert 8 < early < 32  # in recorded order it would be 40
    assert [r.frame for r in results] == [f"f{i}" for i in range(2 * count)]
    assert progress == [(i + 1, 2 * count) for i in range(2 * count)]


def test_time_includes_reading_the_image() -> None:
    class Slow(Frame):
        def read_image(self) -> np.ndarray:
            time.sleep(0.02)
            return super().read_image()

    plain = frame(0, pose(0.0))
    slow = Slow(plain.name, plain.image, plain.camera, plain.base_from_camera)
    (r,) = evaluate(Fake({0: estimate("failed", None, None)}), {"a": scene("a", slow)})
    assert r.milliseconds >= 20.0


def test_near_training_frames_are_of_the_same_scene() -> None:
    estimates = {i: estimate("failed", None, None) for i in range(3)}
    scenes = {
        "a": scene(
            "a", frame(0, pose(0.0)), frame(1, pose(0.5)), train=(frame(9, pose(0.52)),)
        ),
        "b": scene(
            "b", frame(2, pose(0.5)), train=(frame(8, pose(9.0)), frame(7, None))
        ),
    }
    results = evaluate(Fake(estimates), scenes)
    assert [r.near_training_frame for r in results] == [False, True, False]


def test_recordings_and_folders_without_a_mapping(tmp_path: Path) -> None:
    recording = scene("a", frame(0, None), frame(1, pose(0.0)))
    generic.write(tmp_path / "a", recording)
    for given in (
        recording,
        [recording],
        tmp_path / "a",
        str(tmp_path / "a"),
        (tmp_path / "a",),
    ):
        results = evaluate(Fake({1: estimate("failed", None, None)}), given)
        assert [r.frame[:2] for r in results] == ["f1"]  # the other one has no pose
    with pytest.raises(InputError, match="given twice"):
        evaluate(Fake({}), [recording, recording])


@pytest.mark.parametrize(
    ("scenes", "message"),
    [
        ({}, r"no scene to evaluate; give one or more of a, b"),
        (
            {"c": scene("c", frame(0, pose(0.0)))},
            r"'c' is not in the store; its scenes are a, b;",
        ),
        ({"a": scene("a")}, r"'a' has 0 test frames"),
        ({"b": scene("b", frame(0, None))}, r"'b' has 1 test frames, none with a pose"),
    ],
)
def test_unusable_scenes_are_refused(
    scenes: dict[str, Recording], message: str
) -> None:
    fake = Fake({})
    with pytest.raises(InputError, match=message):
        evaluate(fake, scenes)
    assert fake.calls == []


def test_squared_error_is_in_units_of_the_covariance() -> None:
    """3 cm with a sigma of 1 cm and 2 deg with a sigma of 1 deg: 9 + 4."""
    covariance = np.diag([0.01**2] * 3 + [math.radians(1) ** 2] * 3)
    off = pose(1.03, 2.0)
    estimates = {
        0: estimate("ok", "a", off, covariance=covariance),
        1: estimate("ok", "a", off),
        2: estimate("ok", "b", off, covariance=covariance),
        3: estimate("failed", "a", off, covariance=covariance),
    }
    scenes = {"a": scene("a", *(frame(i, pose(1.0)) for i in range(4)))}
    first, *others = evaluate(Fake(estimates), scenes)
    assert first.squared_mahalanobis == pytest.approx(13.0)
    assert all(math.isnan(result.squared_mahalanobis) for result in others)
