"""Which motions a wrist recording covers so far, and which samples are bad.

Hand-eye calibration needs rotations about two axes (Tsai and Lenz, IEEE T-RA 1989); images are
blurred, over- or underexposed, or show what another one shows.
"""

from collections.abc import Sequence
from typing import Self

import numpy as np

from evercal.classes import frozen, frozen_arrays
from evercal.geometry import SE3, pose_distance
from evercal.recordings.frame import MIN_TRAIN_FRAMES, Frame
from evercal.recordings.pictures import sharpness
from evercal.typing import Array, ArrayPair, Image, Strings

IMAGES = 25
"""Images of a complete recording."""
ROTATION_DEG = 8.0
"""Standard deviation of the rotations about an axis, from which it counts as covered, degrees."""
POSITION_MM = 25.0
"""Standard deviation of the positions along an axis, from which it counts as covered."""
SHARPNESS = 0.8
"""Sharpness, relative to the median of the recording, below which an image is blurred."""
CLIPPED = 0.15
"""Share of black or white pixels above which an image is badly exposed."""
SAME_MM = 8.0
"""Distance in millimetres below which two samples may be duplicates."""
SAME_DEG = 2.0
"""Rotation in degrees below which two samples may be duplicates."""


@frozen_arrays
class Sample:
    """Pose and image quality of one frame, measured once."""

    name: str
    base_from_gripper: SE3
    sharpness: float
    """Contrast of fine structure relative to that of coarser structure."""
    clipped: float
    """Share of pixels that are black or white."""

    @classmethod
    def of(cls, frame: Frame) -> Self:
        """Measure a frame with a gripper pose."""
        assert frame.base_from_gripper, "coverage is of gripper poses"
        image = frame.read_image()
        return cls(
            name=frame.name,
            base_from_gripper=frame.base_from_gripper,
            sharpness=sharpness(image),
            clipped=clipped_share(image),
        )


@frozen
class SampleReport:
    """One row of a table of samples."""

    name: str
    sharpness: float
    """Relative to the median of the recording."""
    clipped: float
    """Share of black or white pixels."""
    problems: Strings
    """Reasons to remove it; empty for a good sample."""


@frozen
class AxisCoverage:
    """One axis of rotation or translation."""

    name: str
    spread: float
    """Standard deviation, degrees or millimetres."""
    covered: bool


@frozen
class Coverage:
    """Motions that a recording covers, its bad samples, and what to record next."""

    samples: tuple[SampleReport, ...]
    rotations: tuple[AxisCoverage, ...]
    """About x, y and z of the camera, or of the gripper if gripper_from_camera is unknown."""
    positions: tuple[AxisCoverage, ...]
    """Of the camera or the gripper, along x, y and z of the base."""
    rotation_rank: int
    """Number of axes about which the rotations spread; calibration needs two."""
    missing: Strings
    """What to record, most urgent first."""
    ready: bool
    """Whether it can be learned: enough images and rotations about two axes."""
    verdict: str
    """One or two sentences."""


def coverage(
    samples: Sequence[Sample],
    gripper_from_camera: SE3 | None = None,
    use: str = "learned",
) -> Coverage:
    """Report what samples cover, in recorded order; those with problems count as not recorded.

    With a rough `gripper_from_camera`, axes are those of the camera. `use` says what can be done
    with the recording.
    """
    poses = SE3.stack([sample.base_from_gripper for sample in samples])
    rows = _sample_reports(samples, poses)
    good = [i for i, row in enumerate(rows) if not row.problems]
    poses = poses[good]
    mover = "gripper"
    if gripper_from_camera:
        poses = poses @ gripper_from_camera
        mover = "camera"
    rotation_spreads, principal_spreads = _rotation_spreads_deg(poses)
    position_spreads = np.zeros(3)
    if good:
        position_spreads = 1000 * poses.translation_m.std(0)
    rotations = _axes(f"about the {mover}'s", rotation_spreads, ROTATION_DEG)
    positions = _axes("along the base's", position_spreads, POSITION_MM)
    rank = int((principal_spreads >= ROTATION_DEG).sum())
    ready = len(good) >= MIN_TRAIN_FRAMES and rank >= 2
    missing = _missing(len(good), rank, rotations, positions)
    state = f"can be {use}" if ready else f"cannot be {use} yet"
    verdict = f"{len(good)} of {len(rows)} images are good; the recording {state}."
    if missing:
        verdict += f" Missing: {'; '.join(missing[:3])}."
    elif len(good) == len(rows):
        verdict += " It is complete."
    return Coverage(rows, rotations, positions, rank, missing, ready, verdict)


