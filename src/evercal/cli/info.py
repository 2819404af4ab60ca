"""`evercal info`."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from evercal.cli.console import size, table
from evercal.cli.options import Store, Verb

MEMORY_FILES = ("keyframes.safetensors", "state.safetensors")


@dataclass(frozen=True)
class Info(Verb):
    """Describe a map: its scenes, its size, and what bundle adjustment changed.

    Example: evercal info cell.evercal
    """

    store: Store
    check: bool = False
    """Compare every file with its checksum; exit code 1 if one is damaged."""

    def run(self) -> int:
        if self.check:
            return self._check()
        from evercal.cli.arguments import MAP, strategy_of

        strategy = strategy_of(self.store)
        if strategy in (MAP, None):
            scenes, short_side, heads, sizes = _map(self)
        else:
            from evercal.continual.store import describe

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
        plural = "s" if len(scenes) != 1 else ""
        network = f"networks {size(heads)}, " if heads else ""
        lines = [
            f"{self.store}: {len(scenes)} scene{plural}, strategy {strategy}, images at"
            f" {short_side} px",
            f"{size(total)} in all: keyframes {size(memory)}, {network}the rest is the encoder",
            *table([_content(scene) for scene in scenes]),
            *table([_adjusted(scene) for scene in scenes if scene.get("adjusted")]),
        ]
        return self.answer(content, lines, ("info", self.store, "--check"))

    def _check(self) -> int:
        from evercal.storage import verify

        problems = verify(self.store)
        lines = [*problems, f"{self.store}: all files match their checksums"]
        if problems:
            files = "1 file is" if len(problems) == 1 else f"{len(problems)} files are"
            lines[-1] = f"{files} damaged; restore from a copy of the map"
        record = {"store": str(self.store), "ok": not problems, "problems": problems}
        self.answer(record, lines)
        return 1 if problems else 0


def _map(given: Info) -> tuple[Sequence[dict[str, Any]], int, int, dict[str, int]]:
    """Scenes for JSON, working size, size of networks, and files with their sizes."""
    from evercal.mapping.store import MapStore

    store = MapStore.open(given.store)
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


def _content(scene: dict[str, Any]) -> dict[str, object]:
    threshold = (
        f"support {scene['min_support']:.2f}"
        if "min_support" in scene
        else f"{100 * scene['inlier_threshold']:.0f} % inliers"
    )
    landmarks = {"landmarks": scene["landmarks"]} if "landmarks" in scene else {}
    return {
        "scene": scene["name"],
        "frames": scene["train_frames"],
        "keyframes": scene["keyframes"],
        **landmarks,
        "memory": size(scene["memory_bytes"]),
        "rejected below": threshold,
        "camera": f"{scene['camera']['width']}x{scene['camera']['height']}",
    }


def _adjusted(scene: dict[str, Any]) -> dict[str, object]:
    """Changes by bundle adjustment."""
    adjusted = scene["adjusted"]
    shift, rotation = (
        sum(x * x for x in adjusted[key]) ** 0.5
        for key in ("common_translation_mm", "common_rotation_deg")
    )
    residual = adjusted["residual_px"]
    sigma = f"{adjusted['pose_sigma_mm']:.2f} mm, {adjusted['pose_sigma_deg']:.3f} deg"
    return {
        "bundle adjustment": scene["name"],
        "median residual": "-" if residual is None else f"{residual:.2f} px",
        "error of stated poses": sigma,
        "common transform": f"{shift:.2f} mm, {rotation:.3f} deg",
        "focal length": f"{adjusted['focal_percent']:+.2f} %",
        "wrong poses": len(adjusted["wrong_poses"]),
        "untracked": len(adjusted.get("untracked", ())),
    }
