"""The sample robot cell: a wrist recording, a fixed camera before and after a bump, and the truth.

    DIR/wrist/images/0000.jpg, ...     a camera on the gripper that moves
    DIR/wrist/base_from_gripper.csv    stated gripper poses, with noise
    DIR/wrist/camera.json              intrinsics, also those of the fixed camera
    DIR/tripod/0000.jpg, ...           a fixed camera while the arm moves
    DIR/bumped.jpg                     the fixed camera after a small bump
    DIR/truth.json                     true poses, noise and settings

Render it with `python -m benchmarks.sample_cell DIR`.
"""

import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np

from evercal.geometry import SE3, pose_to_dict
from evercal.recordings.images import write_jpeg
from evercal.simulation.box_room import default_camera, look_at
from evercal.simulation.panda_arm import base_from_flange
from evercal.storage import write_bytes, write_json
from rooms.panda import panda_meshes
from rooms.renderer import Renderer, RenderOptions, mitsuba
from rooms.room import room

ROOM = ("living", 22)
"""Kind and seed of the room."""
WRIST_IMAGES = 60
TRIPOD_IMAGES = 12
JPEG_QUALITY = 85
NOISE_M = 0.0002
"""Standard deviation per axis of stated gripper positions, metres."""
NOISE_RAD = np.deg2rad(0.02)
"""Standard deviation per axis of stated gripper rotations, radians."""
BUMP_M = 0.005
BUMP_RAD = np.deg2rad(0.3)

_SEED = 22
_WRIST_CENTRE_RAD = np.array([0.4, -1.0, 0.0, -2.3, -0.6, 1.8, 1.1])
_WRIST_SPREAD_RAD = np.array([0.4, 0.25, 0.2, 0.2, 0.35, 0.25, 0.45])
_WORK_CENTRE_RAD = np.array([-0.25, -0.4, 0.0, -2.2, 0.0, 1.9, 0.785])
_WORK_SPREAD_RAD = np.array([0.35, 0.3, 0.2, 0.3, 0.5, 0.35, 0.6])
_TRIPOD_M = np.array([0.05, 0.5, 0.85])
_TRIPOD_TARGET_M = np.array([0.9, 0.1, 0.1])


def render_sample_cell(out: Path) -> None:
    """Render the sample cell into a folder.

    Existing files of the same names are replaced.

    Raises:
        InputError: Mitsuba or the meshes of the arm are missing.
    """
    camera = default_camera()
    gripper_from_camera = _mounted_camera()
    tripod = look_at(_TRIPOD_M, _TRIPOD_TARGET_M)
    bumped = tripod @ _bump()
    wrist_joints = _arm_path(WRIST_IMAGES, _WRIST_CENTRE_RAD, _WRIST_SPREAD_RAD, 1)
    work_joints = _arm_path(TRIPOD_IMAGES + 1, _WORK_CENTRE_RAD, _WORK_SPREAD_RAD, 2)
    grippers = SE3.stack([base_from_flange(joints) for joints in wrist_joints])
    options = RenderOptions()
    renderer = Renderer(room(*ROOM).meshes() + panda_meshes(wrist_joints[0]))

    def take(path: Path, joints: np.ndarray, base_from_camera: SE3) -> None:
        renderer.move(panda_meshes(joints))
        seed = int.from_bytes(path.relative_to(out).as_posix().encode()) % 2**31
        write_jpeg(
            path, renderer.render(camera, base_from_camera, options, seed), JPEG_QUALITY
        )

    for i, joints in enumerate(wrist_joints):
        take(
            out / f"wrist/images/{i:04d}.jpg", joints, grippers[i] @ gripper_from_camera
        )
    for i, joints in enumerate(work_joints[:-1]):
        take(out / f"tripod/{i:04d}.jpg", joints, tripod)
    take(out / "bumped.jpg", work_joints[-1], bumped)
    _write_gripper_poses(out / "wrist/base_from_gripper.csv", grippers)
    write_json(out / "wrist/camera.json", asdict(camera))
    mi = mitsuba()
    write_json(
        out / "truth.json",
        {
            "gripper_from_camera": pose_to_dict(gripper_from_camera),
            "base_from_camera": pose_to_dict(tripod),
            "base_from_bumped_camera": pose_to_dict(bumped),
            "gripper_noise_m": NOISE_M,
            "gripper_noise_rad": float(NOISE_RAD),
            "seed": _SEED,
            "room": f"{ROOM[0]} {ROOM[1]}",
            "render": {
                **asdict(options),
                "jpeg_quality": JPEG_QUALITY,
                "renderer": f"mitsuba {mi.__version__} {mi.variant()}",
            },
        },
    )


def _mounted_camera() -> SE3:
    """gripper_from_camera: 8 cm beside the flange, along the fingers, slightly tilted."""
    offset = SE3(np.array([1.0, 0, 0, 0]), np.array([0.052, -0.061, 0.024]))
    upright = SE3.exp(np.array([0, 0, 0, 0, 0, np.deg2rad(45.0)]))
    tilt = SE3.exp(np.array([0, 0, 0, 0.09, -0.06, 0.04]))
    return offset @ upright @ tilt


def _bump() -> SE3:
    """camera_before_from_camera_after: 5 mm and 0.3 deg in random directions."""
    directions = np.random.default_rng([_SEED, 3]).standard_normal((2, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return SE3.exp(np.concatenate([BUMP_M * directions[0], BUMP_RAD * directions[1]]))


def _arm_path(
    count: int, centre: np.ndarray, spread: np.ndarray, stream: int
) -> np.ndarray:
    rng = np.random.default_rng([_SEED, stream])
    t = np.linspace(0, 2 * np.pi, count, endpoint=False)[:, None]
    cycles = np.array([1.0, 2.0, 1.0, 2.0, 2.0, 1.0, 2.0])
    phase = rng.uniform(0, 2 * np.pi, (2, 7))
    wave = 0.75 * np.sin(cycles * t + phase[0]) + 0.25 * np.sin(
        2 * cycles * t + phase[1]
    )
    return centre + spread * wave


def _write_gripper_poses(path: Path, grippers: SE3) -> None:
    sigma = np.repeat([NOISE_M, NOISE_RAD], 3)
    noise = sigma * np.random.default_rng([_SEED, 4]).standard_normal(
        (len(grippers), 6)
    )
    rows = ["image,x,y,z,qw,qx,qy,qz"]
    for i, pose in enumerate(grippers @ SE3.exp(noise)):
        numbers = [*pose.translation_m, *pose.rotation_wxyz]
        rows.append(
            ",".join([f"{i:04d}.jpg", *(f"{number:.7f}" for number in numbers)])
        )
    write_bytes(path, ("\n".join(rows) + "\n").encode())


if __name__ == "__main__":
    render_sample_cell(Path(sys.argv[1]))
