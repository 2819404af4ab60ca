"""`evercal info` shows what a map has, and nothing that means nothing for it."""

import json
from pathlib import Path
from typing import Any

from evercal.cli.info import _adjusted_table, _content_table

SCENE: dict[str, Any] = {
    "name": "kitchen",
    "train_frames": 87,
    "memory_bytes": 311_279,
    "keyframes": 8,
    "camera": {"width": 320, "height": 240},
}
ADJUSTED: dict[str, Any] = {
    "common_translation_mm": [3.0, 0.0, 4.0],
    "common_rotation_deg": [0.0, 0.6, 0.8],
    "focal_percent": -0.25,
    "residual_px": 0.449,
    "pose_sigma_mm": 1.5,
    "pose_sigma_deg": 0.1,
    "wrong_poses": ["a"],
}


def test_maps_show_landmarks_and_what_was_adjusted() -> None:
    scene = SCENE | {"landmarks": 4816, "min_support": 1.5, "adjusted": ADJUSTED}
    header, _, row = _content_table([scene]).splitlines()
    assert "landmarks" in header
    assert " ".join(row.split()) == "kitchen 87 8 4816 311.3 kB support 1.50 320x240"
    adjusted = " ".join(_adjusted_table([scene]).splitlines()[-1].split())
    assert adjusted == ("kitchen 0.45 px 1.50 mm, 0.100 deg 5.00 mm, 1.000 deg -0.25 % 1 left out")


def test_networks_show_neither() -> None:
    scene = SCENE | {"inlier_threshold": 0.213, "keyframes": 0}
    assert "landmarks" not in _content_table([scene])
    assert "21 % inliers" in _content_table([scene])
    assert _adjusted_table([scene]) == ""


def test_a_store_that_was_learned(run: Any, store: Path) -> None:
    (scene,) = json.loads(run("info", store, "--json").out)["scenes"]
    assert scene["keyframes"] > 0
    assert scene["landmarks"] > 0
    assert scene["adjusted"]["residual_px"] > 0
    assert "inlier_threshold" not in scene
    text = run("info", store).out
    assert "bundle adjustment" in text
    assert f" {scene['landmarks']} " in text
