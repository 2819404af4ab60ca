"""`Calibration`: one transform with its uncertainty, what it was made from, and its file.

    {"format": "evercal-calibration", "version": 1, "mount": "eye_to_hand",
     "parent_frame": "base", "child_frame": "camera",
     "meaning": "pose of camera in base: takes points from camera to base",
     "translation_m": [3], "quaternion_wxyz": [4], "matrix": [4][4],
     "covariance": [6][6], "sigma_mm": x, "sigma_deg": x, "camera": {...}, "images": [...],
     "error_terms": [...], "checks": {...}, "verdict": "...", "source": {...}, "created": "..."}

Metres, radians, quaternions w, x, y, z, OpenCV camera axes. `matrix`, `meaning` and the sigmas
repeat what stands beside them, for people and for programs that read one of them; reading a file
checks that they agree.
"""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.geometry import SE3, Camera, UncertainPose, axis_deviation, pose_distance
from evercal.storage import write_json

FORMAT, VERSION = "evercal-calibration", 1
Mount = Literal["eye_to_hand", "eye_in_hand"]


@dataclass(frozen=True)
class ImageUse:
    """What became of one image or pose pair."""

    name: str
    """Of the image or the row."""
    used: bool
    """Whether the answer rests on it."""
    reason: str = ""
    """Why it was left out; empty if it was used."""
    residual_mm: float | None = None
    """How far its translation lies from what the answer predicts."""
    residual_deg: float | None = None
    """The same for its rotation."""


