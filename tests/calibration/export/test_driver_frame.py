"""The driver's root frame: axes of REP 103, files of transforms, propagated covariance."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose

from evercal.calibration.export.request import (
    ExportOptions,
    prepare_export,
    read_link_from_optical,
    standard_link_from_optical,
)
from evercal.errors import InputError
from evercal.geometry import SE3, cross_matrix, pose_distance

from .random_poses import POSE, calibration_of


def test_axes_follow_rep_103() -> None:
    """Forward, left, up of the link are z, -x, -y of the optical frame."""
    link_from_optical = standard_link_from_optical((0.01, 0.02, 0.03))
    axes = link_from_optical.apply([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    offset = np.array([0.01, 0.02, 0.03])
    assert_allclose(axes - offset, [[1, 0, 0], [0, -1, 0], [0, 0, -1]], atol=1e-12)


def test_the_covariance_is_propagated_to_the_link() -> None:
    """A lever arm adds the uncertainty of the rotation to that of the translation."""
    offset = (0.1, 0.2, -0.3)
    options = ExportOptions(via="camera_link", via_offset=offset)
    calibration = calibration_of(POSE)
    moved = prepare_export(calibration, **options).calibration
    assert (moved.parent_frame, moved.child_frame) == ("base_link", "camera_link")
    optical_from_link = standard_link_from_optical(offset).inverse()
    assert (
        np.max(pose_distance(moved.parent_from_child, POSE @ optical_from_link)) < 1e-9
    )
    covariance = calibration.covariance
    lever = POSE.rotation_matrix() @ cross_matrix(optical_from_link.translation_m)
    expected = covariance[:3, :3] + lever @ covariance[3:, 3:] @ lever.T
    assert_allclose(moved.covariance[:3, :3], expected, rtol=1e-9)
    turned = optical_from_link.rotation_matrix().T
    expected = turned @ covariance[3:, 3:] @ turned.T
    assert_allclose(moved.covariance[3:, 3:], expected, rtol=1e-9, atol=1e-20)


def entry(parent: str, child: str, pose: SE3) -> dict:
    (w, x, y, z), t = pose.rotation_wxyz.tolist(), pose.translation_m.tolist()
    return {
        "header": {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": parent},
        "child_frame_id": child,
        "transform": {
            "translation": dict(zip("xyz", t, strict=True)),
            "rotation": {"x": x, "y": y, "z": z, "w": w},
        },
    }


LINK_FROM_COLOR = SE3.exp([0.0, 0.015, 1e-5, 0.004, 0.001, -0.002])
COLOR_FROM_OPTICAL = standard_link_from_optical()


@pytest.mark.parametrize("kind", ["echo", "list", "reversed", "slash"])
def test_transforms_are_chained(tmp_path: Path, kind: str) -> None:
    tf = [
        entry("camera_link", "camera_depth_frame", SE3.exp([1, 2, 3, 0, 0, 0])),
        entry("camera_link", "camera_color_frame", LINK_FROM_COLOR),
        entry("camera_color_frame", "camera_color_optical_frame", COLOR_FROM_OPTICAL),
    ]
    if kind == "reversed":
        tf[1] = entry("camera_color_frame", "camera_link", LINK_FROM_COLOR.inverse())
    if kind == "slash":
        tf[2]["header"]["frame_id"] = "/camera_color_frame"
    data = yaml.safe_dump(tf if kind == "list" else {"transforms": tf})
    (tmp_path / "tf.yaml").write_text(data + ("---\n" if kind == "echo" else ""))
    link_from_optical = read_link_from_optical(
        tmp_path / "tf.yaml", "camera_link", "camera_color_optical_frame"
    )
    expected = LINK_FROM_COLOR @ COLOR_FROM_OPTICAL
    assert np.max(pose_distance(link_from_optical, expected)) < 1e-9


def test_exported_and_written_transforms_are_read(tmp_path: Path) -> None:
    file = tmp_path / "t.yaml"
    calibration = calibration_of(LINK_FROM_COLOR)
    for write in (
        calibration.write,
        lambda path: calibration.export("transform_stamped", path),
    ):
        write(file)
        link_from_optical = read_link_from_optical(
            file, "base_link", "cam/optical-frame"
        )
        assert np.max(pose_distance(link_from_optical, LINK_FROM_COLOR)) < 1e-9


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            yaml.safe_dump(entry("camera_link", "other", SE3.identity())),
            "leads from 'camera_link'",
        ),
        ("a: [", "not valid YAML"),
        ("hello", "contains no transform"),
        ("", "contains no transform"),
        ("transform: {translation: {x: 1, y: 2, z: 3}}", "no complete transform"),
        (
            yaml.safe_dump(entry("camera_link", "optical", SE3.identity())).replace(
                "w: 1.0", "w: 2.0"
            ),
            "not of length 1",
        ),
    ],
)
def test_broken_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "t.yaml").write_text(text)
    with pytest.raises(InputError, match=message):
        read_link_from_optical(tmp_path / "t.yaml", "camera_link", "optical")


def test_missing_file_and_equal_frame_names_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is missing"):
        read_link_from_optical(tmp_path / "no.yaml", "camera_link", "optical")
    calibration = calibration_of(SE3.identity())
    with pytest.raises(InputError, match="both called 'base_link'"):
        calibration.export("urdf", via="base_link", via_optical=True)
    with pytest.raises(InputError, match="both called 'base_link'"):
        calibration.export("urdf", child="base_link")
