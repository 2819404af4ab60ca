"""Rooms through a fisheye, beside a pinhole of as many pixels: images, fixed cameras, mounts.

Boards through the same lens: `evercal detect --lens fisheye` and `solve` on rendered photographs.
"""

import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from benchmarks.accuracy import pose_error, wrong
from benchmarks.board_images import CHARUCO, Photo, render as board_photo
from benchmarks.calibration import as_wrist_recording, learned_mount
from benchmarks.hand_eye import pose
from benchmarks.rows import Row, grouped, median_of, numbers, once, save
from evercal.calibration.boards.board_poses import board_poses
from evercal.calibration.boards.corners import BoardView
from evercal.calibration.boards.detection import find_board
from evercal.calibration.boards.intrinsics import calibrate_camera
from evercal.calibration.pose_pairs.pairs import BoardCorners, PosePairs
from evercal.calibration.pose_pairs.solve import solve
from evercal.errors import InputError
from evercal.evaluation.metrics import share_inside
from evercal.geometry import SE3, Camera
from evercal.map import Map
from evercal.recordings.frame import Frame, Recording
from evercal.simulation.box_room import BoxRoom, default_camera
from rooms.fisheye import fisheye_image
from rooms.paths import sweep_shots
from rooms.renderer import Renderer, RenderOptions
from rooms.room import room as furnished_room

FIRST_SEED = 40
"""Seed of the first box room."""
FRAMES = 60
"""Frames of a recording."""
TESTS = 15
"""Images of a room that are located."""
REPEATS = 8
"""Images of one fixed camera."""
FURNISHED = (("bedroom", 501), ("kitchen", 502), ("living", 503))
"""Kind and seed of the rendered rooms."""
KINDS: dict[str | float, str] = {"box": "box", "none": ""}
"""Kinds of rooms in the summary, by their names in rows; others are furnished."""
NOISE = 3.0
"""Standard deviation of the noise of an image, of 255."""
BOARDS = 10
"""Recordings of a board."""
VIEWS = 20
"""Images of a recording of a board."""
ARM = (0.05, 0.01)
"""Standard deviation of gripper poses beside a board per axis, millimetres and degrees."""


def lens(name: str) -> Camera:
    """A pinhole of 60 degrees, or an equidistant fisheye of so many."""
    if name == "pinhole":
        return default_camera()
    focal = 160 / np.deg2rad(float(name) / 2)
    return Camera(320, 240, focal, focal, 159.5, 119.5, model="fisheye")


def run(
    out: Path = Path("runs/fisheye"),
    rooms: int = 6,
    lenses: tuple[str, ...] = ("pinhole", "150", "180"),
    furnished: int = 0,
) -> None:
    """Learn rooms through each lens, and ask for images of every lens.

    Args:
        out: Folder of the rows; complete rooms are not repeated.
        rooms: Number of box rooms.
        lenses: pinhole, or the angle that a fisheye covers along the width, degrees.
        furnished: Number of furnished rooms, which are rendered as well.
    """
    rows: list[Row] = []
    places = [("box", FIRST_SEED + i) for i in range(rooms)] + [*FURNISHED[:furnished]]
    for kind, seed in tqdm(places, unit="room"):
        for name in lenses:
            file = out / f"{kind}-{seed}-{name}.json"
            rows += once(file, lambda k=kind, s=seed, n=name: _room(k, s, n, lenses))
    for name in lenses:
        for seed in tqdm(range(BOARDS), f"board, {name}", unit="recording"):
            rows += once(
                out / f"board-{seed}-{name}.json", lambda s=seed, n=name: _board(s, n)
            )
    save(out / "fisheye.csv", summary(rows))


@lru_cache(maxsize=1)
def _place(
    kind: str, seed: int
) -> tuple[Callable[[Camera, SE3], np.ndarray], SE3, SE3]:
    """Renderer of a pinhole, poses (FRAMES,) of a recording, and test poses (TESTS,)."""
    if kind == "box":
        box = BoxRoom(seed)
        return box.render, box.path(FRAMES, 1), box.path(TESTS, 2)
    cell = furnished_room(kind, seed)
    shots = sweep_shots(cell, round(FRAMES / 0.7), seed)
    poses = {
        split: SE3.stack(
            [shot.base_from_camera for shot in shots if shot.split == split]
        )
        for split in ("train", "test")
    }
    renderer = Renderer(cell.meshes())
    options = RenderOptions()
    rest = np.linspace(0, len(poses["test"]) - 1, TESTS).astype(int)
    render = lambda camera, at: renderer.render(camera, at, options)  # noqa: E731
    return render, poses["train"], poses["test"][rest]


def _image(kind: str, seed: int, name: str, at: SE3) -> np.ndarray:
    render, _, _ = _place(kind, seed)
    if name == "pinhole":
        return render(lens(name), at)
    # Mitsuba averages the rays of a pixel itself.
    return fisheye_image(lens(name), at, render, 2 if kind == "box" else 1)


