"""The examination with a fake localizer that answers from the pixels alone."""

import math
import time
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.evaluation import evaluate
from evercal.evaluation.metrics import Status
from evercal.geometry import SE3, Camera
from evercal.recordings import Frame, Recording

CAMERA = Camera(4, 3, 4.0, 4.0, 1.5, 1.0)


@dataclass(frozen=True)
class Answer:
    status: Status
    scene: str | None
    base_from_camera: SE3 | None
    inliers: int = 7
    inlier_ratio: float = 0.25
    covariance: np.ndarray | None = None


@dataclass
class Fake:
    """Knows each image by its first pixel, and keeps the order in which it was asked."""

    answers: dict[int, Answer]
    scenes: tuple[str, ...] = ("a", "b")
    asked: list[int] = field(default_factory=list)

    def localize(self, image: np.ndarray, camera: Camera) -> Answer:
        assert image.shape == (3, 4, 3)
        assert camera == CAMERA
        self.asked.append(int(image[0, 0, 0]))
        return self.answers[self.asked[-1]]


def pose(x: float, degrees: float = 0.0) -> SE3:
    turn = math.radians(degrees) / 2
    return SE3(np.array([math.cos(turn), 0.0, 0.0, math.sin(turn)]), np.array([x, 0.0, 0.0]))


def frame(number: int, base_from_camera: SE3 | None) -> Frame:
    image = np.full((3, 4, 3), number, np.uint8)
    return Frame(f"f{number}", image, CAMERA, base_from_camera)


def scene(name: str, *test: Frame, train: tuple[Frame, ...] = ()) -> Recording:
    return Recording(name, train, test)


def test_a_pose_in_a_scene_of_the_same_base_frame_is_measured_too() -> None:
    answers = {0: Answer("ok", "b", pose(1.25)), 1: Answer("ok", "a", pose(9.0))}
    for base in ("kitchen", None):
        scenes = {
            "a": replace(scene("a", frame(0, pose(1.0))), base=base),
            "b": replace(scene("b", frame(1, pose(9.0))), base=base),
        }
        first, second = evaluate(Fake(answers), scenes)
        expected = (0.25, 0.0) if base else (math.inf, math.inf)
        assert (first.translation_error_m, second.translation_error_m) == pytest.approx(expected)
        assert first.wrong_scene == (base is None)  # another region of one place is no wrong place


def test_only_a_pose_in_the_right_scene_is_measured() -> None:
    scenes = {
        "a": scene("x", frame(0, pose(1.0)), frame(1, pose(2.0)), frame(2, pose(3.0))),
        "b": scene("y", frame(3, pose(1.0)), frame(4, pose(1.0))),
    }
    answers = {
        0: Answer("ok", "a", pose(1.03, 2.0)),
        1: Answer("ok", "b", pose(2.0)),  # the right numbers in the wrong scene
        2: Answer("unknown_scene", None, None),
        3: Answer("failed", "b", pose(1.0)),  # a pose that the localizer itself does not trust
        4: Answer("ok", "b", pose(1.0)),
    }
    results = evaluate(Fake(answers), scenes)
    assert [r.frame for r in results] == ["f0", "f1", "f2", "f3", "f4"]
    assert [r.scene for r in results] == ["a", "a", "a", "b", "b"]
    assert results[0].translation_error_m == pytest.approx(0.03)
    assert results[0].rotation_error_rad == pytest.approx(math.radians(2.0))
    for r in results[1:4]:
        assert r.translation_error_m == r.rotation_error_rad == math.inf
    assert [r.wrong_scene for r in results] == [False, True, False, False, False]
    assert [r.status for r in results] == ["ok", "ok", "unknown_scene", "failed", "ok"]
    assert results[4].translation_error_m == 0.0
    assert (results[4].inliers, results[4].inlier_ratio) == (7, 0.25)


