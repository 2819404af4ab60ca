"""`refreshed`: a scene's map after the room has changed.

New images were located in the map. Landmarks that they should show and do not show are removed.
Keyframes that lost most landmarks leave, and new ones take their place, so the memory stays the
same. Keyframes that remain keep their poses: they tie the map to what did not move.
"""

from collections.abc import Iterable, Sequence
from dataclasses import field, replace

import numpy as np

from evercal.classes import frozen, frozen_arrays
from evercal.errors import require_numbers
from evercal.features.encoder import Encoder
from evercal.geometry import SE3, average_poses, norms
from evercal.mapping.bundle_adjustment import BundleAdjustment
from evercal.mapping.bundle_options import BundleOptions
from evercal.mapping.bundle_tracks import bundle_tracks
from evercal.mapping.keyframes import Keyframes
from evercal.mapping.landmarks import project_surface
from evercal.mapping.pose_check import scale_of_depths
from evercal.mapping.prepared_frames import PreparedFrames, WorkingSize
from evercal.mapping.scene_map import SceneMap
from evercal.mapping.selection import PoseSpace, select_farthest
from evercal.mapping.stated_errors import StatedErrors
from evercal.mapping.tracks import (
    REACH_PX,
    WIDE_STEPS,
    KeyframeTracks,
    observe,
    opened_keyframes,
    refine_depths,
    template_patches,
    tracked_keyframes,
)
from evercal.progress import OnProgress
from evercal.recordings.frame import Frame
from evercal.typing import Array, BoolArray, IntArray


@frozen
class RefreshOptions:
    """Options of a refresh."""

    most_frames: int = 60
    """Located images that are used, spread over their poses."""
    looks: int = 3
    """Images that should show a landmark and do not, before it is removed."""
    similar_deg: float = 25.0
    """Largest angle between the views of a landmark by its keyframe and by such an image."""
    least_checked: int = 20
    """Checked landmarks of a keyframe, at least, to judge it."""
    least_surviving: float = 0.6
    """A keyframe with a smaller share of surviving landmarks leaves."""
    richer: float = 1.25
    """A keyframe is replaced if the nearest new image has this many times more landmarks."""
    novel: float = 1.5
    """Distance, in median keyframe spacings, beyond which an image counts as unexplored."""
    most_novel: float = 0.25
    """Share of the keyframes that leave for new ground in one refresh, at most."""
    bundle: BundleOptions = field(
        default_factory=lambda: BundleOptions(intrinsics=False)
    )
    """Adjustment of the new images' poses."""

    def __post_init__(self) -> None:
        """Refuse numbers outside their range.

        Raises:
            InputError: A count below 1, a negative number or a share above 1.
        """
        require_numbers(self, ("most_frames", "looks", "least_checked"), 1)
        require_numbers(self, ("similar_deg", "richer", "novel"), 0)
        require_numbers(self, ("least_surviving", "most_novel"), 0, 1)


@frozen_arrays
class Refreshed:
    """A refreshed scene and what changed."""

    scene: SceneMap
    checked: int
    """Landmarks that new images should show."""
    gone: int
    """Of these, landmarks that were removed."""
    left: int
    """Keyframes that left."""
    added: int
    """New keyframes."""


