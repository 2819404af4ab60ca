"""A map of sparse features and the localizer that answers from it: what the peers have in common.

Features of every training frame, mutual nearest neighbours in frames that look alike from
elsewhere, points triangulated with the stated poses, and for a query PoseLib's LO-RANSAC over its
mutual nearest neighbours in the most alike training frames. What looks alike is told by evercal's
own global descriptor, the same for every peer; where no more frames are kept than are matched
anyway, all are matched and none is looked up. Frames and queries go through the same code.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from benchmarks.peer_features import Detector, Features, detect, mutual_matches
from benchmarks.peer_triangulation import Tracks, TriangulationOptions, triangulate
from evercal.continual.networks.descriptor import encode, load_descriptor
from evercal.evaluation.metrics import Status
from evercal.features.encoder import load_encoder
from evercal.features.views import ViewOptions, plain_view
from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3
from evercal.localization.pnp import PnpOptions, solve_pnp
from evercal.recordings.frame import Frame, Recording, stated_poses

Progress = Callable[[str, Sequence[Frame] | Sequence[int]], Iterable]
"""Wraps what is gone through in a progress bar of a title."""


@dataclass(frozen=True)
class QueryOptions:
    """How a query is answered."""

    retrieved: int = 10
    """The most alike training frames that it is matched to."""
    pnp: PnpOptions = field(default_factory=lambda: PnpOptions(4.0, 10_000, 1000))
    """RANSAC settings; with ten times the iterations of evercal, for matches are fewer."""


@dataclass(frozen=True, eq=False)
class Described:
    """All training frames of a scene as one peer sees them."""

    features: list[Features]
    """By frame."""
    places: np.ndarray
    """(n, 128) float16 global descriptors."""
    poses: SE3
    """(n,) stated base_from_camera."""
    seconds: float
    """Time it took, decoding included."""


@dataclass(frozen=True, eq=False)
class KeptFrame:
    """What stays of a training frame: the features that have a point."""

    descriptors: np.ndarray
    """(n, d) uint8 or float16."""
    points_m: np.ndarray
    """(n, 3) float32 in the base frame."""


@dataclass(frozen=True, eq=False)
class PeerMap:
    """What a peer answers from; images are not needed any more."""

    frames: list[KeptFrame]
    """Those kept."""
    places: np.ndarray | None
    """(n, 128) float16 global descriptors of them; None where every frame is matched."""
    seconds: float
    """Time to build it, from encoded images."""

    @property
    def bytes(self) -> int:
        """Descriptors and points, and global descriptors where they are looked at."""
        kept = sum(frame.descriptors.nbytes + frame.points_m.nbytes for frame in self.frames)
        return kept + (0 if self.places is None else self.places.nbytes)


@dataclass(frozen=True, eq=False)
class PeerEstimate:
    """A peer's answer, as `evercal.evaluation.evaluate` reads it."""

    status: Status
    """`ok` or `failed`: a peer does not know when it is wrong."""
    scene: str | None
    """The only scene there is; None without a pose."""
    base_from_camera: SE3 | None
    """Metres."""
    inliers: int
    """Matches that agree with the pose."""
    inlier_ratio: float
    """As a share of all matches."""


class Place:
    """evercal's global descriptor of an image, at the working size it was trained for."""

    def __init__(self) -> None:
        self.encoder, self.descriptor = load_encoder(), load_descriptor()

    def __call__(self, image: np.ndarray, camera: Camera) -> np.ndarray:
        """(128,) float16 unit vector of an (h, w, 3) uint8 RGB image."""
        view = plain_view(image, camera, self.encoder.stride, ViewOptions())
        _, (found,) = encode([view], self.encoder, self.descriptor)
        return found.numpy().astype(np.float16)


def describe(
    frames: Sequence[Frame], detector: Detector, short_side: int, place: Place, bar: Progress
) -> Described:
    """Features and global descriptors of posed training frames."""
    began = time.perf_counter()
    features, places = [], []
    for frame in bar("features", frames):
        image = frame.read_image()
        features.append(detect(image, frame.camera, detector, short_side))
        places.append(place(image, frame.camera))
    poses = stated_poses(frames)
    return Described(features, np.stack(places), poses, time.perf_counter() - began)


def build(
    described: Described,
    kept: np.ndarray,
    options: TriangulationOptions,
    retrieved: int,
    bar: Progress,
) -> PeerMap:
    """Triangulates the features of the kept frames among all training frames.

    Args:
        described: all training frames.
        kept: (k,) indices of those that stay in the map; their partners may be others, which are
            matched to them and then dropped.
        options: of the triangulation.
        retrieved: training frames that a query will be matched to.
        bar: shows progress.
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
        descriptors = described.features[i].descriptors[good]
        frames.append(KeptFrame(descriptors, points[good].astype(np.float32)))
    places = described.places[kept] if len(kept) > retrieved else None
    return PeerMap(frames, places, described.seconds + time.perf_counter() - began)


def _partners(described: Described, frame: int, options: TriangulationOptions) -> list[int]:
    """The frames most alike to a frame that stand apart from it and from one another."""
    places = described.places.astype(np.float32)
    free = np.linalg.norm(
        described.poses.translation_m - described.poses.translation_m[frame], axis=1
    )
    free = free >= options.baseline_m
    found: list[int] = []
    for other in np.argsort(-(places @ places[frame]), kind="stable").tolist():
        if len(found) == options.partners:
            break
        if free[other]:
            found.append(other)
            way = described.poses.translation_m - described.poses.translation_m[other]
            free &= np.linalg.norm(way, axis=1) >= options.baseline_m
    return found


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
    intrinsics = np.stack([described.features[view].intrinsics for view in views])
    return Tracks(pixels, intrinsics, described.poses[np.array(views)])


class PeerLocalizer:
    """Answers queries from the map of one scene.

    Args:
        scene: whose map it is; only its name is used.
        built: the map.
        detector: the one that the map was made with.
        short_side: of images, pixels, as for the map.
        place: tells which frames look alike.
        options: how.
    """

    def __init__(
        self,
        scene: Recording,
        built: PeerMap,
        detector: Detector,
        short_side: int,
        place: Place,
        options: QueryOptions,
    ):
        self.scenes = (scene.name,)
        self._map, self._detector, self._short_side = built, detector, short_side
        self._place, self._options = place, options

    def localize(self, image: np.ndarray, camera: Camera, /) -> PeerEstimate:
        """Camera pose of one (h, w, 3) uint8 RGB image."""
        features = detect(image, camera, self._detector, self._short_side)
        pixels, points = [np.zeros((0, 2))], [np.zeros((0, 3))]
        for frame in self._alike(image, camera):
            here, there = mutual_matches(features.descriptors, frame.descriptors)
            pixels.append(features.pixels[here])
            points.append(frame.points_m[there].astype(float))
        matched = np.concatenate(pixels)
        found = None
        if len(matched) >= 6:
            lens, ransac = features.intrinsics, self._options.pnp
            found = solve_pnp(matched, np.concatenate(points), lens, ransac)
        if found is None:
            return PeerEstimate("failed", None, None, 0, 0.0)
        inliers = int(found.inliers.sum())
        share = inliers / len(matched)
        return PeerEstimate("ok", self.scenes[0], found.world_from_camera, inliers, share)

    def _alike(self, image: np.ndarray, camera: Camera) -> list[KeptFrame]:
        if self._map.places is None:
            return self._map.frames
        likeness = self._map.places.astype(np.float32) @ self._place(image, camera)
        order = np.argsort(-likeness, kind="stable")[: self._options.retrieved]
        return [self._map.frames[i] for i in order]
