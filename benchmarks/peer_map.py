"""Map and localizer from sparse features, shared by all peers.

Features of training frames are matched to similar frames from other positions and triangulated with
the stated poses. A query is matched to the most similar training frames; its pose is PoseLib's
LO-RANSAC. Similarity is that of evercal's global descriptor. If the map has few frames, all of them
are matched.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from benchmarks.peer_features import Detector, Features, detect, mutual_matches
from benchmarks.peer_triangulation import Tracks, TriangulationOptions, triangulate
from evercal.continual.networks.descriptor import encode, load_descriptor
from evercal.features.encoder import load_encoder
from evercal.features.views import ViewOptions, plain_view
from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3
from evercal.localization.estimate import PoseEstimate
from evercal.localization.pnp import PnpOptions, solve_pnp
from evercal.recordings.frame import Frame, Recording, stated_poses

Progress = Callable[[str, Sequence[Frame] | Sequence[int]], Iterable]
"""Wraps an iterable in a progress bar with a title."""


@dataclass(frozen=True)
class QueryOptions:
    """Options of localization."""

    retrieved: int = 10
    """Training frames that a query is matched to."""
    pnp: PnpOptions = field(default_factory=lambda: PnpOptions(4.0, 10_000, 1000))
    """RANSAC options, with ten times the iterations of evercal since there are fewer matches."""


@dataclass(frozen=True, eq=False)
class Described:
    """Features of all training frames of a scene."""

    features: list[Features]
    """Features of each frame."""
    descriptors: np.ndarray
    """Global descriptors, float16, shape (n, 128)."""
    poses: SE3
    """Stated base_from_camera, shape (n,)."""
    seconds: float
    """Time, decoding included."""


@dataclass(frozen=True, eq=False)
class KeptFrame:
    """The triangulated features of a training frame."""

    descriptors: np.ndarray
    """uint8 or float16, shape (n, d)."""
    points_m: np.ndarray
    """Points in the base frame, float32, shape (n, 3)."""


@dataclass(frozen=True, eq=False)
class PeerMap:
    """The map of a peer."""

    frames: list[KeptFrame]
    """Frames of the map."""
    descriptors: np.ndarray | None
    """Their global descriptors, float16, shape (n, 128); None if every frame is matched."""
    seconds: float
    """Time to build the map, decoding included."""

    @property
    def bytes(self) -> int:
        """Size of descriptors, points, and global descriptors if they are used."""
        features = sum(frame.descriptors.nbytes + frame.points_m.nbytes for frame in self.frames)
        return features + (0 if self.descriptors is None else self.descriptors.nbytes)


class GlobalDescriber:
    """evercal's global descriptor of an image."""

    def __init__(self) -> None:
        self.encoder, self.descriptor = load_encoder(), load_descriptor()

    def __call__(self, image: np.ndarray, camera: Camera) -> np.ndarray:
        """Describe an RGB image, uint8 (h, w, 3), by a unit vector, float16 (128,)."""
        view = plain_view(image, camera, self.encoder.stride, ViewOptions())
        _, (descriptor,) = encode([view], self.encoder, self.descriptor)
        return descriptor.numpy().astype(np.float16)


def describe(
    frames: Sequence[Frame],
    detector: Detector,
    short_side: int,
    describer: GlobalDescriber,
    bar: Progress,
) -> Described:
    """Detect features and compute global descriptors of posed training frames."""
    began = time.perf_counter()
    features, descriptors = [], []
    for frame in bar("features", frames):
        image = frame.read_image()
        features.append(detect(image, frame.camera, detector, short_side))
        descriptors.append(describer(image, frame.camera))
    poses = stated_poses(frames)
    return Described(features, np.stack(descriptors), poses, time.perf_counter() - began)


