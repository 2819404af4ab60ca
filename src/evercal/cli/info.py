"""`evercal info`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from evercal.cli.console import print_json, print_next, size

MEMORY_FILES = ("keyframes.safetensors", "state.safetensors")


@dataclass(frozen=True)
class Info:
    """Describe a store: its scenes, its size, and what bundle adjustment changed.

    Example: evercal info cell.evercal
    """

    store: Annotated[Positional[Path], arg(metavar="STORE")]
    """Folder of the store."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        """Open the store and describe it."""
        from evercal.cli.stores import MAP, strategy_of

        strategy = strategy_of(self.store)
        if strategy in (MAP, None):
            scenes, short_side, heads, sizes = _map(self.store)
        else:
            from evercal.continual.info import describe

            scenes, short_side, heads, sizes = describe(self.store)
        total = sum(file.stat().st_size for file in self.store.rglob("*") if file.is_file())
        memory = sum(bytes for file, bytes in sizes.items() if file.endswith(MEMORY_FILES))
        content = {
            "store": str(self.store),
            "strategy": strategy,
            "short_side": short_side,
            "head_bytes": heads,
            "memory_bytes": memory,
            "total_bytes": total,
            "scenes": scenes,
        }
        if self.json:
            print_json(content)
            return 0
        plural = "s" if len(scenes) != 1 else ""
        print(
            f"{self.store}: {len(scenes)} scene{plural}, strategy {strategy}, images at"
            f" {short_side} px"
        )
        network = f"networks {size(heads)}, " if heads else ""
        print(f"{size(total)} in all: keyframes {size(memory)}, {network}the rest is the encoder")
        for lines in (_content_table(scenes), _adjusted_table(scenes)):
            if lines:
                print(lines)
        print_next("evercal", "verify", self.store)
        return 0


def _map(path: Path) -> tuple[list[dict[str, Any]], int, int, dict[str, int]]:
    """Scenes for JSON, working size, size of networks, and files with their sizes."""
    from evercal.mapping.store import MapStore

    store = MapStore.open(path)
    scenes = [
        {
            "name": scene.name,
            "train_frames": scene.train_frames,
            "memory_bytes": scene.keyframes.bytes,
            "keyframes": len(scene.keyframes),
            "camera": scene.camera.to_dict(),
            "landmarks": scene.landmarks,
            "min_support": scene.min_support,
            "adjusted": report.get("adjusted"),
            "hand_eye": report.get("hand_eye"),
        }
        for scene, report in zip(store.contents.scenes, store.reports(), strict=True)
    ]
    return scenes, store.contents.short_side, 0, store.size_bytes()


def _content_table(scenes: Sequence[dict[str, Any]]) -> str:
    maps = any("landmarks" in scene for scene in scenes)
    rows = [
        [
            scene["name"],
            scene["train_frames"],
            scene["keyframes"],
            *([scene.get("landmarks", "")] if maps else []),
            size(scene["memory_bytes"]),
            _threshold(scene),
            f"{scene['camera']['width']}x{scene['camera']['height']}",
        ]
        for scene in scenes
    ]
    header = ["scene", "frames", "keyframes", *(["landmarks"] if maps else [])]
    return _table([*header, "memory", "rejected below", "camera"], rows)


def _threshold(scene: dict[str, Any]) -> str:
    """Threshold of acceptance."""
    if "min_support" in scene:
        return f"support {scene['min_support']:.2f}"
    return f"{100 * scene['inlier_threshold']:.0f} % inliers"


def _adjusted_table(scenes: Sequence[dict[str, Any]]) -> str:
    """Changes by bundle adjustment; empty if no scene was adjusted."""
    rows = []
    for scene in scenes:
        adjusted = scene.get("adjusted")
        if not adjusted:
            continue
        shift, rotation = (
            sum(x * x for x in adjusted[key]) ** 0.5
            for key in ("common_translation_mm", "common_rotation_deg")
        )
        rows.append(
            [
                scene["name"],
                _pixels(adjusted["residual_px"]),
                f"{adjusted['pose_sigma_mm']:.2f} mm, {adjusted['pose_sigma_deg']:.3f} deg",
                f"{shift:.2f} mm, {rotation:.3f} deg",
                f"{adjusted['focal_percent']:+.2f} %",
                str(len(adjusted["wrong_poses"])),
                str(len(adjusted.get("untracked", ()))),
            ]
        )
    if not rows:
        return ""
    header = ["bundle adjustment", "median residual", "error of stated poses", "common transform"]
    return "\n" + _table([*header, "focal length", "wrong poses", "untracked"], rows)


def _pixels(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f} px"


def _table(header: list[str], rows: list[list[Any]]) -> str:
    from tabulate import tabulate

    align = ("left", *("right" for _ in header[1:]))
    return tabulate(rows, headers=header, colalign=align, disable_numparse=True)
