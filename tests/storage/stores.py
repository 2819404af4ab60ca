"""Stores of stages for the tests."""

import json
from collections.abc import Callable
from pathlib import Path

from evercal.storage import Manifest, write_bytes
from evercal.storage.stages import StageStore, is_store, read_store

Tree = Callable[[Path], dict[str, str]]
PAYLOAD = {"kind": "test"}
NETWORK = "encoder-1.bin"
FILES = ("head.bin", "scene.json")


def opened(root: Path) -> StageStore[None]:
    """The store at a path, or a new one."""
    if not is_store(root):
        return StageStore(root, None)
    payload = read_store(root, lambda manifest: manifest.payload)
    return StageStore(root, None, payload["stages"], payload["networks"])


def add(store: StageStore[None], name: str) -> None:
    def write(folder: Path) -> None:
        if not store.networks:
            write_bytes(store.root / NETWORK, b"weights")
            store.networks = (NETWORK,)
        write_bytes(folder / "scene.json", json.dumps(name).encode())
        (folder / "head.bin").write_bytes(bytes(100))

    store.add(name, write, PAYLOAD)


def change_by(action: str, store: StageStore[None]) -> None:
    if action == "replace":
        store.replace(
            0, lambda folder: write_bytes(folder / "scene.json", b'"new"'), PAYLOAD
        )
    elif action == "remove":
        store.change(store.stages[1:], [], PAYLOAD)
    else:
        add(store, "attic")


def texts(root: Path) -> list[str]:
    """`scene.json` of every stage; none where there is no store."""

    def read(manifest: Manifest) -> list[str]:
        folders = [root / "stages" / stage for stage in manifest.payload["stages"]]
        return [json.loads((folder / "scene.json").read_text()) for folder in folders]

    return read_store(root, read) if is_store(root) else []