def build(
    described: Described,
    kept: np.ndarray,
    options: TriangulationOptions,
    retrieved: int,
    bar: Progress,
) -> PeerMap:
    """Triangulate the features of the kept frames among all training frames.

    Args:
        described: All training frames.
        kept: Indices of the frames of the map, shape (k,). Their partners may be other frames.
        options: Options of triangulation.
        retrieved: Training frames that a query will be matched to.
        bar: Progress bar.
    """
    began = time.perf_counter()
    matches: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}
    frames = []
    for i in bar("points", kept.tolist()):
        partners = _partners(described, i, options)
        for j in partners:
            if (i, j) not in matches:
                here, there = mutual_matches(
                    described.features[i].descriptors, described.features[j].descriptors
                )
                matches[i, j], matches[j, i] = (here, there), (there, here)
        tracks = _tracks(described, i, partners, [matches[i, j] for j in partners])
        points = triangulate(tracks, options)
        good = np.isfinite(points).all(1)
        local = described.features[i].descriptors[good]
        frames.append(KeptFrame(local, points[good].astype(np.float32)))
    descriptors = described.descriptors[kept] if len(kept) > retrieved else None
    return PeerMap(frames, descriptors, described.seconds + time.perf_counter() - began)


def _partners(described: Described, frame: int, options: TriangulationOptions) -> list[int]:
    """Return the most similar frames that are apart from a frame and from each other."""
    descriptors, positions = described.descriptors.astype(np.float32), described.poses.translation_m
    free = np.linalg.norm(positions - positions[frame], axis=1) >= options.baseline_m
    partners: list[int] = []
    for other in np.argsort(-(descriptors @ descriptors[frame]), kind="stable").tolist():
        if len(partners) == options.partners:
            break
        if free[other]:
            partners.append(other)
            free &= np.linalg.norm(positions - positions[other], axis=1) >= options.baseline_m
    return partners


def _tracks(
    described: Described,
    frame: int,
    partners: list[int],
    matches: list[tuple[np.ndarray, np.ndarray]],
) -> Tracks:
    own = described.features[frame]
    pixels = np.full((1 + len(partners), len(own.pixels), 2), np.nan)
    pixels[0] = own.pixels
    for view, (partner, (here, there)) in enumerate(zip(partners, matches, strict=True), start=1):
        pixels[view, here] = described.features[partner].pixels[there]
    views = [frame, *partners]
    intrinsics = np.stack([_intrinsics(described.features[view].camera) for view in views])
    return Tracks(pixels, intrinsics, described.poses[np.array(views)])


class PeerLocalizer:
    """Localizes images in the map of one scene.

    Args:
        scene: Recording of the scene; only its name is used.
        built: Map of the scene.
        detector: Feature detector of the map.
        short_side: Short side of images for the map, pixels.
        describer: Global descriptor of the map.
        options: Options of localization.
    """

    def __init__(
        self,
        scene: Recording,
        built: PeerMap,
        detector: Detector,
        short_side: int,
        describer: GlobalDescriber,
        options: QueryOptions,
    ):
        self.scenes = (scene.name,)
        self._map, self._detector, self._short_side = built, detector, short_side
        self._describer, self._options = describer, options

    def camera_for(self, stated: Camera) -> Camera | None:
        """The stated intrinsics; peers do not adjust them."""
        return stated

    def localize(self, image: np.ndarray, camera: Camera | None = None) -> PoseEstimate:
        """Estimate the camera pose of one RGB image, uint8 (h, w, 3)."""
        assert camera is not None, "peers need intrinsics"
        features = detect(image, camera, self._detector, self._short_side)
        pixels, points = [np.zeros((0, 2))], [np.zeros((0, 3))]
        for frame in self._similar(image, camera):
            here, there = mutual_matches(features.descriptors, frame.descriptors)
            pixels.append(features.pixels[here])
            points.append(frame.points_m[there].astype(float))
        matched = np.concatenate(pixels)
        result = None
        if len(matched) >= 6:
            pnp = self._options.pnp
            result = solve_pnp(matched, np.concatenate(points), features.camera, pnp)
        if result is None:
            return PoseEstimate("failed", "too few matches", None, None, None, 0, 0.0, 0.0)
        inliers = int(result.inliers.sum())
        ratio = inliers / len(matched)
        pose = result.pose.pose
        return PoseEstimate("ok", "", self.scenes[0], pose, None, inliers, ratio, 0.0)

    def _similar(self, image: np.ndarray, camera: Camera) -> list[KeptFrame]:
        if self._map.descriptors is None:
            return self._map.frames
        similarity = self._map.descriptors.astype(np.float32) @ self._describer(image, camera)
        order = np.argsort(-similarity, kind="stable")[: self._options.retrieved]
        return [self._map.frames[i] for i in order]


def _intrinsics(camera: Camera) -> np.ndarray:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy])
