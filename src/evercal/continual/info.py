"""Description of a store of networks, for `evercal info`."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from evercal.continual.store import NetworkStore, head_bytes


def describe(path: Path) -> tuple[list[dict[str, Any]], int, int, dict[str, int]]:
    """Scenes for JSON, working size, size of networks, and files with their sizes."""
    store = NetworkStore.open(path)
    contents = store.contents
    scenes: list[dict[str, Any]] = [
        {
            "name": record.name,
            "train_frames": record.train_frames,
            "memory_bytes": keyframes.bytes if keyframes is not None else 0,
            "keyframes": len(keyframes) if keyframes is not None else 0,
            "camera": record.camera.to_dict(),
            "inlier_threshold": record.inlier_threshold,
            "cell": asdict(record.cell),
        }
        for record, keyframes in zip(contents.scenes, contents.keyframes, strict=True)
    ]
    heads = sum(head_bytes(head) for head in contents.heads)
    return scenes, contents.short_side, heads, store.size_bytes()