@dataclass(frozen=True)
class ErrorTerm:
    """One source of error inside the covariance, as one standard deviation a direction."""

    name: str
    """What it is, for people."""
    translation_mm: float
    """Root mean square of the three axes."""
    rotation_deg: float
    """Root mean square of the three axes."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """Where a camera is: `parent_from_child`.

    Raises:
        ValueError: A covariance that is not (6, 6), finite, symmetric and positive semi-definite,
            or two frames of one name.
    """

    mount: Mount
    """`eye_to_hand`: the camera stands still. `eye_in_hand`: the gripper carries it."""
    parent_from_child: SE3
    """Single transform."""
    covariance: NDArray[np.float64]
    """(6, 6) of (translation in the parent frame, metres; rotation about child axes, radians)."""
    parent_frame: str = "base"
    """`base` for eye_to_hand, `gripper` for eye_in_hand, or the robot's own names for them."""
    child_frame: str = "camera"
    """The camera's optical frame: x right, y down, z forward."""
    camera: Camera | None = None
    """Intrinsics that it holds for."""
    images: tuple[ImageUse, ...] = ()
    """What was given, in that order."""
    error_terms: tuple[ErrorTerm, ...] = ()
    """What the covariance is made of."""
    checks: Mapping[str, Any] = field(default_factory=dict)
    """Numbers of the checks that were made, JSON values: `held_out_mm`, `repeatability_mm`, ..."""
    verdict: str = ""
    """What it is good for, one or two sentences."""
    source: Mapping[str, Any] = field(default_factory=dict)
    """Which command, store, scene and options made it, JSON values."""
    created: str = ""
    """ISO 8601 time with zone."""

    def __post_init__(self) -> None:
        covariance = np.array(self.covariance, dtype=np.float64)
        if covariance.shape != (6, 6) or not np.isfinite(covariance).all():
            raise ValueError(f"a covariance is (6, 6) and finite, got {covariance.shape}")
        if not np.allclose(covariance, covariance.T, rtol=1e-6, atol=1e-18):
            raise ValueError("a covariance is symmetric, got one that is not")
        if np.linalg.eigvalsh(covariance).min() < -1e-9 * max(np.trace(covariance), 1e-30):
            raise ValueError("a covariance has no negative eigenvalue, got one that has")
        if self.parent_frame == self.child_frame:
            raise ValueError(f"parent and child frame are both called {self.parent_frame!r}")
        object.__setattr__(self, "covariance", covariance)

    @property
    def meaning(self) -> str:
        """The direction in words."""
        child, parent = self.child_frame, self.parent_frame
        return f"pose of {child} in {parent}: takes points from {child} to {parent}"

    @property
    def uncertain_pose(self) -> UncertainPose:
        """`parent_from_child` with its covariance."""
        return UncertainPose(self.parent_from_child, self.covariance)

    @property
    def sigma_mm(self) -> float:
        """One standard deviation of the translation, root mean square of the axes."""
        return axis_deviation(self.covariance)[0]

    @property
    def sigma_deg(self) -> float:
        """The same of the rotation."""
        return axis_deviation(self.covariance)[1]

    def to_dict(self) -> dict[str, Any]:
        """JSON values, see the top of this file."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "mount": self.mount,
            "parent_frame": self.parent_frame,
            "child_frame": self.child_frame,
            "meaning": self.meaning,
            "translation_m": self.parent_from_child.translation_m.tolist(),
            "quaternion_wxyz": self.parent_from_child.rotation_wxyz.tolist(),
            "matrix": self.parent_from_child.matrix().tolist(),
            "covariance": self.covariance.tolist(),
            "sigma_mm": self.sigma_mm,
            "sigma_deg": self.sigma_deg,
            "camera": None if self.camera is None else self.camera.to_dict(),
            "images": [vars(image) for image in self.images],
            "error_terms": [vars(term) for term in self.error_terms],
            "checks": dict(self.checks),
            "verdict": self.verdict,
            "source": dict(self.source),
            "created": self.created,
        }

    @classmethod
    def from_dict(cls, data: object) -> Self:
        """The reverse of `to_dict`.

        Raises:
            ValueError: Not a calibration, of another version, or one that contradicts itself.
        """
        if not isinstance(data, dict) or data.get("format") != FORMAT:
            raise ValueError(f"no calibration: 'format' is not {FORMAT!r}")
        if data.get("version") != VERSION:
            raise ValueError(f"version {data.get('version')!r}; this evercal reads {VERSION}")
        if data.get("mount") not in get_args(Mount):
            raise ValueError(f"'mount' is one of {get_args(Mount)}, got {data.get('mount')!r}")
        try:
            pose = SE3(data["quaternion_wxyz"], data["translation_m"])
            covariance = np.asarray(data["covariance"], dtype=np.float64)
            lens = data.get("camera")
            found = cls(
                data["mount"],
                pose,
                covariance,
                str(data["parent_frame"]),
                str(data["child_frame"]),
                None if lens is None else Camera.from_dict(lens),
                tuple(ImageUse(**image) for image in data.get("images", [])),
                tuple(ErrorTerm(**term) for term in data.get("error_terms", [])),
                data.get("checks", {}),
                str(data.get("verdict", "")),
                data.get("source", {}),
                str(data.get("created", "")),
            )
        except KeyError as error:
            raise ValueError(f"{error} is missing") from None
        except TypeError as error:
            raise ValueError(f"an entry has the wrong kind of value ({error})") from None
        if "matrix" in data:
            metres, radians = pose_distance(pose, SE3.from_matrix(data["matrix"]))
            if metres > 1e-6 or radians > 1e-6:
                raise ValueError(
                    "'matrix' and 'translation_m', 'quaternion_wxyz' say different poses; it was"
                    " edited by hand: change all of them or leave 'matrix' out"
                )
        return found

    def write(self, path: str | os.PathLike[str]) -> None:
        """Create or replace the file, whole or not at all."""
        write_json(path, self.to_dict())

    def export(
        self, format: str, path: str | os.PathLike[str] | None = None, **options: Any
    ) -> str:
        """Export to a format of other tools; see `evercal export --format list`.

        Args:
            format: name of the format, such as `easy_handeye2`, `launch_py` or `urdf`.
            path: file to write. Default: the text is only returned.
            **options: of the format, see `calibration.export`.

        Raises:
            InputError: Unknown format, or one that does not fit this calibration.
        """
        from evercal.calibration.export import export_calibration

        return export_calibration(self, format, path, **options)


def read_calibration(path: str | os.PathLike[str]) -> Calibration:
    """Reads a calibration file.

    Raises:
        InputError: Missing, no JSON, or no calibration.
    """
    path = Path(path)
    try:
        return Calibration.from_dict(json.loads(path.read_text(encoding="utf-8")))
    except FileNotFoundError:
        raise InputError(f"{path}: calibration file is missing; check the path") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError as error:
        raise InputError(f"{path}: {error}; give the JSON that evercal wrote") from None


def read_transform(path: str | os.PathLike[str]) -> SE3:
    """A rigid transform from a calibration file or from a 4x4 matrix as text.

    Raises:
        InputError: Missing, or neither of the two.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(f"{path}: file is missing; check the path") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text ({error})") from None
    if text.lstrip().startswith("{"):
        return read_calibration(path).parent_from_child
    try:
        numbers = [float(word) for word in text.replace(",", " ").split()]
        if len(numbers) != 16:
            raise ValueError(f"{len(numbers)} numbers, a 4x4 matrix has 16")
        return SE3.from_matrix(np.reshape(numbers, (4, 4)))
    except ValueError as error:
        raise InputError(
            f"{path}: {error}; give a 4x4 matrix as text, metres, or evercal's calibration JSON"
        ) from None
