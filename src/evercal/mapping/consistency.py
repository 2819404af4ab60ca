"""Whether a stored scene is one: right checksums say only that a file is what somebody wrote."""

from typing import Any

import numpy as np

from evercal.bounds import bounds, require_image_size
from evercal.features.encoder import Encoder
from evercal.features.vlad import WIDTH
from evercal.mapping.keyframes import Keyframes
from evercal.mapping.map_frame import MapFrame
from evercal.mapping.scene_map import SceneMap
from evercal.recordings.images import size_in_header


def require_consistent(scene: SceneMap) -> None:
    """Raise an error where the parts of a scene contradict each other."""
    for camera in (scene.camera, scene.adjusted_camera):
        require_image_size(camera.width, camera.height, "camera")
    keyframes = scene.keyframes
    descriptors = keyframes.descriptors
    assert descriptors is not None, "a map has descriptors"
    _require_finite("unit", scene.unit or 1.0, scene.intrinsics_sigma)
    _require_finite("descriptors", descriptors)
    _require_frame(scene.frame)
    _require(scene.train_frames > 0, "a scene has training frames")
    _require(scene.landmarks > 0, "a scene has landmarks")
    counts = {
        len(keyframes.images),
        len(keyframes.cameras),
        len(keyframes.base_from_camera),
        len(keyframes.inverse_depth),
        len(keyframes.landmarks),
        len(descriptors),
    }
    _require(len(counts) == 1, f"parts of {counts} keyframes")
    for i in range(len(keyframes)):
        _require_keyframe(keyframes, i)


def require_of_encoder(scene: SceneMap, encoder: Encoder, short_side: int) -> None:
    """Raise ValueError for a scene that another encoder has made."""
    keyframes = scene.keyframes
    descriptors = keyframes.descriptors
    if encoder.centroids is not None and descriptors is not None:
        width = min(encoder.centroids.size, WIDTH)
        shape = descriptors.shape
        _require(shape[1:] == (width,), f"descriptors {shape} of width {width}")
    for i, camera in enumerate(keyframes.cameras):
        small = camera.short_side_resized(short_side)
        columns = small.width // encoder.stride
        rows = small.height // encoder.stride
        depths = len(keyframes.inverse_depth[i])
        _require(
            depths == rows * columns,
            f"keyframe {i}: {depths} depths of {rows}x{columns} cells",
        )


def _require_keyframe(keyframes: Keyframes, i: int) -> None:
    name = f"keyframe {i}"
    camera = keyframes.cameras[i]
    size = (camera.width, camera.height)
    require_image_size(*size, name)
    most = bounds().map_side
    _require(max(size) <= most, f"{name}: {size} pixels, at most {most} a side")
    image = np.frombuffer(keyframes.images[i], np.uint8)
    stated = size_in_header(image)
    _require(stated == size, f"{name}: {stated} pixels, its camera {size}")
    marks = keyframes.landmarks[i]
    inside = (marks.pixels >= 0) & (marks.pixels < size)
    positive = np.minimum(marks.inverse_depth, marks.sigma) > 0
    _require(inside.all(), f"{name}: landmarks outside the image")
    _require(positive.all(), f"{name}: landmarks without depth")
    _require_finite(
        f"{name}: landmarks",
        marks.inverse_depth,
        marks.sigma,
        marks.slope,
    )


def _require_frame(frame: MapFrame) -> None:
    _require(frame.scale > 0, "the scale is positive")
    _require_finite("frame", frame.pose_sigma, frame.frame_sigma, frame.scale)
    covariance = frame.base_covariance
    if covariance is not None:
        least = np.linalg.eigvalsh(covariance)[0]
        _require(
            covariance.shape == (6, 6) and least > -1e-9,
            "base_covariance is a covariance (6, 6)",
        )
    correction = frame.correction
    if correction is not None:
        shape = (len(correction.poses), 6)
        _require(correction.correction.shape == shape, f"correction is {shape}")
        _require_finite("correction", correction.correction, correction.radius)


def _require_finite(name: str, *values: Any) -> None:
    for part in values:
        finite = np.isfinite(part)
        _require(finite.all(), f"{name}: numbers are finite")


def _require(holds: object, what: str) -> None:
    if not holds:
        raise ValueError(what)
