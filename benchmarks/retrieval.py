"""Retrieval in a map of many scenes: the right scene, milliseconds and bytes.

Scenes are box rooms with 50 keyframes each. Queries are images between the keyframes of the first
hundred rooms. The packaged rooms are queried as well, by every tenth of their test images. One more
row is the ranking of before: a product for each image, and a whole sort.

Maps are opened and asked, too. They hold the packaged rooms among copies of one box room, whose
descriptors are those of the others.
"""

import json
import shutil
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from tqdm import tqdm

from benchmarks.rows import Row, save
from evercal import Map
from evercal.features.encoder import Encoder, load_encoder
from evercal.geometry import SE3
from evercal.localization.keyframe_bank import KeyframeBank
from evercal.localization.options import LocalizeOptions
from evercal.mapping.keyframes import Keyframes
from evercal.mapping.map_frame import MapFrame
from evercal.mapping.scene_map import MapContents, SceneMap
from evercal.mapping.store import KEYFRAMES as KEYFRAMES_FILE, SCENE
from evercal.processes import python_command
from evercal.recordings import Frame, Recording
from evercal.recordings.samples import sample_rooms
from evercal.simulation.box_room import BoxRoom, default_camera
from evercal.storage.manifest import Manifest, write_manifest
from evercal.storage.stages import STAGES
from evercal.storage.tensors import load_tensors, save_tensors

FIRST_SEED = 30_000
KEYFRAMES = 50
"""Keyframes of a scene."""
QUERIES = 5
"""Query images of a scene that has some."""
QUERIED = 100
"""Scenes that have query images: the first ones."""
TEXTURE_PX = 192
"""Side of the textures of a room, pixels."""
SIDE = 240
"""Side of the encoder's input, pixels."""
AT_ONCE = 25
"""Scenes in a file."""
ATTEMPT = LocalizeOptions().attempts[0]


def run(out: Path = Path("runs/retrieval"), scenes: int = 2000) -> None:
    """Rank the keyframes of up to 100,000 in scenes that no image shows.

    Args:
        out: Folder of the descriptors; complete files are not repeated.
        scenes: Box rooms, 100 or more.
    """
    files = [np.load(file) for file in descriptors(out, scenes)]
    keys = np.concatenate([file["keyframes"] for file in files])
    asked = np.concatenate([f["queries"] for f in files if f["queries"].size])
    packed, their = _packaged(load_encoder())
    rows: list[Row] = []
    for count in (100, 200, 1000, 2000):
        if count > len(keys):
            continue
        every = np.concatenate([packed, keys[: count - len(packed)]])
        bank = _bank(every)
        rooms = {
            "box rooms": [
                (len(packed) + n, q) for n, room in enumerate(asked[:97]) for q in room
            ],
            "packaged rooms": [(n, q) for n, room in enumerate(their) for q in room],
        }
        for name, queries in rooms.items():
            rows.append(
                {"queries": name, "keyframes": bank.scene.size, **_right(bank, queries)}
            )
        some = [q.astype(np.float32) for _, q in rooms["box rooms"][:4]]
        rows[-2] |= {
            "one_image_ms": _milliseconds(lambda b=bank, q=some: _ranked(b, q[:1])),
            "four_turns_ms": _milliseconds(lambda b=bank, q=some: _ranked(b, q)),
            "before_ms": _milliseconds(lambda b=bank, q=some: _before(b, q)),
            "megabytes": every.size * 4 / 1e6,
        }
    save(out / "retrieval.csv", rows, {"scenes": scenes, "attempt": str(ATTEMPT)})
    learned = _learned(out / "learned")
    maps = []
    for count in (10, 100, 1000, 2000):
        if count <= len(keys) + len(packed):
            root = _large_map(
                learned, out / f"map-{count}", keys[: count - len(packed)]
            )
            maps.append({"scenes": count, **_asked(root)})
    save(out / "large-maps.csv", maps, {"keyframes": KEYFRAMES})