def clipped_share(image: Image) -> float:
    """Share of pixels that are black (0 to 2) or white (253 to 255) in all channels."""
    white = (image >= 253).all(-1)
    black = (image <= 2).all(-1)
    return float((white | black).mean())


def _sample_reports(samples: Sequence[Sample], poses: SE3) -> tuple[SampleReport, ...]:
    median = 0.0
    if samples:
        median = float(np.median([sample.sharpness for sample in samples]))
    rows = []
    for i, sample in enumerate(samples):
        relative = sample.sharpness / median if median > 0 else 0.0
        problems = []
        if relative < SHARPNESS:
            problems.append(f"blurred (sharpness {100 * relative:.0f} % of the median)")
        if sample.clipped > CLIPPED:
            problems.append(
                f"{100 * sample.clipped:.0f} % of its pixels are black or white"
            )
        if i:
            metres, radians = pose_distance(poses[i], poses[:i])
            positions = 1000 * metres / SAME_MM
            rotations = np.rad2deg(radians) / SAME_DEG
            nearest = int(np.argmin(np.hypot(positions, rotations)))
            if positions[nearest] < 1 and rotations[nearest] < 1:
                problems.append(f"same pose as {samples[nearest].name}")
        rows.append(
            SampleReport(sample.name, relative, sample.clipped, tuple(problems))
        )
    return tuple(rows)


def _rotation_spreads_deg(poses: SE3) -> ArrayPair:
    """Standard deviations about the mover's axes, and about principal axes, degrees, (3,)."""
    if len(poses) < 2:
        return np.zeros(3), np.zeros(3)
    rotations = poses.rotation
    from_mean = rotations.mean().inv() * rotations
    angles = np.rad2deg(from_mean.as_rotvec())
    angles = angles - angles.mean(0)
    principal = np.linalg.svd(angles, compute_uv=False) / np.sqrt(len(angles))
    return angles.std(0), np.pad(principal, (0, 3 - len(principal)))


def _axes(words: str, spreads: Array, least: float) -> tuple[AxisCoverage, ...]:
    named = zip("xyz", spreads.tolist(), strict=True)
    return tuple(AxisCoverage(f"{words} {a} axis", s, s >= least) for a, s in named)


def _missing(
    good: int,
    rank: int,
    rotations: Sequence[AxisCoverage],
    positions: Sequence[AxisCoverage],
) -> Strings:
    missing = []
    if good < MIN_TRAIN_FRAMES:
        missing.append(f"{_more(MIN_TRAIN_FRAMES - good)} to start with")
    # Two axes of rotation are necessary, the third one makes the result better.
    rotations_left = _uncovered(rotations)
    if rank < 2 and not rotations_left:
        missing.insert(0, "rotations about a second axis: tilt and turn independently")
    for what, unit, least, axes in (
        ("rotations", "deg", ROTATION_DEG, rotations_left),
        ("positions", "mm", POSITION_MM, _uncovered(positions)),
    ):
        for axis in axes:
            wanted = f"{axis.spread:.0f} {unit}, {least:.0f} wanted"
            missing.append(f"{what} {axis.name} ({wanted})")
    if MIN_TRAIN_FRAMES <= good < IMAGES:
        missing.append(_more(IMAGES - good))
    return tuple(missing)


def _more(images: int) -> str:
    if images == 1:
        return "1 more image"
    return f"{images} more images"


def _uncovered(axes: Sequence[AxisCoverage]) -> list[AxisCoverage]:
    uncovered = [axis for axis in axes if not axis.covered]
    return sorted(uncovered, key=lambda axis: axis.spread)
