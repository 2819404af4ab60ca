"""Whether a stored scene is one: right checksums say only that a file is what somebody wrote."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from evercal.bounds import TooLargeError, bounds, require_image_size
from evercal.errors import InputError
from evercal.features.encoder import Encoder
from evercal.features.vlad import WIDTH
from evercal.geometry import Camera
from evercal.mapping.keyframes import Keyframes
from evercal.mapping.map_frame import MapFrame
from evercal.mapping.scene_map import SceneMap
from evercal.recordings.images import size_in_header
from evercal.typing import Record

_MOST = 1e6
"""Pixels, metres, or whatever a unit is."""


@contextmanager
def of_evercal(folder: Path) -> Iterator[None]:
    """Turn errors while the folder of a scene is read into an `InputError` that names it."""
    try:
        yield
    except TooLargeError as error:
        raise InputError(f"{folder}: {error}") from None
    except FileNotFoundError as error:
        raise InputError(f"{error.filename}: is missing; restore the map") from None
    except (InputError, OSError):
        raise
    except Exception as error:
        # Nothing is assumed about what another program has written.
        reason = " ".join(repr(error).split())[:200]
        raise InputError(
            f"{folder}: not a scene that evercal wrote ({reason})"
        ) from None


def require_consistent(scene: SceneMap) -> None:
    """Raise an error where the parts of a scene contradict each other."""
    keyframes = scene.keyframes
    for camera in (scene.camera, scene.adjusted_camera):
        require_image_size(*camera.size, "camera")
        _require_small("camera", camera.fx, camera.fy, camera.cx, camera.cy)
    _require_small("poses", keyframes.base_from_camera.translation_m)
    descriptors = keyframes.descriptors
    assert descriptors is not None, "a map has descriptors"
    _require_small("unit", scene.unit or 1.0, scene.intrinsics_sigma)
    _require_small("descriptors", descriptors)
    _require_frame(scene.frame)
    _require(scene.train_frames > 0, "a scene has training frames")
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
        depths = keyframes.inverse_depth[i]
        _require(
            len(depths) == rows * columns,
            f"keyframe {i}: {len(depths)} depths of {rows}x{columns} cells",
        )
        _require((depths > 0).any(), f"keyframe {i}: no depths")
        _require_small(f"keyframe {i}: depths", depths)


def require_landmarks(arrays: Record, cameras: Sequence[Camera]) -> None:
    """Raise ValueError for stored landmarks outside their images, or without depth.

    `arrays` are those of `Keyframes.to_tensors`.
    """
    counts = arrays["landmark_counts"][:]
    pixels = arrays["landmark_pixels"][:]
    depths = np.minimum(
        arrays["landmark_inverse_depth"][:], arrays["landmark_sigma"][:]
    )
    sides = [camera.size for camera in cameras]
    size = np.repeat(np.array(sides, np.int32), counts, axis=0)
    _require(len(pixels), "a scene has landmarks")
    inside = (pixels >= 0) & (pixels < size)
    _require(inside.all(), "landmarks lie in their images")
    _require((depths > 0).all(), "landmarks have depths")
    for name in ("inverse_depth", "sigma", "slope"):
        _require_small("landmarks", arrays[f"landmark_{name}"][:])


def _require_keyframe(keyframes: Keyframes, i: int) -> None:
    name = f"keyframe {i}"
    camera = keyframes.cameras[i]
    size = camera.size
    require_image_size(*size, name)
    most = bounds().map_side
    _require(max(size) <= most, f"{name}: {size} pixels, at most {most} a side")
    image = np.frombuffer(keyframes.images[i], np.uint8)
    stated = size_in_header(image)
    _require(stated == size, f"{name}: {stated} pixels, its camera {size}")


def _require_frame(frame: MapFrame) -> None:
    least = min(*frame.pose_sigma, *frame.frame_sigma)
    _require(frame.scale > 0 and least >= 0, "scale and sigma are positive")
    _require_small("frame", frame.common.translation_m)
    _require_small("frame", frame.pose_sigma, frame.frame_sigma, frame.scale)
    covariance = frame.base_covariance
    if covariance is not None:
        least = np.linalg.eigvalsh(covariance)[0]
        _require(
            covariance.shape == (6, 6) and least > -1e-9,
            "base_covariance is a covariance (6, 6)",
        )
    correction = frame.correction
    if correction:
        shape = (len(correction.poses), 6)
        _require(correction.correction.shape == shape, f"correction is {shape}")
        _require_small("correction", correction.correction, correction.radius)


def _require_small(name: str, *values: Any) -> None:
    """Raise ValueError for numbers that no room and no camera has."""
    for part in values:
        small = np.abs(np.asarray(part, np.float64)) < _MOST
        _require(small.all(), f"{name}: numbers are below {_MOST:g}")


def _require(holds: object, what: str) -> None:
    if not holds:
        raise ValueError(what)