def refreshed(
    scene: SceneMap,
    located: Sequence[Frame],
    encoder: Encoder,
    size: WorkingSize,
    options: RefreshOptions | None = None,
    on_progress: OnProgress = lambda *_: None,
) -> Refreshed:
    """Refresh the map of a scene.

    Args:
        scene: The map.
        located: New images with poses in the frame of the scene's keyframes.
        encoder: Encoder of the map.
        size: Working sizes.
        options: Thresholds.
        on_progress: Called with the step, how much of it is done, and its total.
    """
    options = options or RefreshOptions()
    old = scene.keyframes
    count = len(old)
    # Frames are numbered alike everywhere: the old keyframes first, then the new images.
    prepared = PreparedFrames([*old.frames(), *located], encoder, size)
    inverse_depth = np.concatenate([marks.inverse_depth for marks in old.landmarks])
    prepared.depth_scale = scale_of_depths(1 / inverse_depth)
    tracks = [_reopened(prepared, old, i) for i in range(count)]
    images = range(count, len(prepared))
    survivals = []
    for keyframe in tracks:
        survivals.append(_survival(prepared, keyframe, images, options))
        on_progress("comparing", len(survivals), count)
    shares = np.array([survival.share(options) for survival in survivals])
    kept, added = _selected(prepared.stated, shares, options)
    rivals = _nearest(prepared.stated, kept, [i for i in images if i not in added])
    opened = {}
    candidates = sorted({*added, *rivals.values()})
    for keyframe in opened_keyframes(prepared, candidates, on_progress):
        if keyframe.confirmed.any():
            opened[keyframe.frame] = keyframe
    for i, rival in rivals.items():
        least = options.richer * int(survivals[i].alive.sum())
        if rival in opened and opened[rival].confirmed.sum() > least:
            kept.remove(i)
            added.append(rival)
    chosen = [opened[i] for i in sorted(set(added)) if i in opened]
    if chosen:
        _adjust(prepared, tracks, chosen, options)
    remaining = _without_gone(old, kept, survivals)
    if chosen:
        remaining = remaining.joined(tracked_keyframes(prepared, chosen))
    return Refreshed(
        scene=replace(scene, keyframes=remaining),
        checked=sum(int(survival.checked.sum()) for survival in survivals),
        gone=sum(int((~survival.alive).sum()) for survival in survivals),
        left=count - len(kept),
        added=len(chosen),
    )


@frozen_arrays
class _Survival:
    """The landmarks of a keyframe after new images were compared."""

    checked: BoolArray
    """(n,) landmarks that enough images should show."""
    alive: BoolArray
    """(n,) landmarks that were found, or could not be checked."""

    def share(self, options: RefreshOptions) -> float:
        """Share of the checked landmarks that are alive; 1 for fewer than `least_checked`."""
        if int(self.checked.sum()) < options.least_checked:
            return 1.0
        return float(self.alive[self.checked].mean())


def _reopened(
    prepared: PreparedFrames,
    old: Keyframes,
    i: int,
) -> KeyframeTracks:
    landmarks = old.landmarks[i]
    return KeyframeTracks(
        frame=i,
        landmarks=landmarks,
        cell_inverse_depth=old.inverse_depth[i].astype(float),
        patches=template_patches(prepared, i, landmarks.pixels),
        sources=(),
        confirmed=np.ones(len(landmarks), bool),
    )


def _survival(
    prepared: PreparedFrames,
    keyframe: KeyframeTracks,
    images: range,
    options: RefreshOptions,
) -> _Survival:
    """Search for the landmarks of a keyframe in new images."""
    expected = np.zeros(len(keyframe.landmarks), int)
    observed = np.zeros(len(keyframe.landmarks), int)
    surface = keyframe.landmarks.surface(prepared.cameras[keyframe.frame])
    least = np.cos(np.deg2rad(options.similar_deg))
    for j in images:
        rotation, translation = prepared.relative(j, keyframe.frame)
        camera = prepared.cameras[j]
        visible = project_surface(surface, rotation, translation, camera).landmark
        points = surface[0, visible]
        # The camera of image j in the frame of the keyframe's camera.
        centre = -rotation.T @ translation
        rays = points - centre
        lengths = norms(rays) * norms(points)
        similar = visible[(rays * points).sum(1) > least * lengths]
        if len(similar):
            expected[similar] += 1
            found = observe(
                prepared,
                keyframe,
                j,
                similar,
                WIDE_STEPS,
                REACH_PX,
            )
            observed[found.landmark] += 1
    checked = (expected >= options.looks) | (observed > 0)
    return _Survival(checked, ~checked | (observed > 0))


