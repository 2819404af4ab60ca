"""Poses that a scene states go back to where its landmarks were seen from."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evercal.continual.networks.atlas import Cell
from evercal.geometry import SE3, Camera, pose_distance
from evercal.mapping.frame_correction import FrameCorrection
from evercal.mapping.scene_maps import Alignment, SceneRecord

LENS = Camera(320, 240, 300, 300, 159.5, 119.5)
ALIGNMENT = Alignment(SE3.exp([1.0, -2.0, 0.5, 0.3, -0.9, 0.4]), 0.37)


def record(**more: Any) -> SceneRecord:
    prototypes: Any = None
    cell = Cell((0.0, 0.0, 0.0), 1.0, (0.0, 0.0, 0.0))
    found = SceneRecord("room", LENS, cell, prototypes, 10)
    return replace(found, common=SE3.exp([0.01, 0.02, -0.01, 0.02, 0, 0.01]), **more)


def bend(seed: int) -> FrameCorrection:
    rng = np.random.default_rng(seed)
    places = SE3.exp(rng.normal(0, [0.3] * 3 + [0.2] * 3, (12, 6)))
    return FrameCorrection(places, rng.normal(0, [0.004] * 3 + [0.004] * 3, (12, 6)), (0.2, 0.26))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), bent=st.booleans(), aligned=st.booleans())
def test_landmarks_are_seen_where_they_were_found(seed: int, bent: bool, aligned: bool) -> None:
    scene = record(bend=bend(seed) if bent else None, alignment=ALIGNMENT if aligned else None)
    rng = np.random.default_rng(seed + 1)
    pose = SE3.exp(rng.normal(0, 0.3, 6))
    points = pose.apply(rng.uniform([-1, -1, 1], [1, 1, 4], (8, 3)))
    stated, _ = scene.stated(pose, None)
    among = scene.camera_among_landmarks(stated)
    seen = LENS.project(pose.inverse().apply(points))
    shown = scene.stated_points(points)
    assert shown is not None
    assert LENS.project(among.inverse().apply(shown)) == pytest.approx(seen, abs=0.01)


def test_an_alignment_is_undone() -> None:
    pose = SE3.exp([0.2, 0.1, -0.4, 1.0, 0.2, -0.3])
    assert max(pose_distance(ALIGNMENT.map_pose(ALIGNMENT.pose(pose)), pose)) < 1e-12


BENT = (-0.2, 0.05, 0.001, 0.0)


@pytest.mark.parametrize(
    ("own", "given", "refined"),
    [
        ((), None, True),
        ((), (), True),
        ((), (0.0,) * 5, True),  # as a ROS camera without distortion states it
        (BENT, None, True),
        (BENT, BENT, True),
        (BENT, (*BENT, 0.0), True),
        (BENT, (), False),  # a rectified image
        (BENT, (*BENT, 0.1), False),
        ((), BENT, False),
    ],
)
def test_the_refined_lens_stands_for_the_one_that_was_stated(
    own: tuple[float, ...], given: tuple[float, ...] | None, refined: bool
) -> None:
    better = replace(LENS, fx=303.0, fy=303.0, distortion=(-0.1, 0.0, 0.0, 0.0))
    scene = record(camera=replace(LENS, distortion=own), refined_camera=better)
    query = None if given is None else replace(LENS.resized(640, 480), distortion=given)
    assert scene.query_camera(query) == (better if refined else query)
    other = replace(LENS, fx=320.0, distortion=own)
    assert scene.query_camera(other) == other
