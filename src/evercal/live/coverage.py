"""What a wrist recording covers so far, and which samples are bad.

Hand-eye calibration needs rotations about two axes (Tsai and Lenz, IEEE T-RA 1989); images are
blurred, over- or underexposed, or show what another one shows. All limits are options.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from evercal.geometry import SE3, pose_distance
from evercal.recordings.frame import MIN_GRIPPER_FRAMES, Frame

Array = NDArray[np.float64]

_FLAT = 1.0
"""Squared slope below which an image shows no structure, grey values."""


@dataclass(frozen=True)
class CoverageOptions:
    """Limits of a good recording."""

    images: int = 25
    """Images of a complete recording."""
    rotation_deg: float = 8.0
    """Standard deviation of the rotation about an axis that counts as covered."""
    position_mm: float = 25.0
    """Standard deviation of the position along an axis that counts as covered."""
    sharpness: float = 0.8
    """Sharpness, relative to the median, below which an image is blurred."""
    clipped: float = 0.15
    """Share of black or white pixels above which an image is badly exposed."""
    same_mm: float = 8.0
    """Two samples closer than this, and than `same_deg`, are duplicates."""
    same_deg: float = 2.0
    """See `same_mm`."""


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
        return cls(frame.name, frame.base_from_gripper, sharpness(image), clipped_share(image))


@dataclass(frozen=True)
class SampleReport:
    """One row of a table of samples."""

    name: str
    sharpness: float
    """Relative to the median of the recording."""
    clipped: float
    """Share of black or white pixels."""
    nearest_mm: float | None
    """Distance to the most similar earlier sample; None for the first sample."""
    nearest_deg: float | None
    """Rotation from it."""
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
    samples: Sequence[Sample],
    gripper_from_camera: SE3 | None = None,
    options: CoverageOptions | None = None,
) -> Coverage:
    """Report what the samples cover; samples with problems count as not recorded.

    Args:
        samples: in recorded order.
        gripper_from_camera: a rough one, so that axes are those of the camera.
        options: limits.
    """
    options = options or CoverageOptions()
    rows = _sample_reports(samples, options)
    good = [s for s, row in zip(samples, rows, strict=True) if not row.problems]
    poses = SE3.stack([sample.base_from_gripper for sample in good])
    mover = "gripper"
    if gripper_from_camera is not None:
        poses, mover = poses @ gripper_from_camera, "camera"
    turned, principal = _rotations_deg(poses)
    moved = 1000 * poses.translation_m.std(0) if good else np.zeros(3)
    rotations = _axes(f"about the {mover}'s", turned, options.rotation_deg)
    positions = _axes("along the base's", moved, options.position_mm)
    rank = int((principal >= options.rotation_deg).sum())
    ready = len(good) >= MIN_GRIPPER_FRAMES and rank >= 2
    missing = _missing(len(good), rank, rotations, positions, options)
    state = "can be learned" if ready else "cannot be learned yet"
    verdict = f"{len(good)} of {len(rows)} images are good; the recording {state}."
    if missing:
        verdict += f" Missing: {'; '.join(missing[:3])}."
    elif len(good) == len(rows):
        verdict += " It is complete."
    return Coverage(rows, rotations, positions, rank, missing, ready, verdict)


def sharpness(image: NDArray[np.uint8]) -> float:
    """Contrast of fine structure relative to coarser one, in the direction of motion blur.

    It is the smallest generalised eigenvalue of the structure tensors of two octaves, which hardly
    depends on what is shown. An image without structure has 0.
    """
    import cv2
    from scipy.linalg import eigh

    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    fine, middle, coarse = (cv2.GaussianBlur(grey, (0, 0), sigma) for sigma in (1.0, 2.0, 4.0))
    above, below = _structure(fine - middle), _structure(middle - coarse)
    if np.linalg.eigvalsh(below)[0] < _FLAT:
        return 0.0
    return float(np.sqrt(max(eigh(above, below, eigvals_only=True)[0], 0.0)))


def _structure(band: Any) -> Array:
    import cv2

    slopes = [cv2.Sobel(band, cv2.CV_32F, *order).ravel() for order in ((1, 0), (0, 1))]
    return np.cov(slopes, bias=True)


def clipped_share(image: NDArray[np.uint8]) -> float:
    """Share of pixels that are black (0 to 2) or white (253 to 255) in all channels."""
    return float(((image >= 253).all(-1) | (image <= 2).all(-1)).mean())


def _sample_reports(
    samples: Sequence[Sample], options: CoverageOptions
) -> tuple[SampleReport, ...]:
    middle = float(np.median([sample.sharpness for sample in samples])) if samples else 1.0
    poses = SE3.stack([sample.base_from_gripper for sample in samples])
    rows = []
    for i, sample in enumerate(samples):
        relative = sample.sharpness / middle if middle > 0 else 0.0
        problems, near = [], (None, None)
        if relative < options.sharpness:
            problems.append(f"blurred (sharpness {100 * relative:.0f} % of the median)")
        if sample.clipped > options.clipped:
            problems.append(f"{100 * sample.clipped:.0f} % of its pixels are black or white")
        if i:
            metres, radians = pose_distance(poses[i], poses[:i])
            millimetres, degrees = 1000 * metres, np.rad2deg(radians)
            scaled = np.hypot(millimetres / options.same_mm, degrees / options.same_deg)
            nearest = int(np.argmin(scaled))
            near = float(millimetres[nearest]), float(degrees[nearest])
            if near[0] < options.same_mm and near[1] < options.same_deg:
                problems.append(f"same pose as {samples[nearest].name}")
        rows.append(SampleReport(sample.name, relative, sample.clipped, *near, tuple(problems)))
    return tuple(rows)


def _rotations_deg(poses: SE3) -> tuple[Array, Array]:
    """Standard deviations about the mover's own axes, and about principal axes, degrees, (3,)."""
    if len(poses) < 2:
        return np.zeros(3), np.zeros(3)
    rotations = Rotation.from_quat(poses.rotation_wxyz, scalar_first=True)
    away = np.rad2deg((rotations.mean().inv() * rotations).as_rotvec())
    away = away - away.mean(0)
    principal = np.linalg.svd(away, compute_uv=False) / np.sqrt(len(away))
    return away.std(0), np.pad(principal, (0, 3 - len(principal)))


