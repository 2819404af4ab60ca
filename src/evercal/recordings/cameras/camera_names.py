"""Names of what camera files state: fields, and numbers that change no pixel.

Names are compared in lower case without underscores, dashes and blanks.
"""

import re

from evercal.geometry.camera import COEFFICIENTS
from evercal.recordings.poses.row_files import by_alias

_NAMES = by_alias("""
camera_matrix: cameramatrix intrinsicmatrix mtx k camk cammtx cammatrix camerak
camera_matrix: cameraintrinsics intrinsics intrinsic
camera_matrix: projectionparameters
distortion_coefficients: distortioncoefficients distortioncoeffs
distortion_coefficients: distortionparameters distortionparams
distortion_coefficients: distcoeffs distcoeff distortion dist
distortion_coefficients: distcoefs distortioncoefs disto distortions distortioncoeff
distortion_coefficients: cameradistortion lensdistortion cameradist cameradistcoeffs
distortion_coefficients: camdist lenscoeffs lensdistortioncoefficients
distortion_coefficients: coefficients coeffs d kc
image_width: imagewidth width w resolutionwidth resolutionx
image_height: imageheight height h resolutionheight resolutiony
image_size: imagesize imgsize resolution size imagersize imageresolution
fx: fx focallengthx focalx
fy: fy focallengthy focaly
cx: cx ppx principalpointx principalptx
cy: cy ppy principalpointy principalpty
k1: k1 radialdistortion1
k2: k2 radialdistortion2
k3: k3 radialdistortion3
k4: k4 radialdistortion4
p1: p1 tangentialdistortion1 tangentialdistortioncoefficientx
p2: p2 tangentialdistortion2 tangentialdistortioncoefficienty
""")
"""Names of fields by their aliases."""
MODEL_NAMES = (
    "distortionmodel",
    "model",
    "cameramodel",
    "cameratype",
    "intrinsictype",
    "lensmodel",
    "modeltype",
    "projectionmodel",
    "type",
)
"""Names of fields that hold the name of a model."""
_PINHOLE = COEFFICIENTS["pinhole"]
DISTORTION = ("distortion_coefficients", *_PINHOLE)
"""Names of fields that hold distortion."""
FIELDS = {*_NAMES.values(), *_PINHOLE}
"""Names of fields of a camera; each may be stated once."""
CAMERA_INFO = {
    "rectificationmatrix",
    "projectionmatrix",
    "header",
    "roi",
}
"""Names of fields of ROS."""
_HARMLESS = re.compile(
    r"error|rms|repro|resid|std|dev|sigma|covar|uncert|fps|rate|freq|square|board|marker|pattern"
    r"|chess|tag|count|num|nr|frames|images|views|points|flags|date|time|stamp|version|serial|id$"
    r"|index|baseline|depth|range|temp|apert(?!ureoffset)|expos|gain|fov|angle|focal|aspect|mm$|rotation|trans"
    r"|^[rt]vec|quat|extrin|pose|position|orient|imu|noise|^rgb$|track|^bf$|^new|imagescale"
    r"|overlap|^d[wh]$|perframe|center|radius|score|neighbor|^t\d|region|icam|stereo|thdepth"
    r"|orbextract|viewer|system|accel|gyro|bias|walk|mocap|vignette|batch|unit|housing|^[rsp]rect|rectific|corner"
    r"|^t$|^pos|^rot$|euler|axes|axis|focus|fstop|near|far|clip|socket|firmware|port|seed|quality|channels|bits|buffer|cost"
    r"|weight|speed|robot|joint|gripper|world|origin|name|^step|^bounds|limit|threshold|light|ambient|bright|white"
    r"|^sensor(width|height|size)$|from|xyz|rpy|hand|tool|flange|mount|initial|optimal|^ret|^fw|^t[a-z]*(cam|imu|base|body)|^tbs$"
)
"""Names of numbers that do not change where a point lies in the image."""
LENS = re.compile(
    r"disto|^dist(?!an)|(?<!intrinsic)coef|radial|tangent|^lens(?!pos|name|id|serial)|lenses|warp|aberr"
)
"""Names of numbers that do, whatever else the name says."""


def is_harmless(key: str) -> bool:
    """Whether a number of this name, or in this block, changes no pixel."""
    parts = [plain_name(part) for part in key.split(".")]
    if any(map(LENS.search, parts)):
        return False
    return any(part in CAMERA_INFO or _HARMLESS.search(part) for part in parts)


def is_array(value: object) -> bool:
    """Whether a value holds numbers in rows: lists, or an array of OpenCV or ROS."""
    return isinstance(value, list) or (isinstance(value, dict) and "data" in value)


def field_name(key: object) -> str:
    """The name that a key is an alias of, or else the key in lower case."""
    plain = plain_name(key)
    return _NAMES.get(plain, plain)


def plain_name(key: object) -> str:
    """A name in lower case without underscores, dashes and blanks."""
    return re.sub(r"[\s_-]", "", str(key).lower())
