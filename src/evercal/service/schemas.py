"""What `/openapi.json` states: how the service is used, and its answers as types.

Answers are not made from these types, only described: tests compare them with what is sent.
"""

from typing import Any, Literal

from fastapi import UploadFile
from pydantic import BaseModel
from pydantic_core import PydanticCustomError

from evercal.calibration.calibration import ErrorTerm
from evercal.calibration.checks import Checks
from evercal.calibration.framed_pose import ImageUse, JointOffset
from evercal.choices import MountName, Status
from evercal.geometry import Camera
from evercal.robot.frame_names import FrameNames
from evercal.storage.provenance import Made
from evercal.typing import JsonObject

DESCRIPTION = """
evercal answers where a camera is: one image in, the camera's pose in the robot base frame out.

- **Images** are files (PNG, JPEG, BMP, TIFF or WebP) as the camera took them: neither cropped nor
  scaled. Without `camera`, their intrinsics are estimated.
- **Poses** take points from the frame that they name last to the one that they name first:
  `base_from_camera` from camera to base. Cameras have OpenCV axes: x right, y down, z forward.
- **Units** are metres, radians and pixels, others are in the name. Quaternions are w, x, y, z.
- **An image of an unknown place** is an answer as well: status 200, `status` says `unknown_scene`.
- **Errors** have a status from 400 and one line, `{"error": ...}`.
- **Token**: if the service was started with one, send `Authorization: Bearer TOKEN`.

**Streams.** The websocket `/track` (not listed below: this format has no websockets) locates the
frames of one camera in order. Send image files as binary messages. Each is answered by a text
message: the JSON object of `/localize` with `frame`, `state` (`tracking`, `relocalized` or `lost`),
`stamp_s`, `smoothed`, `jumped`, `omitted`, `waiting` and `dropped`; or `error`, `path` and the
counts. A text message from you holds the intrinsics of the frames that follow. `/track?newest=1`
drops all but the newest of the frames that wait. `scene=NAME` locates in this scene only.
"""
"""Beginning of the page."""
TAGS = [
    {"name": "images", "description": "Locate images; calibrate and check cameras."},
    {"name": "service", "description": "What is served, and whether it is well."},
]
"""Groups of the page."""
Matrix = list[list[float]]
"""Rows."""


FILE = {"type": "string", "format": "binary"}
"""Schema of a file of a form."""


class Upload(UploadFile):
    """A file of a form.

    Generators of clients type a file where `format` is binary; FastAPI writes contentMediaType.
    """

    @classmethod
    def _validate(cls, value: Any, _: Any) -> UploadFile:
        if isinstance(value, str):
            raise PydanticCustomError("text", "send a file: a part with a file name")
        return super()._validate(value, _)

    @classmethod
    def __get_pydantic_json_schema__(cls, *_: Any) -> JsonObject:
        return FILE


class Record(BaseModel, use_attribute_docstrings=True):
    """JSON values by name, described by the texts below them."""


class Problem(Record):
    """A request that was refused, or that failed."""

    error: str
    """One line: what was wrong, and what helps."""


class Health(Record):
    """Whether the service is well."""

    status: str
    """`ok`, or what is wrong with the map."""
    scenes: int
    """Number of scenes."""


class SceneNames(Record):
    """Scenes of the map."""

    scenes: list[str]
    """In order of learning."""


class Pose(Record):
    """A rigid transform."""

    translation_m: list[float]
    """(3,) metres; of a map without scale in its own unit."""
    quaternion_wxyz: list[float]
    """(4,)."""


class MatrixPose(Pose):
    """A rigid transform, also as a matrix."""

    matrix: Matrix
    """(4, 4)."""


class Share(Record):
    """One cause of the error of a pose."""

    name: str
    """`view`, `lens`, `map`, `stated poses` or `base frame`."""
    translation_mm: float | None
    """Root mean square of the axes; null without a scale."""
    rotation_deg: float
    cause: str
    covariance: Matrix
    """(6, 6)."""
    share: float
    """Of the variance of the position, 0 to 1."""


class Estimate(Record):
    """The answer for one image: the row of `evercal localize --json`."""

    path: str
    """Name of the image."""
    status: Status
    """`ok`, or why the pose must not be used."""
    reason: str
    """The same in words; empty if `ok`."""
    scene: str | None
    """Where the image was taken."""
    base: str
    """Name of the base of this scene; empty without one."""
    unit: Literal["metres", "unknown"] | None
    """Unit of lengths; null without a pose."""
    parent_frame: str
    """`gripper` in the map of a thing that the gripper holds."""
    base_from_camera: MatrixPose | None
    """The pose; null without one."""
    alternatives: list[Pose]
    """Poses of an ambiguous image, the stronger one first."""
    alternatives_in: list[str]
    """Their scenes."""
    covariance: Matrix | None
    """(6, 6) of translation in the base, metres, and rotation about camera axes, radians."""
    error_terms: list[Share]
    """Causes of the covariance."""
    inliers: int
    """Landmarks that agree with the pose."""
    inlier_ratio: float
    """As a share of those that should be visible."""
    support: float
    """-log10 of the probability of as many inliers at a wrong pose."""
    ms: float
    """Milliseconds, decoding included."""


class Transform(MatrixPose):
    """A pose between two named frames."""

    parent_frame: str
    child_frame: str
    meaning: str
    """The direction in words."""
    covariance: Matrix
    """(6, 6) of translation in the parent frame, metres, and rotation about child axes, radians."""
    lens: str
    """Name of `camera` in `lenses`."""
    camera: Camera | None
    """Intrinsics that the pose belongs to."""


class StatedLens(Transform):
    """The pose for a program that uses the stated intrinsics."""

    left_deg: float
    """Angle by which rays of the two differ, whatever the pose."""


class CalibrationFile(Transform):
    """A calibration file, as `calibration` of `/check` takes it."""

    format: Literal["evercal-calibration"]
    version: int
    mount: MountName
    """Fixed beside the arm (`eye_to_hand`), or on the gripper."""
    frames: FrameNames
    sigma_mm: float
    """Standard deviation per axis."""
    sigma_deg: float
    """Standard deviation per axis."""
    for_stated_lens: StatedLens
    lenses: dict[str, Camera]
    """Intrinsics: `stated` with the images, and `estimated`."""
    images: list[ImageUse]
    error_terms: list[ErrorTerm]
    """Causes of the covariance."""
    checks: Checks
    joints: list[JointOffset]
    joint_covariance: Matrix
    verdict: str
    """Uses that it serves, one or two sentences."""
    source: JsonObject
    """Map, scene and options."""
    created: str
    """ISO 8601."""
    verifications: list[JsonObject]
    made: Made | None
    """Version, command and inputs."""


class CameraShift(Record):
    """Motion of a camera since its calibration: the object of `evercal check --json`."""

    moved: bool
    translation_mm: float
    rotation_deg: float
    sigma_mm: float
    """Standard deviation per axis."""
    sigma_deg: float
    """Standard deviation per axis."""
    confidence: float
    """Probability that it moved at all, 0 to 1."""
    same_map: bool
    """Whether both poses come from one map, so that its errors cancel."""
    note: str
    """What else differs; empty without."""
    reference_from_now: Matrix
    """(4, 4): the camera now, in its frame at the time of the calibration."""
    images: int
    """Number of images."""
    left_out: list[ImageUse]
    """Those that were not used."""
