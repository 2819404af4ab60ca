"""Published results: one small file of numbers from which a table of the docs is generated.

    results/NAME.jsonl    first line: name, kind, note, settings and their hash
                          kind `bench`: a line per strategy, seed, stage and scene, values in the
                          order of `fields` of the first line
                          kind `rows`: flat rows of any measurement

Errors of the last stage are stored frame by frame, rounded down to 0.1 mm and 0.001 deg. Accuracy
thresholds are multiples of these, so no frame changes between right and wrong. Earlier stages are
stored as counts.
"""

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Literal

import numpy as np

from evercal.continual.benchmark import results
from evercal.continual.benchmark.results import SceneResult
from evercal.errors import InputError
from evercal.evaluation.metrics import CHI2_6, COARSE, FINE, FINEST, MIDDLE
from evercal.storage import write_bytes
from evercal.storage.settings import read_settings

LOOSE = (0.10, math.radians(10.0))
"""10 cm and 10 deg, in metres and radians."""
COUNTED = (LOOSE, COARSE, MIDDLE, FINE, FINEST)
"""Thresholds for which correct frames are counted, metres and radians."""
LARGEST_BYTES = 500_000
"""Limit of a file's size."""
Row = Mapping[str, str | float | int | bool | None]
"""A flat row of a measurement."""


@dataclass(frozen=True)
class PublishedScene:
    """Results of one scene's test frames after one stage of one run, in few numbers."""

    strategy: str
    """Name of the strategy."""
    seed: int
    """Seed of the run."""
    stage: int
    """Scenes learned before this stage."""
    scene: str
    """Scene of the test frames."""
    frames: int
    """Number of test frames."""
    within: tuple[int, ...]
    """Correct frames under each of `COUNTED`."""
    median_mm: float
    """Median translation error; infinite if most frames have no pose in the right scene."""
    median_deg: float
    """Median rotation error; infinite if most frames have no pose in the right scene."""
    wrong_scene: int
    """Frames with a pose in another scene."""
    refused: int
    """Frames without a pose."""
    stated_95: int
    """Frames with a pose in the right scene and a covariance."""
    inside_95: int
    """Frames whose true pose lies in the 95 % ellipsoid."""
    seconds: float
    """Wall time of the stage."""
    memory_bytes: int
    """Bytes remembered of all scenes."""
    head_bytes: int
    """Bytes of all heads."""
    frames_kept: int
    """Frames remembered of the stage's scene."""
    covering_radius: float = math.nan
    """See `SceneResult`."""
    min_spacing: float = math.nan
    """See `SceneResult`."""
    tenth_mm: tuple[int | None, ...] = ()
    """Last stage: error of each frame in tenths of a millimetre, rounded down."""
    mdeg: tuple[int | None, ...] = ()
    """Last stage: error of each frame in thousandths of a degree, rounded down."""
    environment: str = ""
    """Key of the record in `Published.environments`."""
    state: str = ""
    """Last stage, a letter per frame: `w` wrong scene, `r` refused, `i` inside the ellipsoid, `o`
    outside, `p` a pose without covariance."""

    @property
    def keyframe_positions_m(self) -> tuple[tuple[float, float, float], ...]:
        """Empty: not published."""
        return ()

    def accuracy(self, thresholds: tuple[float, float] = COARSE) -> float:
        """Return the share of correct frames under one of `COUNTED`, 0 to 1.

        Raises:
            KeyError: Other thresholds.
        """
        for counted, count in zip(COUNTED, self.within, strict=True):
            if np.allclose(counted, thresholds, rtol=1e-9):
                return count / self.frames
        raise KeyError(f"frames within {thresholds} were not counted")

    def by_frame(self, frames: tuple[str, ...]) -> SceneResult:
        """Restore the results of the last stage frame by frame.

        Args:
            frames: Names of the test frames.
        """

        def restored(values: Sequence[int | None], unit: float) -> tuple[float, ...]:
            return tuple(math.inf if v is None else (v + 0.5) * unit for v in values)

        squared = {"i": 0.0, "o": math.inf}
        return SceneResult(
            frames=frames,
            translation_m=restored(self.tenth_mm, 1e-4),
            rotation_rad=restored(self.mdeg, math.radians(1e-3)),
            wrong_scene=tuple(letter == "w" for letter in self.state),
            near_training_frame=(False,) * self.frames,  # not published
            squared_mahalanobis=tuple(squared.get(letter, math.nan) for letter in self.state),
            **{name: getattr(self, name) for name in _COMMON},
        )