def _selected(
    poses: SE3,
    shares: Array,
    options: RefreshOptions,
) -> tuple[list[int], list[int]]:
    """Return the old keyframes that stay and the new images that become keyframes.

    Poses are those of all frames; shares are those of the old keyframes.
    """
    count = len(shares)
    kept = np.flatnonzero(shares >= options.least_surviving)
    images = np.arange(count, len(poses))
    if len(kept) > 1:
        space = PoseSpace.of(poses.translation_m, poses.rotation_wxyz)
        gaps = _distances(space, images, kept).min(1)
        unexplored = int((gaps > options.novel * _spacing(space, kept)).sum())
        most = int(options.most_novel * count)
        surplus = min(unexplored, most) - (count - len(kept))
        if surplus > 0:
            spread = select_farthest(
                poses.translation_m[kept],
                poses.rotation_wxyz[kept],
                len(kept) - surplus,
            )
            kept = kept[spread]
    pool = np.concatenate([kept, images])
    chosen = select_farthest(
        poses.translation_m[pool],
        poses.rotation_wxyz[pool],
        min(count, len(pool)),
        start=range(len(kept)),
    )
    return kept.tolist(), pool[chosen[chosen >= len(kept)]].tolist()


def _nearest(
    poses: SE3,
    kept: list[int],
    images: list[int],
) -> dict[int, int]:
    """Return for each kept keyframe the new image next to it, each image at most once.

    Images farther away than the usual step between keyframes replace none.
    """
    nearest: dict[int, int] = {}
    if len(kept) < 2 or not images:
        return nearest
    space = PoseSpace.of(poses.translation_m, poses.rotation_wxyz)
    step = _spacing(space, np.array(kept))
    gaps = _distances(space, kept, np.array(images))
    for pair in np.argsort(gaps, axis=None):
        row, column = divmod(int(pair), len(images))
        if gaps[row, column] > step:
            break
        if kept[row] not in nearest and images[column] not in nearest.values():
            nearest[kept[row]] = images[column]
    return nearest


def _distances(
    space: PoseSpace,
    rows: Iterable[int],
    columns: IntArray,
) -> Array:
    """(r, c) distances between frames."""
    distances = [space.distances(int(i), columns) for i in rows]
    return np.reshape(distances, (-1, len(columns)))


def _spacing(space: PoseSpace, keyframes: IntArray) -> float:
    """Median distance of keyframes from the next one."""
    between = _distances(space, keyframes, keyframes)
    return float(np.median(np.where(between > 0, between, np.inf).min(1)))


def _adjust(
    prepared: PreparedFrames,
    tracks: list[KeyframeTracks],
    opened: list[KeyframeTracks],
    options: RefreshOptions,
) -> None:
    """Adjust the poses of the new images together, without moving the old keyframes."""
    count = len(tracks)
    old = [keyframe for keyframe in tracks if len(keyframe.landmarks)]
    observed = bundle_tracks(prepared, [*old, *opened])
    stated = prepared.stated
    still = StatedErrors(np.zeros((len(stated), 6)))
    cameras = list(prepared.cameras)
    problem = BundleAdjustment(stated, cameras, still, options.bundle)
    poses = problem.solve(observed).poses
    # The old keyframes define the frame: undo their mean motion.
    poses = average_poses(stated[:count] @ poses[:count].inverse()) @ poses
    prepared.adjust(SE3.stack([*stated[:count], *poses[count:]]), None)
    for keyframe in opened:
        refine_depths(prepared, keyframe, again=True)


def _without_gone(
    old: Keyframes,
    kept: list[int],
    survivals: list[_Survival],
) -> Keyframes:
    """The kept keyframes without the landmarks that are gone."""
    remaining = old.take(np.array(kept, np.int64))
    landmarks = []
    for i, marks in zip(kept, remaining.landmarks, strict=True):
        landmarks.append(marks.take(np.flatnonzero(survivals[i].alive)))
    return replace(remaining, landmarks=tuple(landmarks))
