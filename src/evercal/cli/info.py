"""`evercal info`."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from evercal.classes import frozen
from evercal.cli import args
from evercal.cli.console import motion, size, table

MEMORY_FILES = ("keyframes.safetensors", "state.safetensors")
"""Files of the keyframes: of a scene of a map, and of a store of networks."""


@frozen
class Info(args.Verb):
    """Describe a map: scenes, size, and what bundle adjustment changed.

    Example: evercal info cell.evercal
    """

    store: args.Store
    check: bool = False
    """Compare every file with its checksum; exit code 1 if one is damaged."""

    def run(self) -> int:
        if self.check:
            return self._check()
        from evercal.storage.provenance import Made

        strategy = args.strategy_of(self.store)
        if strategy in (args.MAP, None):
            scenes, short_side, heads, sizes = _map(self.store)
        else:
            from evercal.continual.store import describe

            scenes, short_side, heads, sizes = describe(self.store)
        files = filter(Path.is_file, self.store.rglob("*"))
        total = sum(file.stat().st_size for file in files)
        kept = [name for name in sizes if name.endswith(MEMORY_FILES)]
        memory = sum(sizes[name] for name in kept)
        adjusted = [s for s in scenes if s.get("adjusted")]
        made = [s for s in scenes if s.get("made")]
        record = {
            "store": str(self.store),
            "strategy": strategy,
            "short_side": short_side,
            "head_bytes": heads,
            "memory_bytes": memory,
            "total_bytes": total,
            "scenes": scenes,
        }
        plural = "" if len(scenes) == 1 else "s"
        network = f"networks {size(heads)}, " if heads else ""
        self.answer(
            record,
            f"{self.store}: {len(scenes)} scene{plural}, strategy {strategy}, images at"
            f" {short_side} px",
            f"{size(total)} in all: keyframes {size(memory)}, {network}the rest is the encoder",
            *table(list(map(_content, scenes))),
            *table([adjusted_row(s["name"], s["adjusted"]) for s in adjusted]),
            *(f"{s['name']}: {Made.from_dict(s['made'])}" for s in made),
            then=("info", self.store, "--check"),
        )
        return 0

    def _check(self) -> int:
        from evercal.storage import verify

        problems = verify(self.store)
        end = f"{self.store}: all files match their checksums"
        if problems:
            end = f"damaged files: {len(problems)}; restore them from a copy of the map"
        record = {"store": str(self.store), "ok": not problems, "problems": problems}
        self.answer(record, *problems, end)
        return 1 if problems else 0


def _map(store: Path) -> tuple[Sequence[dict[str, Any]], int, int, dict[str, int]]:
    """Scenes for JSON, working size, size of networks, and files with their sizes."""
    from evercal.mapping.store import MapStore

    opened = MapStore.open(store)
    scenes = []
    for scene, report in zip(opened.contents.scenes, opened.reports(), strict=True):
        scenes.append(
            {
                "name": scene.name,
                "train_frames": scene.train_frames,
                "memory_bytes": scene.keyframes.bytes,
                "keyframes": len(scene.keyframes),
                "camera": scene.camera.to_dict(),
                "landmarks": scene.landmarks,
                "adjusted": report.get("adjusted"),
                "hand_eye": report.get("hand_eye"),
                "made": report.get("made"),
            }
        )
    return scenes, opened.contents.short_side, 0, opened.size_bytes()


def _content(scene: dict[str, Any]) -> dict[str, object]:
    is_map = "landmarks" in scene
    row = {
        "scene": scene["name"],
        "frames": scene["train_frames"],
        "keyframes": scene["keyframes"],
    }
    if is_map:
        row["landmarks"] = scene["landmarks"]
    row["memory"] = size(scene["memory_bytes"])
    if not is_map:
        row["rejected below"] = f"{100 * scene['inlier_threshold']:.0f} % inliers"
    row["camera"] = f"{scene['camera']['width']}x{scene['camera']['height']}"
    return row


def adjusted_row(scene: str, adjusted: dict[str, Any]) -> dict[str, object]:
    """Changes by bundle adjustment."""
    shift = adjusted["common_translation_mm"]
    shift_mm = shift and math.hypot(*shift)
    rotation_deg = math.hypot(*adjusted["common_rotation_deg"])
    sigma = adjusted["pose_sigma_mm"]
    residual = adjusted["residual_px"]
    return {
        "bundle adjustment": scene,
        "median residual": "-" if residual is None else f"{residual:.2f} px",
        "error of stated poses": motion(sigma, adjusted["pose_sigma_deg"]),
        "common transform": motion(shift_mm, rotation_deg),
        "focal length": f"{adjusted['focal_percent']:+.2f} %",
        "poses left out": len(adjusted["wrong_poses"]),
        "untracked": len(adjusted.get("untracked", ())),
    }
