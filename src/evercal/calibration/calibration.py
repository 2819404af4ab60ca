"""`Calibration`: one transform with its uncertainty, what it was made from, and its file; `Rig`.

    {"format": "evercal-calibration", "version": 1, "mount": "eye_to_hand",
     "parent_frame": "base", "child_frame": "camera",
     "frames": {"base": "", "gripper": "", "camera": ""},
     "meaning": "pose of camera in base: takes points from camera to base",
     "translation_m": [3], "quaternion_wxyz": [4], "matrix": [4][4],
     "covariance": [6][6], "sigma_mm": x, "sigma_deg": x, "camera": {...},
     "lens": "estimated", "lenses": {"stated": {...}, "estimated": {...}},
     "for_stated_lens": {"matrix": [4][4], ..., "left_deg": x}, "images": [...],
     "error_terms": [...], "checks": {...}, "joints": [...], "joint_covariance": [k][k],
     "verdict": "...", "source": {...}, "created": "...", "made": {...},
     "verifications": [...]}

Metres, radians, quaternions w, x, y, z, OpenCV camera axes. The pose belongs to `camera`, which is
the one of `lenses` that `lens` names. `matrix`, `meaning`, `lens`, `for_stated_lens` and the sigmas
repeat other values for their readers, and so do `parent_frame` and `child_frame`, which hold the
words base, gripper and camera where `frames` does not know the name.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple, Self, get_args

import numpy as np

from evercal.calibration.checks import Checks
from evercal.calibration.framed_pose import (
    FramedPose,
    ImageUse as ImageUse,
    JointOffset as JointOffset,
)
from evercal.choices import ExportFormat
from evercal.classes import frozen, frozen_arrays, html_table
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, UncertainPose, axis_deviation, pose_distance
from evercal.robot.frame_names import FrameNames
from evercal.robot.mount import MountName, mount_named
from evercal.storage import write_json
from evercal.storage.provenance import Made, current, now
from evercal.storage.records import of_format, read_record
from evercal.typing import Array, JsonObject, PathLike, Record

if TYPE_CHECKING:
    from evercal.calibration.comparison import Comparison
    from evercal.calibration.evidence import Data
    from evercal.calibration.verification import Verification
    from evercal.robot.pose_errors import ArmErrors

FORMAT = "evercal-calibration"
VERSION = 1


@frozen
class ErrorTerm:
    """One source of error in the covariance: root mean square of the deviations of three axes."""

    name: str
    translation_mm: float
    rotation_deg: float
    cause: str = ""
    """`arm`, `lens` or `images`; empty for others."""
    covariance: list[list[float]] = field(default_factory=list)
    """(6, 6) metres and radians; empty in files of older versions."""

    @classmethod
    def of(cls, name: str, covariance: Array, cause: str = "") -> Self:
        """The term of a covariance (6, 6), metres and radians; rounding below zero counts as 0."""
        variance = np.maximum(np.diag(covariance), 0.0)
        sizes = axis_deviation(np.diag(variance))
        return cls(name, *sizes, cause, covariance.tolist())


def position_shares(terms: Sequence[ErrorTerm]) -> list[float]:
    """Share of each term in the variance of the position, 0 to 1."""
    variances = np.array([term.translation_mm**2 for term in terms])
    total = sum(variances.tolist())
    if not total > 0:
        return [0.0] * len(terms)
    return (variances / total).tolist()


def largest_term(terms: Sequence[ErrorTerm]) -> tuple[str, float]:
    """Name and share of the largest term of the position; an empty name without terms."""
    if not terms:
        return "", 0.0
    shares = position_shares(terms)
    largest = shares.index(max(shares))
    return terms[largest].name, shares[largest]


@dataclass(frozen=True, eq=False)
class Calibration(FramedPose):
    """Pose of a camera with its sources of error, checks and verdict."""

    error_terms: tuple[ErrorTerm, ...] = ()
    """Parts of the covariance by cause; from images, those of `CovarianceTerm` and the scatter."""
    checks: Checks = field(default_factory=Checks)
    """What it was compared with."""
    verdict: str = ""
    """Uses that it serves, one or two sentences."""
    source: Record = field(default_factory=dict)
    """Command, store, scene and options, JSON values."""
    created: str = field(default_factory=now)
    """ISO 8601 time with zone."""
    verifications: tuple[Record, ...] = ()
    """Tests by data that it had not seen, see `Verification.to_dict`."""
    made: Made | None = field(default_factory=current)
    """Version, command and inputs; None in files of older versions."""

    def __post_init__(self) -> None:
        mount_named(self.mount)
        if isinstance(self.checks, Mapping):
            object.__setattr__(self, "checks", Checks.from_dict(self.checks))
        covariance = np.array(self.covariance, float)
        if covariance.shape != (6, 6) or not np.isfinite(covariance).all():
            raise ValueError(
                f"a covariance is (6, 6) and finite, got {covariance.shape}"
            )
        if not np.allclose(covariance, covariance.T, rtol=1e-6, atol=1e-18):
            raise ValueError("a covariance is symmetric, got one that is not")
        if np.linalg.eigvalsh(covariance).min() < -1e-9 * max(
            np.trace(covariance), 1e-30
        ):
            raise ValueError(
                "a covariance has no negative eigenvalue, got one that has"
            )
        object.__setattr__(self, "covariance", covariance)
        k = len(self.joints)
        of_joints = np.array(self.joint_covariance, float)
        if of_joints.size != k * k:
            raise ValueError(
                f"the covariance of {k} joints is ({k}, {k}), got {of_joints.shape}"
            )
        object.__setattr__(self, "joint_covariance", of_joints.reshape(k, k))

    def __repr__(self) -> str:
        return f"Calibration({', '.join(self._in_words().values())})"

    def _repr_html_(self) -> str:
        words = self._in_words()
        used = sum(image.used for image in self.images)
        words["images"] = f"{used} of {len(self.images)} used"
        words["verdict"] = self.verdict
        return html_table("Calibration", words)

    def _in_words(self) -> dict[str, str]:
        x, y, z = 1000 * self.parent_from_child.translation_m
        return {
            "mount": self.mount,
            "transform": f"{self.parent_frame}_from_{self.child_frame}",
            "position": f"({x:.1f}, {y:.1f}, {z:.1f}) mm",
            "standard deviation": f"{self.sigma_mm:.2f} mm, {self.sigma_deg:.3f} deg",
        }

    @property
    def sigma_mm(self) -> float:
        """One standard deviation of the translation, root mean square of the axes."""
        return axis_deviation(self.covariance)[0]

    @property
    def sigma_deg(self) -> float:
        """The same of the rotation."""
        return axis_deviation(self.covariance)[1]

    def to_dict(self) -> JsonObject:
        """Return the JSON values described at the top of this file."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "mount": self.mount,
            **self.transform_to_dict(),
            "frames": vars(self.frames),
            "sigma_mm": self.sigma_mm,
            "sigma_deg": self.sigma_deg,
            "for_stated_lens": {
                **self.for_program().transform_to_dict(),
                "left_deg": float(np.rad2deg(self.stated_left_rad)),
            },
            "lenses": {name: own.to_dict() for name, own in self.lenses.items()},
            "images": [vars(image) for image in self.images],
            "error_terms": [vars(term) for term in self.error_terms],
            "checks": self.checks.to_dict(),
            "joints": [vars(joint) for joint in self.joints],
            "joint_covariance": self.joint_covariance.tolist(),
            "verdict": self.verdict,
            "source": dict(self.source),
            "created": self.created,
            "verifications": list(self.verifications),
            "made": self.made and asdict(self.made),
        }

    @classmethod
    def from_dict(cls, data: object) -> Self:
        """Create a calibration from the values of `to_dict`, or raise ValueError."""
        return of_format(data, FORMAT, VERSION, cls._from_mapping)

    @classmethod
    def _from_mapping(cls, data: Record) -> Self:
        if data.get("mount") not in get_args(MountName):
            raise ValueError(
                f"'mount' is one of {get_args(MountName)}, got {data.get('mount')!r}"
            )
        for name in ("checks", "source", "lenses"):
            if not isinstance(data.get(name, {}), Mapping):
                raise ValueError(f"{name!r} is an object")
        pose = SE3(data["quaternion_wxyz"], data["translation_m"])
        lens = data.get("camera")
        if (
            "matrix" in data
            and max(pose_distance(pose, SE3.from_matrix(data["matrix"]))) > 1e-6
        ):
            raise ValueError(
                "'matrix' and 'translation_m', 'quaternion_wxyz' are different poses; the file was"
                " edited by hand: change all of them or leave 'matrix' out"
            )
        return cls(
            mount=data["mount"],
            parent_from_child=pose,
            covariance=np.asarray(data["covariance"], float),
            frames=_names_in(data),
            camera=None if lens is None else Camera.from_dict(lens),
            lenses={k: Camera.from_dict(v) for k, v in data.get("lenses", {}).items()},
            images=tuple(ImageUse(**row) for row in data.get("images", [])),
            error_terms=tuple(ErrorTerm(**row) for row in data.get("error_terms", [])),
            checks=Checks.from_dict(data.get("checks", {})),
            joints=tuple(JointOffset(**row) for row in data.get("joints", [])),
            joint_covariance=np.array(data.get("joint_covariance", []), float),
            verdict=str(data.get("verdict", "")),
            source=data.get("source", {}),
            created=str(data.get("created", "")),
            verifications=tuple(map(dict, data.get("verifications", []))),
            made=Made.from_dict(data.get("made")),
        )

    def write(self, path: PathLike) -> None:
        """Write the file atomically."""
        write_json(path, self.to_dict())

    def distance(self, other: Self, distance_m: float | None = None) -> "Comparison":
        """Compare with another calibration of this camera, and judge whether both agree.

        Args:
            other: The other one, in the same frames.
            distance_m: Working distance. Default: that of the board, or 0.5 m.
        """
        from evercal.calibration.comparison import compare

        measured = []
        if self.source.get("map") == other.source.get("map"):
            for checks in (self.checks, other.checks):
                if checks.image_scatter:
                    scatter = np.array(checks.image_scatter)
                    measured.append((scatter, checks.images_used or 1))
        distance_m = distance_m or self.checks.target_m or other.checks.target_m
        return compare(self, other, distance_m, measured)

    def verify(self, data: "Data", errors: "ArmErrors | None" = None) -> "Verification":
        """Test the calibration with data that it has not seen, and judge whether it is honest.

        Args:
            data: From `unseen.touched.touched_data` or `unseen.targets.target_data`.
            errors: What is known of the arm. Default: its joints have no offsets.

        Raises:
            InputError: The data are far from what the calibration predicts.
        """
        from evercal.calibration.verification import judge

        return judge(self, data, errors)

    def export(
        self, format: ExportFormat | str, path: PathLike | None = None, **options: Any
    ) -> str:
        """Export to a format of other programs and return the text, see `export_files`."""
        from evercal.calibration.export.formats import export_files

        return export_files(self, format, path, **options).text