_COMMON = (
    *("strategy", "seed", "stage", "scene", "seconds", "memory_bytes", "head_bytes"),
    *("frames_kept", "covering_radius", "min_spacing", "environment"),
)
"""Fields that `SceneResult` and `PublishedScene` share."""


@dataclass(frozen=True)
class Published:
    """A file of results."""

    name: str
    """Name of the file."""
    kind: Literal["bench", "rows"]
    """Kind of its lines."""
    settings: Mapping[str, object]
    """Settings that decide the results; empty if they were not recorded."""
    note: str = ""
    """A remark for the reader."""
    groups: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Kind `rows`: rows that a table averages, by title."""
    frames: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Kind `bench`: names of each scene's test frames in recorded order."""
    strategies: Mapping[str, Mapping[str, object]] = field(default_factory=dict)
    """Kind `bench`: `Strategy.description` of each strategy."""
    environments: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    """Commit, versions and processor of the runs, by key; empty if they were not recorded."""
    scenes: tuple[PublishedScene, ...] = ()
    """Lines of kind `bench`."""
    rows: tuple[Row, ...] = ()
    """Lines of kind `rows`."""

    @property
    def settings_sha256(self) -> str:
        """Hash of the settings as sorted JSON."""
        text = json.dumps(self.settings, sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()

    def results(self) -> list[SceneResult | PublishedScene]:
        """Return all results for `comparison.runs_of`, the last stage frame by frame."""
        return [s.by_frame(self.frames[s.scene]) if s.state else s for s in self.scenes]


def from_bench(folder: Path, name: str, note: str = "") -> Published:
    """Summarize the complete runs of a benchmark folder.

    Raises:
        InputError: No run is complete, a line is broken, or runs use different test frames.
    """
    lines = results.read(folder)
    last = max((line.stage for line in lines), default=-1)
    complete = {(line.strategy, line.seed) for line in lines if line.stage == last}
    if not complete:
        raise InputError(f"{folder}: no run is complete; continue with 'evercal bench'")
    frames = {line.scene: line.frames for line in lines if line.stage == last}
    lines = [line for line in lines if (line.strategy, line.seed) in complete]
    for line in lines:
        if line.frames != frames[line.scene]:
            raise InputError(f"{folder}: runs use different test frames of {line.scene}")
    names = {line.strategy.partition(":")[0] for line in lines}
    keys = {line.environment for line in lines}
    environments = {k: v for k, v in results.read_environments(folder).items() if k in keys}
    return Published(
        name,
        "bench",
        read_settings(folder / results.SETTINGS),
        note,
        frames=frames,
        strategies={k: v for k, v in results.read_strategies(folder).items() if k in names},
        environments=environments,
        scenes=tuple(_counted(line, line.stage == last) for line in lines),
    )


def write_published(folder: Path, published: Published) -> Path:
    """Write `FOLDER/NAME.jsonl`.

    Raises:
        InputError: The file would exceed `LARGEST_BYTES`.
    """
    keys = ("name", "kind", "note", "settings_sha256", "settings")
    header = {key: getattr(published, key) for key in keys}
    for key in ("groups", "frames", "strategies", "environments"):
        if getattr(published, key):
            header[key] = getattr(published, key)
    if published.kind == "bench":
        header["fields"] = _FIELDS
    lines = [header, *map(_to_line, published.scenes), *map(dict, published.rows)]
    text = "".join(json.dumps(o, allow_nan=False, separators=(",", ":")) + "\n" for o in lines)
    if len(text) > LARGEST_BYTES:
        raise InputError(
            f"{published.name}: {len(text) / 1e3:.0f} kB; at most {LARGEST_BYTES / 1e3:.0f} are"
            " allowed; publish fewer strategies, or two tables"
        )
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{published.name}.jsonl"
    write_bytes(path, text.encode())
    return path


def read_published(path: Path) -> Published:
    """Read a file of `write_published`.

    Raises:
        InputError: No such file, a broken line, or settings that do not match their hash.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError:
        raise InputError(f"{path}: no such results; make them with 'benchmarks publish'") from None
    number = 1
    try:
        header = json.loads(lines[0])
        stated = header.pop("settings_sha256")
        if header.pop("fields", _FIELDS) != _FIELDS:
            raise ValueError("other fields")
        for key in ("groups", "frames"):
            header[key] = {k: tuple(v) for k, v in header.get(key, {}).items()}
        scenes: list[PublishedScene] = []
        rows: list[Row] = []
        for number, line in enumerate(lines[1:], start=2):  # noqa: B007  # for the message
            if header["kind"] == "bench":
                scenes.append(_from_line(json.loads(line)))
            else:
                rows.append(dict(json.loads(line)))
        published = Published(**header, scenes=tuple(scenes), rows=tuple(rows))
    except (ValueError, TypeError, KeyError, IndexError) as error:
        raise InputError(f"{path}: line {number} is not a published result ({error!r})") from error
    if published.settings_sha256 != stated:
        raise InputError(f"{path}: the settings do not match their hash; publish the results again")
    return published


def _counted(result: SceneResult, frame_by_frame: bool) -> PublishedScene:
    squared = np.array(result.squared_mahalanobis or (math.nan,) * len(result.frames))
    metres, radians = np.array(result.translation_m), np.array(result.rotation_rad)
    state = np.where(np.isnan(squared), "p", np.where(squared < CHI2_6, "i", "o"))
    state[result.refused], state[np.array(result.wrong_scene, bool)] = "r", "w"
    middle = len(metres) // 2
    common = {name: getattr(result, name) for name in _COMMON}
    for key, digits in (("seconds", 1), ("covering_radius", 4), ("min_spacing", 4)):
        # NaN stays `math.nan` itself, so that equal results compare equal.
        common[key] = math.nan if math.isnan(common[key]) else round(common[key], digits)
    return PublishedScene(
        frames=len(result.frames),
        within=tuple(int(result.correct(thresholds).sum()) for thresholds in COUNTED),
        median_mm=round(1000 * sorted(result.translation_m)[middle], 3),
        median_deg=round(math.degrees(sorted(result.rotation_rad)[middle]), 4),
        wrong_scene=sum(result.wrong_scene),
        refused=int(result.refused.sum()),
        stated_95=int((~np.isnan(squared)).sum()),
        inside_95=int((squared < CHI2_6).sum()),
        tenth_mm=_floored(metres * 1e4) if frame_by_frame else (),
        mdeg=_floored(np.rad2deg(radians) * 1e3) if frame_by_frame else (),
        state="".join(state) if frame_by_frame else "",
        **common,
    )


def _floored(values: np.ndarray) -> tuple[int | None, ...]:
    return tuple(math.floor(v) if math.isfinite(v) else None for v in values.tolist())


_FIELDS = [item.name for item in fields(PublishedScene)]
_INFINITE = ("median_mm", "median_deg")
"""Fields in which None stands for infinity; elsewhere it stands for NaN."""


def _to_line(scene: PublishedScene) -> list[object]:
    """List the values in the order of the fields, without unknown values at the end."""
    values = list(asdict(scene).values())
    while values[-1] in ((), "") or values[-1] is math.nan:
        values.pop()
    return [None if isinstance(v, float) and not math.isfinite(v) else v for v in values]


def _from_line(values: list[object]) -> PublishedScene:
    if not isinstance(values, list) or len(values) > len(_FIELDS):
        raise ValueError("other fields")
    record = dict(zip(_FIELDS, values, strict=False))
    for key, value in record.items():
        if isinstance(value, list):
            record[key] = tuple(value)
        elif value is None:
            record[key] = math.inf if key in _INFINITE else math.nan
    return PublishedScene(**record)  # pyright: ignore[reportArgumentType]