def _learned(root: Path) -> Path:
    """A map of the packaged rooms and a box room."""
    opened = Map.open(root)
    for room in sample_rooms():
        if room.scene.name not in opened.scenes:
            opened.learn(room.scene)
    if "room" not in opened.scenes:
        room = BoxRoom(FIRST_SEED - 1, texture_px=TEXTURE_PX)
        camera = default_camera()
        path = room.path(2 * KEYFRAMES, 0)
        views = [
            (f"{i:03d}", room.render(camera, path[i]), path[i])
            for i in range(len(path))
        ]
        frames = tuple(Frame(name, image, camera, pose) for name, image, pose in views)
        opened.learn(Recording("room", frames, ()), memory="50%")
    return root


def _large_map(learned: Path, root: Path, keys: np.ndarray) -> Path:
    """A map of the packaged rooms and of copies of the box room, one for each of `keys`."""
    if root.exists():
        return root
    part = root.with_name(f".{root.name}")
    shutil.rmtree(part, ignore_errors=True)
    payload = Manifest.read(learned).payload
    *packaged, room = (str(stage) for stage in payload["stages"])
    networks = [str(name) for name in payload["networks"]]
    stages = [*packaged, *(f"{n:04d}-copy" for n in range(4, 4 + len(keys)))]
    part.mkdir(parents=True)
    for name in networks:
        shutil.copy(learned / name, part / name)
    stored = load_tensors(learned / STAGES / room / KEYFRAMES_FILE)
    scene = json.loads((learned / STAGES / room / SCENE).read_text())
    for number, stage in enumerate(tqdm(stages, unit="scene")):
        folder = part / STAGES / stage
        if number < len(packaged):
            shutil.copytree(learned / STAGES / stage, folder)
            continue
        shutil.copytree(learned / STAGES / room, folder)
        count = len(stored["lengths"])
        descriptors = np.resize(keys[number - len(packaged)], (count, keys.shape[-1]))
        save_tensors(folder / KEYFRAMES_FILE, {**stored, "descriptors": descriptors})
        (folder / SCENE).write_text(json.dumps({**scene, "name": stage}))
    files = [str(path.relative_to(part)) for path in part.rglob("*") if path.is_file()]
    write_manifest(part, {**payload, "stages": stages}, files)
    part.rename(root)
    return root


def _asked(root: Path) -> Row:
    """Time to open a map, memory, and time of its images, in a process of its own."""
    command = python_command("-c", _ASK, str(root))
    return json.loads(
        subprocess.run(command, check=True, capture_output=True, text=True).stdout
    )


_ASK = """
import json, re, sys, time
from pathlib import Path
import numpy as np
from evercal import Map
from evercal.recordings.samples import sample_rooms

def memory():
    text = Path("/proc/self/smaps_rollup").read_text()
    parts = {k: int(v) for k, v in re.findall(r"^(\\w+): +(\\d+) kB", text, re.M)}
    return parts["Private_Dirty"] / 1000

images = [(r.scene.name, f.read_image()) for r in sample_rooms() for f in r.scene.test[::10]]
before, began = memory(), time.perf_counter()
opened = Map.open(sys.argv[1])
opened.localizer
seconds, own = time.perf_counter() - began, memory() - before
times, right, wrong = [], 0, 0
for turn in range(2):
    for name, image in images:
        began = time.perf_counter()
        estimate = opened.localize(image)
        times.append(1000 * (time.perf_counter() - began))
        right += turn * (estimate.status == "ok" and estimate.scene == name)
        wrong += turn * (estimate.status == "ok" and estimate.scene != name)
row = {"open_s": seconds, "own_mb": own, "images": len(images), "right": right, "wrong": wrong}
print(json.dumps({**row, "median_ms": float(np.median(times[len(images):]))}))
"""