@lru_cache(maxsize=3)
def _test_images(kind: str, seed: int, name: str) -> list[np.ndarray]:
    return [_image(kind, seed, name, at) for at in _place(kind, seed)[2]]


def _room(kind: str, seed: int, name: str, lenses: tuple[str, ...]) -> list[Row]:
    _, path, tests = _place(kind, seed)
    rng = np.random.default_rng(seed)

    def noisy(image: np.ndarray) -> np.ndarray:
        return np.clip(image + rng.normal(0, NOISE, image.shape), 0, 255).astype(
            np.uint8
        )

    camera = lens(name)
    images = [noisy(_image(kind, seed, name, at)) for at in path]
    frames = [Frame(f"{i:03d}", images[i], camera, at) for i, at in enumerate(path)]
    recording = Recording("room", tuple(frames), ())
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        cell = Map.open(Path(folder) / "map")
        cell.learn(recording, on_progress=lambda *_: None)

        def add(answer: str, asked: str, error: Row) -> None:
            rows.append(
                {"room": kind, "map": name, "asked": asked, "answer": answer, **error}
            )

        for asked in lenses:
            shown = _test_images(kind, seed, asked)
            for i, (image, at) in enumerate(zip(shown, tests, strict=True)):
                found = cell.localize(noisy(image), lens(asked)).uncertain_pose
                add("image", asked, {} if found is None else pose_error(found, at))
                if asked == name and i % 5 == 0:
                    again = [noisy(image) for _ in range(REPEATS)]
                    error: Row = {}
                    with suppress(InputError):
                        error = pose_error(
                            cell.calibrate(again, camera=camera).uncertain_pose, at
                        )
                    add("fixed camera", name, error)
        wrist, truth = as_wrist_recording(recording, seed)
        error, _ = learned_mount(wrist, truth, Path(folder) / "wrist")
        add("mount", name, error)
    return rows


def _board(seed: int, name: str) -> list[Row]:
    """A camera on the arm, from photographs of a ChArUco board; intrinsics from the same images."""
    small = lens(name)
    rng = np.random.default_rng([seed, 7])
    camera = small.resized(3 * small.width, 3 * small.height)
    views: dict[str, BoardView | str] = {}
    boards: list[SE3] = []
    while len(views) < VIEWS:
        photo = Photo(
            camera, rng.uniform(0, 40), rng.uniform(0.9, 1.6), roll_deg=60, aside=0.4
        )
        image, _, camera_from_board = board_photo(
            CHARUCO, photo, 1000 * seed + len(boards)
        )
        views[f"{len(views)}.png"] = find_board(image, CHARUCO)
        boards.append(camera_from_board)
    seen = [view for view in views.values() if isinstance(view, BoardView)]
    estimate = calibrate_camera(seen, camera.width, camera.height, camera.model).camera
    fits = board_poses(CHARUCO, estimate, views, "board").detected
    use = [int(fit.name.removesuffix(".png")) for fit in fits]
    truth = pose(Rotation.random(rng=rng), rng.uniform(-0.1, 0.1, 3))
    base_from_board = pose(
        Rotation.from_rotvec([0, 0, 0.4]), np.array([0.5, 0.1, 0.02])
    )
    arm = base_from_board @ SE3.stack(boards)[use].inverse() @ truth.inverse()
    sigma = np.repeat([ARM[0] / 1000, np.deg2rad(ARM[1])], 3)
    stated = arm @ SE3.exp(rng.normal(0, sigma, (len(use), 6)))
    measured = SE3.stack(
        [fit.camera_from_board for fit in fits if fit.camera_from_board]
    )
    pairs = PosePairs(tuple(fit.name for fit in fits), stated, measured)
    corners = BoardCorners(estimate, tuple(fit.view for fit in fits if fit.view))
    answer = solve(pairs, "eye_in_hand", corners=corners)
    error = pose_error(answer.uncertain_pose, truth)
    return [{"room": "none", "map": name, "asked": name, "answer": "board", **error}]


def summary(rows: list[Row]) -> list[Row]:
    """One row for each kind of answer, map and lens."""
    rows = [row | {"rooms": KINDS.get(row["room"], "furnished")} for row in rows]
    lines: list[Row] = []
    groups = grouped(rows, "answer", "rooms", "map", "asked")
    for (answer, kind, learned, asked), group in groups.items():
        mm = numbers(group, "mm")
        squared = numbers(group, "squared_mahalanobis")
        line: Row = {
            "answer": answer,
            "rooms": kind,
            "map": learned,
            "asked": asked,
            "number": len(group),
        }
        line |= {"located": len(mm), "mm": median_of(mm)}
        line |= {
            "mm_90": float(np.quantile(mm, 0.9)),
            "inside_95": share_inside(squared),
        }
        lines.append(line | {"wrong": int(wrong(mm, squared).sum())})
    return lines
