"""Selection of the images of a calibration, and the axes and landmarks drawn into them."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from evercal.calibration.calibration import Calibration, ImageUse
from evercal.continual.networks.atlas import Cell
from evercal.geometry import SE3, Camera
from evercal.localization.estimate import PoseEstimate
from evercal.mapping.scene_maps import SceneRecord
from evercal.recordings.images import write_image
from evercal.reports.calibration_images import annotate_images, select_images


def pose(quaternion: ArrayLike, translation: ArrayLike) -> SE3:
    return SE3(np.array(quaternion, np.float64), np.array(translation, np.float64))


CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
BASE_FROM_CAMERA = pose([0.0, 1.0, 0.0, 0.0], [0.1, 0.05, 1.0])


def calibration(names: dict[str, bool], **more: Any) -> Calibration:
    uses = tuple(ImageUse(name, used, "" if used else "blurred") for name, used in names.items())
    found = Calibration("eye_to_hand", BASE_FROM_CAMERA, 1e-6 * np.eye(6), camera=CAMERA, images=uses)
    return replace(found, **more)


def write_images(folder: Path, *names: str, size: tuple[int, int] = (120, 160)) -> list[Path]:
    for name in names:
        write_image(folder / name, np.full((*size, 3), 90, np.uint8))
    return [folder / name for name in names]


class FixedLocalizer:
    """Finds two landmarks in every image: one where a pose puts it, one three pixels beside."""

    scenes = ("room",)

    def __init__(self, pose: SE3 | None) -> None:
        prototypes: Any = None
        cell = Cell((0.0, 0.0, 0.0), 1.0, (0.0, 0.0, 0.0))
        record = SceneRecord("room", CAMERA, cell, prototypes, 10)
        self.maps = SimpleNamespace(scenes=[record], short_side=60, keyframes=[None])
        self.pose = pose

    def localize(self, image: np.ndarray, camera: Camera) -> PoseEstimate:
        if self.pose is None:
            return PoseEstimate("failed", "too dark", None, None, None, 0, 0.0, 1.0)
        points = BASE_FROM_CAMERA.apply([[0.1, 0.1, 1.0], [-0.2, 0.1, 1.0]])
        pixels = camera.resized(80, 60).project([[0.1, 0.1, 1.0], [-0.2, 0.1, 1.0]])
        pixels[1, 0] += 3
        return PoseEstimate("ok", "", "room", self.pose, None, 2, 1.0, 1.0, pixels, points)


def test_images_are_spread_and_one_that_was_left_out_is_among_them(tmp_path: Path) -> None:
    names = {f"{i}.png": i not in (4, 7) for i in range(10)}
    write_images(tmp_path, *names)
    files, none = select_images(calibration(names), tmp_path)
    assert none == ""
    assert [file.path.name for file in files] == ["0.png", "5.png", "9.png", "4.png"]
    assert [file.use is not None and file.use.used for file in files] == [True, True, True, False]


def test_given_images_take_their_place(tmp_path: Path) -> None:
    own = write_images(tmp_path, "a.png")
    others = write_images(tmp_path, *(f"{i}.png" for i in range(6)))
    files, _ = select_images(calibration({str(own[0]): True}), tmp_path, [*others[:3], *own])
    assert [file.path for file in files] == [*others[:3], *own]
    assert [file.use is None for file in files] == [True, True, True, False]
    assert len(select_images(calibration({}), tmp_path, others)[0]) == 4


def test_no_image_is_said(tmp_path: Path) -> None:
    assert "names no images" in select_images(calibration({}), tmp_path)[1]
    gone = select_images(calibration({"gone.png": True, "b.png": True}), tmp_path)
    assert gone[0] == []
    assert "none of the 2 images" in gone[1]
    assert "gone.png" in gone[1]
    blind = annotate_images(calibration({}, camera=None), [])
    assert not blind.images
    assert "no intrinsics" in blind.missing[0]


def test_unusable_images_are_said_and_the_others_drawn(tmp_path: Path) -> None:
    names = {"a.png": True, "wide.png": True, "broken.png": True}
    write_images(tmp_path, "a.png")
    write_images(tmp_path, "wide.png", size=(90, 160))
    (tmp_path / "broken.png").write_bytes(b"no image")
    found = calibration(names)
    views = annotate_images(found, select_images(found, tmp_path)[0])
    assert [Path(view.name).name for view in views.images] == ["a.png"]
    assert views.images[0].use == "used"
    assert views.images[0].landmarks is None
    told = " ".join(views.missing)
    assert "wide.png is 160x90, which does not fit the camera, 160x120" in told
    assert "broken.png: not a readable image" in told


def test_the_base_is_drawn_where_the_calibration_sees_it(tmp_path: Path) -> None:
    write_images(tmp_path, "a.png")
    found = calibration({"a.png": True})
    views = annotate_images(found, select_images(found, tmp_path)[0])
    assert views.axes is not None
    # K [R | t] by hand: the camera looks straight down from a metre above.
    assert views.axes.origin_px == pytest.approx((79.5 - 15, 59.5 + 7.5))
    image = views.images[0].image.astype(int)
    scale = image.shape[1] / 160
    x, y = np.round((views.axes.origin_px + 0.5) * scale - 0.5).astype(int)
    coloured = np.argwhere(np.ptp(image, axis=2) > 60)
    assert np.abs(coloured - [y, x]).max(axis=1).min() <= 3
    # 10 cm are 15 pixels of the camera: x to the right, y up.
    assert coloured[:, 1].max() == pytest.approx(x + 15 * scale, abs=40)
    assert coloured[:, 0].min() == pytest.approx(y - 15 * scale, abs=40)


def test_an_older_calibration_is_drawn_beside(tmp_path: Path) -> None:
    write_images(tmp_path, "a.png")
    found = calibration({"a.png": True})
    older = replace(found, parent_from_child=pose([0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0]))
    files, _ = select_images(found, tmp_path)
    alone, both = annotate_images(found, files), annotate_images(found, files, older)
    assert both.older_axes is not None
    assert both.older_axes.origin_px == pytest.approx((79.5, 59.5))
    differ = np.argwhere((alone.images[0].image != both.images[0].image).any(axis=2))
    scale = both.images[0].image.shape[1] / 160
    assert np.abs(differ - [60 * scale, 80 * scale]).max(axis=1).min() < 12


def test_residuals_are_those_of_the_calibration(tmp_path: Path) -> None:
    write_images(tmp_path, "a.png")
    found = calibration({"a.png": True})
    files, _ = select_images(found, tmp_path)
    off: Any = FixedLocalizer(BASE_FROM_CAMERA @ SE3.exp([0.05, 0, 0, 0, 0, 0]))
    [view] = annotate_images(found, files, None, off).views
    assert view.landmarks == 2
    # 0 and 3 pixels of an image half as large.
    assert view.median_px == pytest.approx(0.5 * (0 + 6), abs=1e-6)
    gripper = replace(found, mount="eye_in_hand", parent_frame="gripper")
    [view] = annotate_images(gripper, files, None, off).views
    # Judged by the image's own pose, 50 mm aside: 3.75 pixels of the small image.
    assert view.median_px == pytest.approx(2 * (3.75 + 6.75) / 2, abs=1e-6)


def test_images_without_landmarks_say_why(tmp_path: Path) -> None:
    write_images(tmp_path, "a.png")
    found = calibration({"a.png": True}, source={"scene": "room", "map": "another"})
    blind: Any = FixedLocalizer(None)
    views = annotate_images(found, select_images(found, tmp_path)[0], None, blind)
    assert (views.images[0].landmarks, views.images[0].status) == (0, "too dark")
    assert views.other_map
    assert not annotate_images(calibration({"a.png": True}), [], None, blind).other_map
    lost: Any = FixedLocalizer(BASE_FROM_CAMERA)
    elsewhere = replace(found, source={"scene": "attic"})
    [view] = annotate_images(elsewhere, select_images(found, tmp_path)[0], None, lost).views
    assert (view.landmarks, view.status) == (0, "it shows room, not attic")
