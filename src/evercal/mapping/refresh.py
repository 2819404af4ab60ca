"""`refreshed`: a scene's map after the room has changed.

New images were located in the map. Landmarks that they should show and do not show are removed.
Keyframes that lost most landmarks leave, and new ones take their place, so the memory stays the
same. Keyframes that remain keep their poses: they tie the map to what did not move.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np

from evercal.features.encoder import Encoder
from evercal.geometry import SE3, average_poses
from evercal.mapping.bundle_adjustment import BundleAdjustment
from evercal.mapping.bundle_options import BundleOptions
from evercal.mapping.keyframes import Keyframes, jpeg
from evercal.mapping.landmarks import project_surface
from evercal.mapping.patches import cut_patches, to_level
from evercal.mapping.pose_check import scale_of_depths
from evercal.mapping.prepared_frames import PYRAMID_LEVELS, PreparedFrames, WorkingSize
from evercal.mapping.scene_map import SceneMap
from evercal.mapping.selection import PoseSpace, select_farthest
from evercal.mapping.tracks import (
    REACH_PX,
    WIDE_STEPS,
    KeyframeTracks,
    bundle_tracks,
    observe,
    open_keyframe,
    refine_depths,
)
from evercal.processes import cores
from evercal.progress import OnProgress
from evercal.recordings.frame import Frame
from evercal.typing import Array, BoolArray


@dataclass(frozen=True)
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


@dataclass(frozen=True, eq=False)
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
    n = len(old)
    frames = [*old.frames(), *located]
    prepared = PreparedFrames(frames, encoder, size)
    prepared.depth_scale = scale_of_depths(
        1 / np.concatenate([k.inverse_depth for k in old.landmarks])
    )
    tracks = [_reopened(prepared, old, i) for i in range(n)]
    new = range(n, len(frames))
    states = []
    for i, keyframe in enumerate(tracks):
        states.append(_survival(prepared, keyframe, new, options))
        on_progress("comparing", i + 1, n)
    shares = np.array([state.share(options.least_checked) for state in states])
    kept, added = _selected(prepared.stated, n, shares, options)
    rivals = _nearest(prepared.stated, kept, [i for i in new if i not in added])
    numbers = sorted({*added, *rivals.values()})
    opened = {k.frame: k for k in _opened(prepared, numbers, on_progress)}
    for i, rival in rivals.items():
        alive = int(states[i].alive.sum())
        if rival in opened and opened[rival].confirmed.sum() > options.richer * alive:
            kept.remove(i)
            added.append(rival)
    chosen = [opened[i] for i in sorted(set(added)) if i in opened]
    _adjust(prepared, tracks, chosen, n, options)
    keyframes = _joined(prepared, old, [states[i].alive for i in kept], kept, chosen)
    return Refreshed(
        scene=replace(scene, keyframes=keyframes),
        checked=sum(int(state.checked.sum()) for state in states),
        gone=sum(int((~state.alive).sum()) for state in states),
        left=n - len(kept),
        added=len(chosen),
    )


@dataclass(frozen=True, eq=False)
class _Survival:
    """The landmarks of a keyframe after new images were compared."""

    checked: BoolArray
    """(n,) landmarks that enough images should show."""
    alive: BoolArray
    """(n,) landmarks that were found, or could not be checked."""

    def share(self, least: int) -> float:
        """Share of the checked landmarks that are alive; 1 for fewer than `least`."""
        count = int(self.checked.sum())
        return 1.0 if count < least else float(self.alive[self.checked].mean())


def _reopened(prepared: PreparedFrames, old: Keyframes, i: int) -> KeyframeTracks:
    landmarks = old.landmarks[i]
    pyramid = prepared.pyramid(i)
    return KeyframeTracks(
        frame=i,
        landmarks=landmarks,
        cell_inverse_depth=old.inverse_depth[i].astype(np.float64),
        patches=tuple(
            cut_patches(pyramid[level], to_level(landmarks.pixels, level))
            for level in range(PYRAMID_LEVELS)
        ),
        sources=(),
        confirmed=np.ones(len(landmarks), bool),
    )


def _survival(
    prepared: PreparedFrames,
    keyframe: KeyframeTracks,
    new: range,
    options: RefreshOptions,
) -> _Survival:
    """Look for the landmarks of a keyframe in new images."""
    n = len(keyframe.landmarks)
    every = np.arange(len(keyframe.landmarks))
    expected = np.zeros(n, int)
    found = np.zeros(n, int)
    surface = keyframe.landmarks.surface(prepared.cameras[keyframe.frame])
    points = surface[0]
    least = np.cos(np.deg2rad(options.similar_deg))
    for j in new:
        rotation, translation = prepared.relative(j, keyframe.frame)
        seen = project_surface(
            surface, rotation, translation, prepared.cameras[j]
        ).landmark
        # The camera of image j in the frame of the keyframe's camera.
        centre = -rotation.T @ translation
        rays = points[seen] - centre
        lengths = np.linalg.norm(rays, axis=1) * np.linalg.norm(points[seen], axis=1)
        similar = seen[(rays * points[seen]).sum(1) > least * lengths]
        if not len(similar):
            continue
        expected[similar] += 1
        observed = observe(prepared, keyframe, j, every[similar], WIDE_STEPS, REACH_PX)
        found[observed.landmark] += 1
    checked = (expected >= options.looks) | (found > 0)
    return _Survival(checked, ~checked | (found > 0))


def _selected(
    poses: SE3, n: int, shares: Array, options: RefreshOptions
) -> tuple[list[int], list[int]]:
    """Return the old keyframes that stay and the new images that become keyframes."""
    kept = np.flatnonzero(shares >= options.least_surviving)
    new = np.arange(n, len(poses))
    space = PoseSpace.of(poses.translation_m, poses.rotation_wxyz)
    if len(kept) > 1:
        between = np.stack([space.distances(int(i), kept) for i in kept])
        step = float(np.median(np.where(between > 0, between, np.inf).min(1)))
        gap = (
            np.stack([space.distances(int(i), kept).min() for i in new])
            if len(new)
            else new
        )
        most = int(options.most_novel * n)
        room = min(int((gap > options.novel * step).sum()), most) - (n - len(kept))
        if room > 0:
            rows = select_farthest(
                poses.translation_m[kept], poses.rotation_wxyz[kept], len(kept) - room
            )
            kept = kept[rows]
    count = min(n, len(kept) + len(new))
    pool = np.concatenate([kept, new])
    chosen = select_farthest(
        poses.translation_m[pool],
        poses.rotation_wxyz[pool],
        count,
        start=range(len(kept)),
    )
    return kept.tolist(), [int(pool[i]) for i in chosen if i >= len(kept)]


def _nearest(poses: SE3, kept: Sequence[int], new: Sequence[int]) -> dict[int, int]:
    """Return for each kept keyframe the new image next to it, each image at most once.

    Images farther away than the usual step between keyframes replace none.
    """
    space = PoseSpace.of(poses.translation_m, poses.rotation_wxyz)
    if len(kept) < 2 or not new:
        return {}
    rows = np.array(kept)
    columns = np.array(new)
    between = np.stack([space.distances(int(i), rows) for i in kept])
    step = np.median(np.where(between > 0, between, np.inf).min(1))
    gaps = np.stack([space.distances(int(i), columns) for i in kept])
    found: dict[int, int] = {}
    for flat in np.argsort(gaps, axis=None):
        a, b = divmod(int(flat), len(new))
        if gaps[a, b] > step:
            break
        if kept[a] not in found and new[b] not in found.values():
            found[kept[a]] = new[b]
    return found


def _opened(
    prepared: PreparedFrames, numbers: Sequence[int], on_progress: OnProgress
) -> list[KeyframeTracks]:
    def open_one(frame: int) -> KeyframeTracks:
        keyframe = open_keyframe(prepared, frame)
        refine_depths(prepared, keyframe)
        return keyframe

    opened = []
    with ThreadPoolExecutor(cores()) as pool:
        for keyframe in pool.map(open_one, numbers):
            opened.append(keyframe)
            on_progress("mapping", len(opened), len(numbers))
    return [keyframe for keyframe in opened if keyframe.confirmed.any()]


def _adjust(
    prepared: PreparedFrames,
    tracks: list[KeyframeTracks],
    opened: list[KeyframeTracks],
    n: int,
    options: RefreshOptions,
) -> None:
    """Adjust the poses of the new images together, without moving the n old keyframes."""
    keyframes = [*(k for k in tracks if len(k.landmarks)), *opened]
    if not opened:
        return
    observed = bundle_tracks(prepared, keyframes)
    problem = BundleAdjustment(
        prepared.stated,
        list(prepared.cameras),
        np.zeros((len(prepared), 6)),
        options.bundle,
    )
    poses = problem.solve(observed).poses
    # The old keyframes define the frame: undo their mean motion.
    shift = _mean_motion(prepared.stated[:n], poses[:n])
    poses = shift @ poses
    fixed = SE3.stack([*prepared.stated[:n], *poses[n:]])
    prepared.adjust(fixed, None)
    for keyframe in opened:
        refine_depths(prepared, keyframe, again=True)


def _mean_motion(before: SE3, after: SE3) -> SE3:
    """Return the rigid motion that moves poses (n,) back, robustly."""
    return average_poses(before @ after.inverse())


def _joined(
    prepared: PreparedFrames,
    old: Keyframes,
    alive: Sequence[BoolArray],
    kept: Sequence[int],
    opened: Sequence[KeyframeTracks],
) -> Keyframes:
    """Return kept keyframes without what is gone, and the new ones."""
    vlad = prepared.encoder.vlad()
    numbers = [keyframe.frame for keyframe in opened]
    stay = old.take(np.array(kept, np.int64))
    assert stay.descriptors is not None, "a map has descriptors"
    rows = [vlad(prepared.features(i)).astype(np.float16) for i in numbers]
    poses = [*stay.base_from_camera, *(prepared.poses[i] for i in numbers)]
    return Keyframes(
        images=(*stay.images, *(jpeg(prepared.grey[i]) for i in numbers)),
        cameras=(*stay.cameras, *(prepared.cameras[i] for i in numbers)),
        base_from_camera=SE3.stack(poses),
        inverse_depth=(
            *stay.inverse_depth,
            *(k.cell_inverse_depth.astype(np.float16) for k in opened),
        ),
        landmarks=(
            *(marks.take(np.flatnonzero(mask))
              for marks, mask in zip(stay.landmarks, alive, strict=True)),
            *(k.landmarks.take(np.flatnonzero(k.confirmed)) for k in opened),
        ),
        descriptors=np.concatenate([stay.descriptors, *(row[None] for row in rows)]),
    )  # fmt: skip
