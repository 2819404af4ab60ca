"""The frame of a map is stored number by number."""

import json

import numpy as np
import pytest

from evercal.geometry import SE3
from evercal.mapping.map_frame import (
    FrameCorrection,
    MapFrame,
    Similarity,
    correction_of,
    correction_tensors,
    frame_of,
    frame_to_dict,
)

POSE = SE3.exp([1.0, -2.0, 0.5, 0.3, -0.9, 0.4])


def assert_equal(one: SE3, other: SE3) -> None:
    np.testing.assert_array_equal(one.rotation_wxyz, other.rotation_wxyz)
    np.testing.assert_array_equal(one.translation_m, other.translation_m)


@pytest.mark.parametrize("metric", [True, False])
def test_a_frame_keeps_every_number(metric: bool) -> None:
    rng = np.random.default_rng(0)
    poses = SE3.exp(rng.normal(size=(5, 6)))
    correction = FrameCorrection(poses, rng.normal(size=(5, 6)), (0.2, 0.26))
    frame = MapFrame(
        common=POSE.inverse(),
        correction=correction,
        pose_sigma=(0.001, 0.002),
        frame_sigma=(0.003, 0.004),
        similarity=Similarity(POSE, 0.37, metric),
        base_covariance=np.diag(np.arange(6.0)),
    )
    content = json.loads(json.dumps(frame_to_dict(frame)))
    read = frame_of(content, correction_of(correction_tensors(correction)))
    assert read.similarity is not None
    assert read.correction is not None
    assert read.base_covariance is not None
    assert (read.scale, read.similarity.metric) == (0.37, metric)
    assert read.pose_sigma == (0.001, 0.002)
    assert read.frame_sigma == (0.003, 0.004)
    assert read.correction.radius == (0.2, 0.26)
    assert_equal(read.common, frame.common)
    assert_equal(read.similarity.base_from_map, POSE)
    assert_equal(read.correction.poses, poses)
    np.testing.assert_array_equal(read.base_covariance, frame.base_covariance)
    np.testing.assert_array_equal(read.correction.correction, correction.correction)
    # Versions that knew metres only did not state the unit.
    del content["unit_known"]
    earlier = frame_of(content, None)
    assert earlier.correction is None
    assert earlier.similarity is not None
    assert earlier.similarity.metric


def test_a_plain_frame_is_that_of_the_base() -> None:
    content = json.loads(json.dumps(frame_to_dict(MapFrame())))
    assert content["unit_known"] is True
    read = frame_of(content, None)
    assert (read.similarity, read.correction, read.base_covariance) == (None,) * 3
    assert (read.pose_sigma, read.frame_sigma) == ((0, 0), (0, 0))
    assert_equal(read.common, SE3.identity())
