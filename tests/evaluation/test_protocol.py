"""The protocol with a fake localizer that uses pixels only."""

import math
import time
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.evaluation import evaluate
from evercal.geometry import SE3, Camera
from evercal.localization.estimate import PoseEstimate
from evercal.recordings import Frame, Recording, generic

CAMERA = Camera(4, 3, 4.0, 4.0, 1.5, 1.0)


def estimate(
    status,
    scene,
    x=0.0,
    degrees=0.0,
    covariance=None,
):
    return PoseEstimate(status, "", scene, pose(x, degrees), covariance, 7, 0.25, 1.0)


@dataclass
class Fake:
    """Returns estimates by the first pixel of the image, failures by default, in any order."""

    estimates: dict[int, PoseEstimate] = field(default_factory=dict)
    scenes: tuple[str, ...] = ("a", "b")
    calls: list[int] = field(default_factory=list)

    def localize(self, image: np.ndarray, camera: Camera | None = None) -> PoseEstimate:
        assert image.shape == (3, 4, 3)
        assert camera == CAMERA
        self.calls.append(int(image[0, 0, 0]))
        return self.estimates.get(self.calls[-1], estimate("failed", None))


def pose(x, degrees=0.0):
    return SE3.from_translation((x, 0, 0)) @ SE3.exp([0] * 5 + [math.radians(degrees)])


def frame(number, x: float | None = 0.0):
    image = np.full((3, 4, 3), number, np.uint8)
    return Frame(f"f{number}", image, CAMERA, None if x is None else pose(x))


def scene(name, *test: Frame, **fields: Any):
    return replace(Recording(name, (), test), **fields)


@pytest.mark.parametrize(
    ("base", "expected"), [("kitchen", (0.25, 0.0)), (None, (math.inf, math.inf))]
)
def test_pose_in_a_scene_of_the_same_base_frame_is_measured(base, expected):
    fake = Fake({0: estimate("ok", "b", 1.25), 1: estimate("ok", "a", 9.0)})
    scenes = [
        scene("a", frame(0, 1.0), base=base),
        scene("b", frame(1, 9.0), base=base),
    ]
    first, second = evaluate(fake, scenes)
    errors = (first.translation_error_m, second.translation_error_m)
    assert errors == pytest.approx(expected)
    assert first.wrong_scene == (base is None)


def test_pose_in_another_scene_has_infinite_error():
    estimates = {
        0: estimate("ok", "a", 1.03, 2.0),
        1: estimate("ok", "b", 2.0),
        3: estimate("failed", "b", 1.0),
        4: estimate("ok", "b", 1.0),
    }
    scenes = {
        "a": scene("x", frame(0, 1.0), frame(1, 2.0), frame(2, 3.0)),
        "b": scene("y", frame(3, 1.0), frame(4, 1.0)),
    }
    results = evaluate(Fake(estimates), scenes)
    names = [(r.scene, r.frame) for r in results]
    assert names == [("a", "f0"), ("a", "f1"), ("a", "f2"), ("b", "f3"), ("b", "f4")]
    errors = [(r.translation_error_m, r.rotation_error_rad) for r in results]
    assert errors[0] == pytest.approx((0.03, math.radians(2.0)))
    assert errors[1:] == [(math.inf, math.inf)] * 3 + [(0.0, 0.0)]
    assert [r.wrong_scene for r in results] == [False, True, False, False, False]
    assert (results[4].inliers, results[4].inlier_ratio) == (7, 0.25)


def test_images_of_all_scenes_are_shuffled_by_seed():
    frames = [frame(i) for i in range(80)]
    scenes = [scene("a", *frames[:40]), scene("b", *frames[40:])]
    first = Fake()
    again = Fake()
    other = Fake()
    progress = []
    results = evaluate(first, scenes, on_frame=lambda *done: progress.append(done))
    evaluate(again, scenes)
    evaluate(other, scenes, seed=1)
    assert sorted(first.calls) == list(range(80))
    assert first.calls == again.calls != other.calls
    early = sum(number < 40 for number in first.calls[:40])
    assert 8 < early < 32  # in recorded order it would be 40
    assert [r.frame for r in results] == [f"f{i}" for i in range(80)]
    assert progress == [(i + 1, 80) for i in range(80)]


def test_time_includes_reading_the_image():
    class Slow(Frame):
        def read_image(self) -> np.ndarray:
            time.sleep(0.02)
            return super().read_image()

    (r,) = evaluate(Fake(), [scene("a", Slow(**vars(frame(0))))])
    assert r.milliseconds >= 20.0


def test_near_training_frames_are_of_the_same_scene():
    scenes = [
        scene("a", frame(0), frame(1, 0.5), train=(frame(9, 0.52),)),
        scene("b", frame(2, 0.5), train=(frame(8, 9.0), frame(7, None))),
    ]
    near = [r.near_training_frame for r in evaluate(Fake(), scenes)]
    assert near == [False, True, False]


def test_recordings_and_folders_without_a_mapping(tmp_path):
    recording = scene("a", frame(0, None), frame(1))
    folder = tmp_path / "a"
    generic.write(folder, recording)
    for given in (recording, [recording], folder, str(folder), (folder,)):
        (r,) = evaluate(Fake(), given)
        assert r.frame[:2] == "f1"  # the other one has no pose
    with pytest.raises(InputError, match="given twice"):
        evaluate(Fake(), [recording, recording])


@pytest.mark.parametrize(
    ("scenes", "message"),
    [
        ([], r"no scene to evaluate; give one or more of a, b"),
        ([scene("c", frame(0))], r"'c' is not in the store; its scenes are a, b;"),
        ([scene("a")], r"'a' has 0 test frames"),
        ([scene("b", frame(0, None))], r"'b' has 1 test frames, none with a pose"),
    ],
)
def test_unusable_scenes_are_refused(scenes, message):
    fake = Fake()
    with pytest.raises(InputError, match=message):
        evaluate(fake, scenes)
    assert fake.calls == []


def test_squared_error_is_in_units_of_the_covariance():
    """3 cm with a sigma of 1 cm and 2 deg with a sigma of 1 deg: 9 + 4."""
    covariance = np.diag([0.01**2] * 3 + [math.radians(1) ** 2] * 3)
    estimates = {
        0: estimate("ok", "a", 1.03, 2.0, covariance=covariance),
        1: estimate("ok", "a", 1.03, 2.0),
        2: estimate("ok", "b", 1.03, 2.0, covariance=covariance),
        3: estimate("failed", "a", 1.03, 2.0, covariance=covariance),
    }
    frames = [frame(i, 1.0) for i in range(4)]
    first, *others = evaluate(Fake(estimates), [scene("a", *frames)])
    assert first.squared_mahalanobis == pytest.approx(13.0)
    assert np.isnan([r.squared_mahalanobis for r in others]).all()