def _axes(words: str, spreads: Array, least: float) -> tuple[AxisCoverage, ...]:
    named = zip("xyz", spreads.tolist(), strict=True)
    return tuple(AxisCoverage(f"{words} {axis} axis", s, s >= least) for axis, s in named)


def _missing(
    good: int,
    rank: int,
    rotations: Sequence[AxisCoverage],
    positions: Sequence[AxisCoverage],
    options: CoverageOptions,
) -> tuple[str, ...]:
    missing = []
    if good < MIN_GRIPPER_FRAMES:
        missing.append(f"{MIN_GRIPPER_FRAMES - good} more images to start with")
    # Two axes of rotation are necessary, the third one makes the result better.
    limits = (
        ("rotations", rotations, options.rotation_deg, "deg"),
        (
            "positions",
            positions,
            options.position_mm,
            "mm",
        ),
    )
    for what, axes, limit, unit in limits:
        missing += [
            f"{what} {axis.name} ({axis.spread:.0f} {unit}, {limit:.0f} wanted)"
            for axis in sorted(axes, key=lambda axis: axis.spread)
            if not axis.covered
        ]
    if rank < 2 and not any("rotations" in words for words in missing):
        missing.insert(0, "rotations about a second axis: tilt and turn independently")
    if MIN_GRIPPER_FRAMES <= good < options.images:
        missing.append(f"{options.images - good} more images")
    return tuple(missing)