def _names_in(data: Record) -> FrameNames:
    """The names of a file; older ones state parent and child, by name or by the words for them."""
    stated = {
        mount_named(data["mount"]).parent: data["parent_frame"],
        "camera": data["child_frame"],
    }
    known = {role: name for role, name in stated.items() if name != role}
    frames = FrameNames.from_dict(data.get("frames", known))
    if {**vars(frames), **known} != vars(frames):
        raise ValueError(
            "'frames' names other frames than 'parent_frame' and 'child_frame'; the file was edited"
            " by hand: change both or leave 'frames' out"
        )
    return frames


def read_calibration(path: PathLike) -> Calibration:
    """Read a calibration file."""
    return read_record(path, "calibration file", Calibration.from_dict)


class RigPair(NamedTuple):
    """Pose of the second camera in the frame of the first."""

    first: str
    second: str
    first_from_second: UncertainPose
    moments: int | None = None
    """Number of moments that both saw, where they were solved together."""

    def to_dict(self) -> JsonObject:
        """Return JSON values."""
        pose = self.first_from_second.pose
        return {
            "parent_frame": self.first,
            "child_frame": self.second,
            "translation_m": pose.translation_m.tolist(),
            "quaternion_wxyz": pose.rotation_wxyz.tolist(),
            "matrix": pose.matrix().tolist(),
            "covariance": self.first_from_second.covariance.tolist(),
            "moments": self.moments,
        }


