"""`evercal info`."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from evercal.cli.console import print_json, print_next, size

if TYPE_CHECKING:
    from evercal.mapping.keyframes import Keyframes
    from evercal.mapping.scene_maps import SceneRecord


@dataclass(frozen=True)
class Info:
    """Say what a store knows, how large it is, and what bundle adjustment changed."""

    store: Annotated[Positional[Path], arg(metavar="STORE")]
    """Folder of the store."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        """Opens the store and describes it."""
        from evercal.mapping.stage_files import head_bytes
        from evercal.mapping.store import Store

        store = Store.open(self.store)
        maps, used = store.maps, store.bytes()
        entries = zip(maps.scenes, maps.keyframes, store.reports(), strict=True)
        scenes = [_scene(*entry) for entry in entries]
        heads = sum(head_bytes(head) for head in maps.heads)
        content = {
            "store": str(self.store),
            "strategy": maps.strategy,
            "short_side": maps.short_side,
            "head_bytes": heads,
            "memory_bytes": used["memory"],
            "total_bytes": used["memory"] + used["rest"],
            "scenes": scenes,
        }
        if self.json:
            print_json(content)
            return 0
        print(
            f"{self.store}: {len(scenes)} scene{'s' if len(scenes) != 1 else ''}, strategy"
            f" {maps.strategy}, images at {maps.short_side} px"
        )
        network = f"the network {size(heads)}, " if heads else ""
        print(
            f"{size(used['memory'] + used['rest'])} in all: keyframes {size(used['memory'])},"
            f" {network}the rest is the encoder and what describes scenes"
        )
        for lines in (_content_table(scenes), _adjusted_table(scenes)):
            if lines:
                print(lines)
        print_next("evercal", "verify", self.store)
        return 0


def _scene(
    record: "SceneRecord", keyframes: "Keyframes | None", report: dict[str, Any]
) -> dict[str, Any]:
    """One scene for JSON; what only a map or only a network has is there for these alone."""
    scene: dict[str, Any] = {
        "name": record.name,
        "train_frames": record.train_frames,
        "memory_bytes": keyframes.bytes if keyframes is not None else 0,
        "keyframes": len(keyframes) if keyframes is not None else 0,
        "camera": record.camera.to_dict(),
    }
    if keyframes is not None and keyframes.landmarks:
        return scene | {
            "landmarks": sum(map(len, keyframes.landmarks)),
            "min_support": record.min_support,
            "adjusted": report.get("adjusted"),
        }
    return scene | {"inlier_threshold": record.inlier_threshold, "cell": asdict(record.cell)}


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
    header = ["scene", "frames learned", "keyframes", *(["landmarks"] if maps else [])]
    return _table([*header, "memory", "unknown_scene below", "camera"], rows)


def _threshold(scene: dict[str, Any]) -> str:
    """What a pose needs to be accepted."""
    if "min_support" in scene:
        return f"support {scene['min_support']:.2f}"
    return f"{100 * scene['inlier_threshold']:.0f} % inliers"


def _adjusted_table(scenes: Sequence[dict[str, Any]]) -> str:
    """What bundle adjustment changed; empty where no scene was adjusted."""
    rows = []
    for scene in scenes:
        adjusted = scene.get("adjusted")
        if not adjusted:
            continue
        shift, turn = (
            sum(x * x for x in adjusted[key]) ** 0.5
            for key in ("common_translation_mm", "common_rotation_deg")
        )
        rows.append(
            [
                scene["name"],
                f"{adjusted['residual_px']:.2f} px",
                f"{adjusted['pose_sigma_mm']:.2f} mm, {adjusted['pose_sigma_deg']:.3f} deg",
                f"{shift:.2f} mm, {turn:.3f} deg",
                f"{adjusted['focal_percent']:+.2f} %",
                f"{len(adjusted['wrong_poses'])} left out",
            ]
        )
    if not rows:
        return ""
    header = ["bundle adjustment", "median residual", "error of stated poses", "common transform"]
    return "\n" + _table([*header, "focal length", "wrong poses"], rows)


def _table(header: list[str], rows: list[list[Any]]) -> str:
    from tabulate import tabulate

    align = ("left", *("right" for _ in header[1:]))
    return tabulate(rows, headers=header, colalign=align, disable_numparse=True)