def test_images_of_all_scenes_come_mixed_and_the_seed_decides_how() -> None:
    count = 40
    answers = {i: Answer("failed", None, None) for i in range(2 * count)}
    scenes = {
        "a": scene("a", *(frame(i, pose(0.0)) for i in range(count))),
        "b": scene("b", *(frame(i + count, pose(0.0)) for i in range(count))),
    }
    first, again, other = Fake(answers), Fake(answers), Fake(answers)
    told: list[tuple[int, int]] = []
    results = evaluate(first, scenes, on_frame=lambda done, total: told.append((done, total)))
    evaluate(again, scenes)
    evaluate(other, scenes, seed=1)
    assert sorted(first.asked) == list(range(2 * count))
    assert first.asked == again.asked != other.asked
    early = sum(number < count for number in first.asked[:count])
    assert 8 < early < 32  # in recorded order it would be 40
    assert [r.frame for r in results] == [f"f{i}" for i in range(2 * count)]
    assert told == [(i + 1, 2 * count) for i in range(2 * count)]


def test_the_localizer_gets_an_image_and_a_camera_and_nothing_else() -> None:
    class Strict(Fake):
        def localize(self, *given: object, **named: object) -> Answer:
            assert [type(value) for value in given] == [np.ndarray, Camera]
            assert not named
            return Answer("failed", None, None)

    assert len(evaluate(Strict({}), {"a": scene("a", frame(0, pose(0.0)))})) == 1


def test_time_includes_reading_the_image() -> None:
    class Slow(Frame):
        def read_image(self) -> np.ndarray:
            time.sleep(0.02)
            return super().read_image()

    plain = frame(0, pose(0.0))
    slow = Slow(plain.name, plain.image, plain.camera, plain.base_from_camera)
    (r,) = evaluate(Fake({0: Answer("failed", None, None)}), {"a": scene("a", slow)})
    assert r.milliseconds >= 20.0


def test_near_training_frames_are_those_of_the_same_scene() -> None:
    answers = {i: Answer("failed", None, None) for i in range(3)}
    scenes = {
        "a": scene("a", frame(0, pose(0.0)), frame(1, pose(0.5)), train=(frame(9, pose(0.52)),)),
        "b": scene("b", frame(2, pose(0.5)), train=(frame(8, pose(9.0)), frame(7, None))),
    }
    results = evaluate(Fake(answers), scenes)
    assert [r.near_training_frame for r in results] == [False, True, False]


def test_frames_without_a_known_pose_are_left_out() -> None:
    answers = {1: Answer("failed", None, None)}
    results = evaluate(Fake(answers), {"a": scene("a", frame(0, None), frame(1, pose(0.0)))})
    assert [r.frame for r in results] == ["f1"]


@pytest.mark.parametrize(
    ("scenes", "message"),
    [
        ({}, r"no scene to evaluate; give one or more of a, b"),
        ({"c": scene("c", frame(0, pose(0.0)))}, r"'c' is not in the store, which knows a, b;"),
        ({"a": scene("a")}, r"'a' has 0 test frames"),
        ({"b": scene("b", frame(0, None))}, r"'b' has 1 test frames, none with a known pose"),
    ],
)
def test_misuse_is_named_before_any_work(scenes: dict[str, Recording], message: str) -> None:
    fake = Fake({})
    with pytest.raises(InputError, match=message):
        evaluate(fake, scenes)
    assert fake.asked == []


def test_an_error_is_told_in_units_of_its_covariance() -> None:
    """3 cm where 1 cm is stated and 2 deg where 1 deg is: 9 + 4. Only for a pose that counts."""
    covariance = np.diag([0.01**2] * 3 + [math.radians(1) ** 2] * 3)
    there = pose(1.03, 2.0)
    answers = {
        0: Answer("ok", "a", there, covariance=covariance),
        1: Answer("ok", "a", there),
        2: Answer("ok", "b", there, covariance=covariance),
        3: Answer("failed", "a", there, covariance=covariance),
    }
    scenes = {"a": scene("a", *(frame(i, pose(1.0)) for i in range(4)))}
    first, *others = evaluate(Fake(answers), scenes)
    assert first.squared_mahalanobis == pytest.approx(13.0)
    assert all(math.isnan(result.squared_mahalanobis) for result in others)
