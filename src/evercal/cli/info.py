"""`evercal info`."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from evercal.cli.console import print_json, print_next, size


@dataclass(frozen=True)
class Info:
    """Say what a store knows and how large it is."""

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
        scenes = [
            {
                "name": record.name,
                "train_frames": record.train_frames,
                "memory_bytes": keyframes.bytes if keyframes is not None else 0,
                "inlier_threshold": record.inlier_threshold,
                "camera": record.camera.to_dict(),
                "cell": asdict(record.cell),
            }
            for record, keyframes in zip(maps.scenes, maps.keyframes, strict=True)
        ]
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
        print(
            f"{size(used['memory'] + used['rest'])} in all: head {size(heads)},"
            f" memory {size(used['memory'])}, the rest encoder and prototypes"
        )
        self._table(scenes)
        print_next("evercal", "verify", self.store)
        return 0

    def _table(self, scenes: list[dict]) -> None:
        from tabulate import tabulate

        rows = [
            [
                scene["name"],
                scene["train_frames"],
                size(scene["memory_bytes"]),
                f"{100 * scene['inlier_threshold']:.0f} %",
                f"{scene['camera']['width']}x{scene['camera']['height']}",
            ]
            for scene in scenes
        ]
        header = ["scene", "frames learned", "memory", "accepted from inliers", "camera"]
        align = ("left", "right", "right", "right", "right")
        print(tabulate(rows, headers=header, colalign=align, disable_numparse=True))
