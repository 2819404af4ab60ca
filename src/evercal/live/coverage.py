"""What a wrist recording covers so far, and which samples are bad.

Hand-eye calibration needs rotations about two axes (Tsai and Lenz, IEEE T-RA 1989); images are
blurred, over- or underexposed, or show what another one shows.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from evercal.geometry import SE3, pose_distance
from evercal.recordings.frame import MIN_GRIPPER_FRAMES, Frame
from evercal.recordings.pictures import sharpness
from evercal.typing import Array, Image

IMAGES = 25
"""Images of a complete recording."""
ROTATION_DEG, POSITION_MM = 8.0, 25.0
"""Standard deviations about or along an axis that counts as covered."""
SHARPNESS = 0.8
"""Sharpness, relative to the median, below which an image is blurred."""
CLIPPED = 0.15
"""Share of black or white pixels above which an image is badly exposed."""
SAME_MM, SAME_DEG = 8.0, 2.0
"""Two samples closer than both are duplicates."""


@dataclass(frozen=True, eq=False)
class Sample:
    """What coverage needs of one frame; measure it once."""

    name: str
    base_from_gripper: SE3
    sharpness: float
    """Contrast of fine structure relative to that of coarser structure."""
    clipped: float
    """Share of pixels that are black or white."""

    @classmethod
    def of(cls, frame: Frame) -> Self:
        """Measure a frame with a gripper pose."""
        assert frame.base_from_gripper is not None, "coverage is of gripper poses"
        image = frame.read_image()
        return cls(
            frame.name, frame.base_from_gripper, sharpness(image), clipped_share(image)
        )


@dataclass(frozen=True)
class SampleReport:
    """One row of a table of samples."""

    name: str
    sharpness: float
    """Relative to the median of the recording."""
    clipped: float
    """Share of black or white pixels."""
    problems: tuple[str, ...]
    """Reasons to remove it; empty for a good sample."""


@dataclass(frozen=True)
class AxisCoverage:
    """One axis of rotation or translation."""

    name: str
    spread: float
    """Standard deviation, degrees or millimetres."""
    covered: bool


@dataclass(frozen=True)
class Coverage:
    """What a recording covers."""

    samples: tuple[SampleReport, ...]
    rotations: tuple[AxisCoverage, ...]
    """About x, y and z of the camera, or of the gripper if the camera's place is unknown."""
    positions: tuple[AxisCoverage, ...]
    """Of the camera or the gripper, along x, y and z of the base."""
    rotation_rank: int
    """Number of axes about which the rotations spread; calibration needs two."""
    missing: tuple[str, ...]
    """What to record, most urgent first."""
    ready: bool
    """Whether it can be learned: enough images and rotations about two axes."""
    verdict: str
    """One or two sentences."""


def coverage(
    samples: Sequence[Sample], gripper_from_camera: SE3 | None = None
) -> Coverage:
    """Report what samples cover, in recorded order; those with problems count as not recorded.

    With a rough `gripper_from_camera`, axes are those of the camera.
    """
    rows = _sample_reports(samples)
    good = [s for s, row in zip(samples, rows, strict=True) if not row.problems]
    poses = SE3.stack([sample.base_from_gripper for sample in good])
    mover = "gripper"
    if gripper_from_camera is not None:
        poses = poses @ gripper_from_camera
        mover = "camera"
    turned, principal = _rotations_deg(poses)
    moved = 1000 * poses.translation_m.std(0) if good else np.zeros(3)
    rotations = _axes(f"about the {mover}'s", turned, ROTATION_DEG)
    positions = _axes("along the base's", moved, POSITION_MM)
    rank = int((principal >= ROTATION_DEG).sum())
    ready = len(good) >= MIN_GRIPPER_FRAMES and rank >= 2
    missing = _missing(len(good), rank, rotations, positions)
    state = "can be learned" if ready else "cannot be learned yet"
    verdict = f"{len(good)} of {len(rows)} images are good; the recording {state}."
    if missing:
        verdict += f" Missing: {'; '.join(missing[:3])}."
    elif len(good) == len(rows):
        verdict += " It is complete."
    return Coverage(rows, rotations, positions, rank, missing, ready, verdict)


def clipped_share(image: Image) -> float:
    """Share of pixels that are black (0 to 2) or white (253 to 255) in all channels."""
    return float(((image >= 253).all(-1) | (image <= 2).all(-1)).mean())


def _sample_reports(samples: Sequence[Sample]) -> tuple[SampleReport, ...]:
    middle = (
        float(np.median([sample.sharpness for sample in samples])) if samples else 1.0
    )
    poses = SE3.stack([sample.base_from_gripper for sample in samples])
    rows = []
    for i, sample in enumerate(samples):
        relative = sample.sharpness / middle if middle > 0 else 0.0
        problems = []
        if relative < SHARPNESS:
            problems.append(f"blurred (sharpness {100 * relative:.0f} % of the median)")
        if sample.clipped > CLIPPED:
            problems.append(
                f"{100 * sample.clipped:.0f} % of its pixels are black or white"
            )
        if i:
            metres, radians = pose_distance(poses[i], poses[:i])
            away = np.stack([1000 * metres / SAME_MM, np.rad2deg(radians) / SAME_DEG])
            nearest = int(np.argmin(np.hypot(*away)))
            if (away[:, nearest] < 1).all():
                problems.append(f"same pose as {samples[nearest].name}")
        rows.append(
            SampleReport(sample.name, relative, sample.clipped, tuple(problems))
        )
    return tuple(rows)


def _rotations_deg(poses: SE3) -> tuple[Array, Array]:
    """Standard deviations about the mover's own axes, and about principal axes, degrees, (3,)."""
    if len(poses) < 2:
        return np.zeros(3), np.zeros(3)
    rotations = poses.rotation
    away = np.rad2deg((rotations.mean().inv() * rotations).as_rotvec())
    away = away - away.mean(0)
    principal = np.linalg.svd(away, compute_uv=False) / np.sqrt(len(away))
    return away.std(0), np.pad(principal, (0, 3 - len(principal)))


def _axes(words: str, spreads: Array, least: float) -> tuple[AxisCoverage, ...]:
    named = zip("xyz", spreads.tolist(), strict=True)
    return tuple(
        AxisCoverage(f"{words} {axis} axis", s, s >= least) for axis, s in named
    )


def _missing(
    good: int,
    rank: int,
    rotations: Sequence[AxisCoverage],
    positions: Sequence[AxisCoverage],
) -> tuple[str, ...]:
    missing = []
    if good < MIN_GRIPPER_FRAMES:
        missing.append(f"{MIN_GRIPPER_FRAMES - good} more images to start with")
    # Two axes of rotation are necessary, the third one makes the result better.
    rotations_left = _uncovered(rotations)
    positions_left = _uncovered(positions)
    if rank < 2 and not rotations_left:
        missing.insert(0, "rotations about a second axis: tilt and turn independently")
    for axis in rotations_left:
        wanted = f"{axis.spread:.0f} deg, {ROTATION_DEG:.0f} wanted"
        missing.append(f"rotations {axis.name} ({wanted})")
    for axis in positions_left:
        wanted = f"{axis.spread:.0f} mm, {POSITION_MM:.0f} wanted"
        missing.append(f"positions {axis.name} ({wanted})")
    if MIN_GRIPPER_FRAMES <= good < IMAGES:
        missing.append(f"{IMAGES - good} more images")
    return tuple(missing)


def _uncovered(axes: Sequence[AxisCoverage]) -> list[AxisCoverage]:
    return sorted(
        (axis for axis in axes if not axis.covered), key=lambda axis: axis.spread
    )
