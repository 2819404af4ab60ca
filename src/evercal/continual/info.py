"""Description of a store of networks, for `evercal info`."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from evercal.continual.store import NetworkStore, head_bytes


def describe(path: Path) -> tuple[list[dict[str, Any]], int, int, dict[str, int]]:
    """Scenes for JSON, working size, size of networks, and files with their sizes."""
    store = NetworkStore.open(path)
    contents = store.contents
    entries = zip(contents.scenes, contents.keyframes, store.reports(), strict=True)
    scenes = []
    for record, keyframes, report in entries:
        scene: dict[str, Any] = {
            "name": record.name,
            "train_frames": record.train_frames,
            "memory_bytes": keyframes.bytes if keyframes is not None else 0,
            "keyframes": len(keyframes) if keyframes is not None else 0,
            "camera": record.camera.to_dict(),
        }
        if record.map is not None:
            scene["landmarks"] = record.map.landmarks
            scene["min_support"] = record.map.min_support
            scene["adjusted"] = report.get("adjusted")
        else:
            scene["inlier_threshold"] = record.inlier_threshold
            scene["cell"] = asdict(record.cell)
        scenes.append(scene)
    heads = sum(head_bytes(head) for head in contents.heads)
    return scenes, contents.short_side, heads, store.size_bytes()
