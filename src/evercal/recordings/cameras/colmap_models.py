"""The camera models of COLMAP. Its pixel (0.5, 0.5) is the centre of the top-left pixel."""

from collections.abc import Sequence

from evercal.typing import JsonObject

COLMAP_PARAMETERS = {
    "SIMPLE_PINHOLE": "fx cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "fx cx cy k1",
    "RADIAL": "fx cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "FOV": "fx fy cx cy omega",
    "SIMPLE_RADIAL_FISHEYE": "fx cx cy k1",
    "RADIAL_FISHEYE": "fx cx cy k1 k2",
    "THIN_PRISM_FISHEYE": "",
    "RAD_TAN_THIN_PRISM_FISHEYE": "",
    "SIMPLE_DIVISION": "",
    "DIVISION": "",
    "SIMPLE_FISHEYE": "fx cx cy",
    "FISHEYE": "fx fy cx cy",
    "EUCM": "fx fy cx cy alpha beta",
    "EQUIRECTANGULAR": "",
}
"""Parameters of the camera models by name, in the order of their numbers in binary files.

Those that are not empty are OpenCV's, or those of `RADIAL_MODELS`. The others are not supported.
"""


def colmap_fields(
    model: str, width: float, height: float, numbers: Sequence[float]
) -> JsonObject:
    """Fields of a camera of COLMAP; ValueError for models that are not supported."""
    names = COLMAP_PARAMETERS.get(model, "").split()
    if not names:
        supported = [
            name for name, parameters in COLMAP_PARAMETERS.items() if parameters
        ]
        raise ValueError(
            f"camera model {model} is not supported, only {', '.join(supported)};"
            f" undistort the images with 'colmap image_undistorter' and read its result"
        )
    if len(numbers) != len(names):
        raise ValueError(f"{model} has the parameters {names}, got {len(numbers)}")
    fields: JsonObject = {"model": model, "width": width, "height": height, "k1": 0.0}
    for name, number in zip(names, numbers, strict=True):
        # COLMAP counts from the image's corner.
        fields[name] = number - 0.5 * (name in ("cx", "cy"))
    fields.setdefault("fy", fields["fx"])
    return fields