@frozen_arrays
class Rig:
    """Cameras that stand still in one base frame, or in that of the first one."""

    cameras: Mapping[str, Calibration]
    relative: tuple[RigPair, ...]
    """One for every two cameras."""

    def to_dict(self) -> JsonObject:
        """Return JSON values."""
        return {
            "format": "evercal-rig",
            "version": 1,
            "cameras": {
                name: camera.to_dict() for name, camera in self.cameras.items()
            },
            "relative": [pair.to_dict() for pair in self.relative],
        }

    def write(self, path: PathLike) -> None:
        """Write the file atomically."""
        write_json(path, self.to_dict())


def rig_of(cameras: Mapping[str, Calibration]) -> Rig:
    """Compute the relative poses of eye_to_hand cameras, as if their errors were independent."""
    scenes = {name: camera.source.get("scene") for name, camera in cameras.items()}
    if len(cameras) < 2:
        raise InputError("a rig has at least two cameras: give NAME=FOLDER for each")
    if len(set(scenes.values())) > 1:
        listed = ", ".join(f"{name} in {scene}" for name, scene in scenes.items())
        raise InputError(
            f"the cameras were located in different scenes ({listed}); a rig is in one"
        )
    pairs = []
    for first, second in itertools.combinations(cameras, 2):
        pose = cameras[first].uncertain_pose.inverse() @ cameras[second].uncertain_pose
        pairs.append(RigPair(first, second, pose))
    return Rig(cameras, tuple(pairs))
