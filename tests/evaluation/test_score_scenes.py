"""`evaluate` accepts recordings, folders and mappings."""

from pathlib import Path

import pytest

from evercal.errors import InputError
from evercal.evaluation.score_scenes import evaluate
from evercal.geometry import SE3
from evercal.localization.estimate import PoseEstimate
from evercal.recordings import generic

from ..box_world import box_room_scene


class Shifted:
    """A localizer of one scene under two names, with errors of 3 mm."""

    scenes = ("box-room-7", "other")

    def __init__(self, name: str = "box-room-7"):
        self.scene, self.name = box_room_scene(7, 2, 3), name

    def localize(self, image: object, camera: object = None) -> PoseEstimate:
        frame = next(f for f in self.scene.test if (f.read_image() == image).all())
        assert frame.base_from_camera is not None
        pose = frame.base_from_camera @ SE3.exp([0.003, 0, 0, 0, 0, 0])
        return PoseEstimate("ok", "", self.name, pose, None, 9, 0.5, 1.0)


def test_recordings_folders_and_mappings(tmp_path: Path) -> None:
    localizer = Shifted()
    generic.write(tmp_path / "room", localizer.scene)
    folder = tmp_path / "room"
    for scenes in (localizer.scene, [localizer.scene], folder, str(folder), (folder,)):
        row = evaluate(localizer, scenes).scenes["box-room-7"]
        assert (row.frames, row.accuracy_5mm_05deg) == (3, 100.0)
        assert row.median_translation_cm == pytest.approx(0.3)
    named = evaluate(Shifted("other"), {"other": folder})
    assert list(named.scenes) == ["other"]
    assert named.mean_accuracy_1cm_1deg == 100.0


def test_repeated_name_is_refused() -> None:
    localizer = Shifted()
    with pytest.raises(InputError, match="given twice"):
        evaluate(localizer, [localizer.scene, localizer.scene])
    with pytest.raises(InputError, match="no scene"):
        evaluate(localizer, [])
