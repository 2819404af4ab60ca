"""A map is aligned by a board that stands still in other images of its scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evercal.calibration.boards.board import Board
from evercal.calibration.boards.board_poses import BoardImage, BoardPoses
from evercal.calibration.boards.corners import BoardView
from evercal.calibration.from_map.align import about
from evercal.calibration.from_map.by_board import align_by_board
from evercal.geometry import SE3, UncertainPose, norms, pose_distance
from evercal.localization.localizer import Localizer
from evercal.map import Map
from evercal.mapping.map_frame import Similarity
from evercal.mapping.scene_map import MapContents
from evercal.mapping.store import MapStore
from evercal.recordings import write_image
from evercal.recordings.frame import Recording
from evercal.simulation.box_room import BoxRoom

PLACE = UncertainPose(
    SE3.exp([0.4, -0.2, 0.1, 0.3, -0.1, 2.0]),
    np.diag([1e-6] * 3 + [1e-5] * 3),
)
POINTS_M = 0.04 * np.stack([*np.ndindex(6, 4, 1)])


def board_file(
    folder: Path, hall: Recording, room: BoxRoom, scale: float, seed: int
) -> tuple[Path, SE3]:
    """Corners of a board before six images, and base_from_map; map units are 1 / scale m."""
    rng = np.random.default_rng(seed)
    camera = hall.train[0].camera
    frames = hall.train[2:20:3]
    first = frames[2].base_from_camera
    assert first
    tilted = SE3.exp([-0.1 / scale, -0.07 / scale, 1.0, 0.3, 0.4, rng.uniform(-3, 3)])
    map_from_board = first @ tilted
    images = []
    for number, frame in enumerate(frames):
        assert frame.base_from_camera
        camera_from_map = frame.base_from_camera.inverse()
        in_camera = camera_from_map.apply(map_from_board.apply(POINTS_M / scale))
        pixels = camera.project(in_camera)
        pixels += rng.normal(0, 0.1, pixels.shape)
        seen = np.isfinite(pixels).all(1)
        write_image(
            folder / f"{number}.png", room.render(camera, frame.base_from_camera)
        )
        if seen.sum() >= 4:
            view = BoardView(POINTS_M[seen], pixels[seen])
            pose = camera_from_map @ map_from_board
            image = BoardImage(f"{number}.png", view, pose, np.eye(6), 0.1)
            images.append(image)
    path = folder / "board.json"
    BoardPoses(
        Board("chessboard", 0.04, columns=7, rows=5), camera, tuple(images), 0.1
    ).write(path)
    turned = PLACE.pose.rotation * map_from_board.rotation.inv()
    shift = PLACE.pose.translation_m - scale * turned.apply(
        map_from_board.translation_m
    )
    return path, SE3.of(turned, shift)


@pytest.mark.parametrize(("scale", "seed"), [(0.4, 0), (0.4, 2), (1.0, 1)])
def test_a_board_determines_base_and_scale(
    scale: float,
    seed: int,
    hall: Recording,
    hall_room: BoxRoom,
    hall_map: MapContents,
    tmp_path: Path,
) -> None:
    path, base_from_map = board_file(tmp_path, hall, hall_room, scale, seed)
    localizer = Localizer(hall_map)
    poses = [frame.base_from_camera for frame in hall.test]
    in_map = SE3.stack([pose for pose in poses if pose]).translation_m
    sigma = []
    for place in (None, PLACE):
        found = align_by_board(localizer, "hall", path, place, scale == 1.0)
        base_from_board = place.pose if place else SE3.identity()
        right = base_from_board @ PLACE.pose.inverse() @ base_from_map
        apart = found.similarity.points(in_map) - Similarity(right, scale).points(
            in_map
        )
        assert found.similarity.scale == pytest.approx(scale, rel=0.002)
        assert norms(apart).max() < 0.004
        middle = found.similarity.points(in_map).mean(0)
        whole = about(-middle, found.base_covariance)
        assert (np.abs(apart.mean(0)) < 3 * np.sqrt(np.diag(whole)[:3])).all()
        sigma.append(found.sigma)
    assert sigma[0] < sigma[1]


def test_the_verb_writes_the_base(
    hall: Recording,
    hall_room: BoxRoom,
    hall_map: MapContents,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from evercal.cli import main

    path, base_from_map = board_file(tmp_path, hall, hall_room, 1.0, 0)
    store = MapStore(
        tmp_path / "map", MapContents(hall_map.encoder, hall_map.short_side)
    )
    store.commit(hall_map.scenes[0], {})
    place = tmp_path / "place.txt"
    np.savetxt(place, PLACE.pose.matrix())
    words = ["align", str(tmp_path / "map"), "hall", "--board-poses", str(path)]
    for more, reason in (
        (["--picks", "p.csv"], "board that stands still"),
        (["--board-at", "0,0,0,2,0,0,0"], "unit quaternion"),
        (["--convention", "kuka"], "belong to --robot-poses"),
    ):
        assert main([*words, *more]) == 2
        assert reason in capsys.readouterr().err
    assert main([*words, "--board-at", str(place)]) == 0
    frame = hall.test[3]
    estimate = Map.open(tmp_path / "map").localize(frame.read_image())
    assert estimate.base_from_camera
    assert frame.base_from_camera
    right = base_from_map @ frame.base_from_camera
    assert pose_distance(estimate.base_from_camera, right)[0] < 0.006
