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
    _require_finite("unit", scene.unit or 1.0, scene.intrinsics_sigma)
    descriptors = keyframes.descriptors
    assert descriptors is not None, "a map has descriptors"
    _require_finite("descriptors", descriptors)
    _require_frame(scene.frame)
    _require(scene.train_frames >= 0 and scene.landmarks > 0, "a scene has landmarks")
    counts = {len(keyframes.cameras), len(descriptors)}
    for name in ("images", "base_from_camera", "inverse_depth", "landmarks"):
        counts.add(len(getattr(keyframes, name)))
    _require(len(counts) == 1, f"parts of {counts} keyframes")
    for i in range(len(keyframes)):
        _require_keyframe(keyframes, i)


def require_of_encoder(scene: SceneMap, encoder: Encoder, short_side: int) -> None:
    """Raise ValueError for a scene that another encoder has made."""
    keyframes = scene.keyframes
    if encoder.centroids is not None and keyframes.descriptors is not None:
        width = min(encoder.centroids.size, WIDTH)
        shape = keyframes.descriptors.shape
        _require(shape[1:] == (width,), f"descriptors {shape} of width {width}")
    for i, camera in enumerate(keyframes.cameras):
        small = camera.short_side_resized(short_side)
        cells = small.width // encoder.stride * (small.height // encoder.stride)
        count = len(keyframes.inverse_depth[i])
        _require(count == cells, f"keyframe {i}: {count} depths of {cells} cells")


def _require_keyframe(keyframes: Keyframes, i: int) -> None:
    camera = keyframes.cameras[i]
    size = (camera.width, camera.height)
    require_image_size(*size, f"keyframe {i}")
    stated = size_in_header(np.frombuffer(keyframes.images[i], np.uint8))
    _require(stated == size, f"keyframe {i}: {stated} pixels, its camera {size}")
    _require(max(size) <= bounds().map_side, f"keyframe {i}: {size} pixels")
    marks = keyframes.landmarks[i]
    inside = (marks.pixels >= 0) & (marks.pixels < size)
    positive = np.minimum(marks.inverse_depth, marks.sigma) > 0
    _require(inside.all() and positive.all(), f"keyframe {i}: landmarks out of range")
    _require_finite("landmarks", marks.inverse_depth, marks.sigma, marks.slope)


def _require_frame(frame: MapFrame) -> None:
    _require(frame.scale > 0, "the scale is positive")
    _require_finite("frame", frame.pose_sigma, frame.frame_sigma, frame.scale)
    covariance = frame.base_covariance
    if covariance is not None:
        least = np.linalg.eigvalsh(covariance)[0]
        is_covariance = covariance.shape == (6, 6) and least > -1e-9
        _require(is_covariance, "base_covariance is a covariance (6, 6)")
    correction = frame.correction
    if correction is not None:
        shape = (len(correction.poses), 6)
        _require(correction.correction.shape == shape, f"correction is {shape}")
        _require_finite("correction", correction.correction, correction.radius)


def _require_finite(name: str, *values: Any) -> None:
    finite = [np.isfinite(part).all() for part in values]
    _require(all(finite), f"{name}: numbers are finite")


def _require(holds: object, what: str) -> None:
    if not holds:
        raise ValueError(what)
