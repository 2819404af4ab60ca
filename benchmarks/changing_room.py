"""A rendered room that changes in rounds: a third of the small objects, lamps, light, furniture.

OUT/round-00 ... round-10       recordings: training frames of each round, and test frames
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from benchmarks.rows import save
from evercal.evaluation.metrics import share_inside
from evercal.features.encoder import Encoder, load_encoder
from evercal.geometry import pose_distance
from evercal.learning.stated_scatter import with_scatter
from evercal.localization.estimate import PoseEstimate
from evercal.localization.localizer import Localizer
from evercal.localization.refreshing import refresh_scene
from evercal.mapping.build import MapOptions, build_map
from evercal.mapping.memory_budget import MemoryBudget
from evercal.mapping.scene_map import MapContents, SceneMap
from evercal.recordings import Frame, Recording, generic, load_recording
from evercal.recordings.held_out import split_held_out
from evercal.recordings.images import write_jpeg
from evercal.recordings.samples import sample_rooms
from evercal.simulation.box_room import default_camera
from rooms.changed import moved_item, rearranged, relit
from rooms.panda import panda_meshes
from rooms.paths import sweep_shots
from rooms.renderer import Renderer, RenderOptions
from rooms.room import Room, room

FURNITURE_ROUND = 5
MOVABLE = ("armchair", "floor lamp", "side table", "chair", "stool")
"""Furniture that moves in that round."""


def states(kind: str, seed: int, rounds: int) -> list[Room]:
    """Return the room before the first and after every round of change."""
    arranged = room(kind, seed)
    result = [arranged]
    for number in range(1, rounds + 1):
        arranged = rearranged(arranged, number)
        if number == FURNITURE_ROUND:
            arranged = _refurnished(arranged, number)
        result.append(relit(arranged, number))
    return result


def _refurnished(before: Room, seed: int) -> Room:
    """Move furniture that carries nothing; what has no other place is removed."""
    rng = np.random.default_rng(seed)
    items = list(before.items)
    for item in [i for i in before.items if i.kind in MOVABLE and not i.tops]:
        rest = [other for other in items if other is not item]
        moved = moved_item(item, before, rest, rng)
        items = rest if moved is None else [*rest, moved]
    return replace(before, items=items)


@dataclass(frozen=True)
class Rendering:
    """A room, its changes, and how they are rendered."""

    kind: str = "bedroom"
    """Kind of room."""
    seed: int = 3101
    """Seed of the room."""
    rounds: int = 10
    """Rounds of change."""
    first: int = 60
    """Frames before the first change, 70 % of them for training."""
    frames: int = 24
    """Frames of each round, 70 % of them for training."""
    samples: int = 8
    """Light paths per pixel."""


def render(rendering: Rendering, out: Path = Path("runs/changing-room")) -> None:
    """Render the recordings into a folder; an interrupted run continues."""
    seed = rendering.seed
    camera = default_camera(320, 240)
    plans = []
    count = rendering.first
    for i, state in enumerate(states(rendering.kind, seed, rendering.rounds)):
        plans.append((state, sweep_shots(state, count, 20 + i)))
        count = rendering.frames
    with tqdm(total=sum(len(shots) for _, shots in plans), unit="frame") as bar:
        for number, (state, shots) in enumerate(plans):
            root = out / f"round-{number:02d}"
            renderer = None
            light = float(np.random.default_rng([seed, number, 3]).uniform(-0.7, 0.7))
            options = RenderOptions(
                samples=rendering.samples, exposure_ev=light if number else 0.0
            )
            done = []
            for i, shot in enumerate(shots):
                file = root / f"images/{i:06d}.jpg"
                if not file.exists():
                    arm = panda_meshes(shot.joints_rad)
                    if renderer is None:
                        renderer = Renderer(state.meshes() + arm)
                    renderer.move(arm)
                    origin = np.random.default_rng([seed, number, i])
                    noise = int(origin.integers(2**31))
                    image = renderer.render(
                        camera, shot.base_from_camera, options, noise
                    )
                    write_jpeg(file, image, 90)
                done.append(
                    (Frame(shot.name, file, camera, shot.base_from_camera), shot.split)
                )
                bar.update()
            if not (root / generic.FILE).exists():
                with generic.SceneWriter(root, f"round-{number:02d}") as writer:
                    for frame, split in done:
                        writer.add(frame, split)


VARIANTS: tuple[str, ...] = (
    "as learned",
    "refreshed",
    "refreshed, a fifth of the images wrong",
    "learned anew",
)


def run(
    data: tuple[Path, ...] = (Path("runs/changing-room"),),
    keyframes: int = 16,
    out: Path = Path("runs/refresh.csv"),
) -> None:
    """A map in a room that changes: as it was learned, refreshed after every change, learned anew.

    Refreshes get the training images of a round without poses; test frames are scored.

    Args:
        data: Recordings of `render`.
        keyframes: Keyframes of every map.
        out: File of the rows.
    """
    rows: list[dict[str, object]] = []
    for root in data:
        rows += _rounds(root, keyframes)
    save(out, rows, {"keyframes": keyframes})


def _rounds(root: Path, keyframes: int) -> list[dict[str, object]]:
    encoder = load_encoder()
    recordings = [load_recording(p) for p in sorted(root.iterdir())]
    wrong = [f.read_image() for f in sample_rooms()[1].scene.train[::8]]
    first = _learned(recordings[0], encoder, keyframes)
    scenes = dict.fromkeys(VARIANTS[:3], first)
    bounds = dict.fromkeys(VARIANTS, 0.0)
    rows = []
    for number, recording in enumerate(recordings):
        images = [(frame.name, frame.read_image()) for frame in recording.train]
        mixed = [
            *images,
            *((f"wrong-{i}", w) for i, w in enumerate(wrong[: len(images) // 4])),
        ]
        seconds = dict.fromkeys(VARIANTS, 0.0)
        if number:
            for variant, given in zip(VARIANTS[1:3], (images, mixed), strict=True):
                localizer = Localizer(MapContents(encoder, 240, [scenes[variant]]))
                scenes[variant], report = refresh_scene(localizer, given)
                bounds[variant] = float(
                    np.hypot(bounds[variant], report.shift_sigma_mm or 0)
                )
                seconds[variant] = report.seconds
            scenes[VARIANTS[3]] = _learned(recording, encoder, keyframes)
        answers = {
            v: _answers(scene, recording, encoder) for v, scene in scenes.items()
        }
        for variant, estimates in answers.items():
            drift = _drift(estimates, answers[VARIANTS[0]])
            rows.append({
                "room": root.name, "round": number, "map": variant,
                **_scores(estimates, recording),
                "keyframes": len(scenes[variant].keyframes),
                "kB": scenes[variant].keyframes.bytes / 1000,
                "drift_mm": drift, "stated_sigma_mm": bounds[variant],
                "seconds": seconds[variant],
            })  # fmt: skip
            print(rows[-1], flush=True)
    return rows


def _learned(recording: Recording, encoder: Encoder, keyframes: int) -> SceneMap:
    split = split_held_out(recording.train)
    options = MapOptions()
    budget = MemoryBudget(share=0.0, least=keyframes)
    options = replace(options, memory=budget, size=replace(options.size, cells=240))
    built = build_map(recording.name, split.train, encoder, options)
    return with_scatter(
        MapContents(encoder, 240, [built.scene]),
        built.corrected(split.held_out),
        left_out=built.left_out(split.train),
        noise=built.independent_noise,
    )


def _answers(
    scene: SceneMap, recording: Recording, encoder: Encoder
) -> list[PoseEstimate]:
    localizer = Localizer(MapContents(encoder, 240, [scene]))
    return [localizer.localize(frame.read_image()) for frame in recording.test]


def _scores(estimates: list[PoseEstimate], recording: Recording) -> dict[str, object]:
    """Return accuracy and coverage of the answers to test frames."""
    errors = []
    squared = []
    for estimate, frame in zip(estimates, recording.test, strict=True):
        pose = estimate.uncertain_pose
        true = frame.base_from_camera
        assert true is not None
        if estimate.status != "ok" or pose is None:
            errors.append(np.inf)
            continue
        errors.append(1000 * float(pose_distance(pose.pose, true)[0]))
        squared.append(pose.squared_mahalanobis(true))
    return {
        "images": len(errors),
        "located": int(np.isfinite(errors).sum()),
        "within_1_cm": int((np.array(errors) < 10).sum()),
        "median_mm": float(np.median(errors)),
        "inside_95": share_inside(squared),
    }


def _drift(estimates: list[PoseEstimate], fixed: list[PoseEstimate]) -> float:
    pairs = [
        (a.base_from_camera.translation_m - b.base_from_camera.translation_m)
        for a, b in zip(estimates, fixed, strict=True)
        if a.status == b.status == "ok" and a.base_from_camera and b.base_from_camera
    ]
    return (
        1000 * float(np.linalg.norm(np.median(pairs, axis=0)))
        if pairs
        else float("nan")
    )