def _right(bank: KeyframeBank, queries: list[tuple[int, np.ndarray]]) -> Row:
    first = 0
    among = 0
    for scene, query in queries:
        (similarity,) = bank.similarity(query.astype(np.float32))
        proposed = bank.scene[bank.ranked(similarity, ATTEMPT.retrieved)]
        first = first + (proposed[0] == scene)
        among = among + (scene in proposed)
    count = len(queries)
    return {
        "images": count,
        "first": 100 * first / count,
        "proposed": 100 * among / count,
    }


def _ranked(bank: KeyframeBank, queries: list[np.ndarray]) -> None:
    for similarity in bank.similarity(*queries):
        bank.ranked(similarity, ATTEMPT.retrieved)


def _before(bank: KeyframeBank, queries: list[np.ndarray]) -> None:
    for query in queries:
        np.argsort(-(bank._descriptors @ query), kind="stable")


def _milliseconds(work: Callable[[], None], times: int = 10) -> float:
    spent = []
    for _ in range(times):
        began = time.perf_counter()
        work()
        spent.append(1000 * (time.perf_counter() - began))
    return float(np.median(spent))


def _bank(keys: np.ndarray) -> KeyframeBank:
    """A bank of descriptors (scenes, keyframes, width) alone; nothing can be loaded from it."""
    camera = default_camera()
    empty = (b"",) * keys.shape[1]
    poses = SE3.identity((keys.shape[1],))
    made = [
        Keyframes(empty, (camera,) * len(empty), poses, descriptors=each)
        for each in keys
    ]
    frame = MapFrame()
    scenes = [SceneMap(str(n), camera, camera, k, frame, 0) for n, k in enumerate(made)]
    return KeyframeBank(MapContents(load_encoder(), SIDE, scenes), 1)


def _packaged(encoder: Encoder) -> tuple[np.ndarray, list[np.ndarray]]:
    """Descriptors of 50 training images of each packaged room, and of its queries."""
    keys = []
    queries = []
    for room in sample_rooms():
        train = room.scene.train
        test = room.scene.test
        few = np.linspace(0, len(train) - 1, KEYFRAMES).astype(int)
        keys.append([_described(encoder, train[i].read_image()) for i in few])
        queries.append(
            np.array([_described(encoder, f.read_image()) for f in test[::10]])
        )
    return np.array(keys, np.float16), queries


def descriptors(out: Path, scenes: int) -> list[Path]:
    """Draw rooms and describe their keyframes; complete files are not repeated."""
    encoder = load_encoder()
    files = []
    for first in tqdm(range(0, scenes, AT_ONCE), unit="file"):
        file = out / f"rooms-{first:06d}.npz"
        files.append(file)
        if not file.exists():
            drawn = [_room(encoder, first + i) for i in range(AT_ONCE)]
            out.mkdir(parents=True, exist_ok=True)
            part = file.with_suffix(".part.npz")
            keys, queries = zip(*drawn, strict=True)
            np.savez(part, keyframes=np.stack(keys), queries=np.stack(queries))
            part.rename(file)
    return files


def _room(encoder: Encoder, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Descriptors (50, width) of the keyframes of a room, and (0 or 5, width) of queries."""
    room = BoxRoom(FIRST_SEED + number, texture_px=TEXTURE_PX)
    camera = default_camera()
    path = room.path(2 * KEYFRAMES, number)
    queries = QUERIES if number < QUERIED else 0
    numbers = [
        *range(0, 2 * KEYFRAMES, 2),
        *range(1, 2 * KEYFRAMES, 2 * KEYFRAMES // QUERIES),
    ]
    vectors = []
    for i in numbers[: KEYFRAMES + queries]:
        image = room.render(camera, path[i])
        vectors.append(_described(encoder, image))
    both = np.array(vectors, np.float16)
    return both[:KEYFRAMES], both[KEYFRAMES:]


def _described(encoder: Encoder, image: np.ndarray) -> np.ndarray:
    features = encoder.encode(image, SIDE).reshape(-1, encoder.width)
    return encoder.vlad()(features).astype(np.float16)
