"""`evercal demo`."""

import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from evercal.cli.console import print_json, print_next
from evercal.errors import InputError
from evercal.reports.demo_outcome import METHODS, DemoOutcome, FixedCamera

if TYPE_CHECKING:
    from evercal.continual.learn import StageOptions
    from evercal.datasets import Scene
    from evercal.localization.localizer import Localizer
    from evercal.simulation.mini import CellRoom

STORE = "store"
QUERY = "query.png"


@dataclass(frozen=True)
class Demo:
    """Learn three rendered rooms one by one, with evercal and with plain fine-tuning."""

    out: Annotated[Path, arg(metavar="DIR")] = Path("evercal-demo")
    """Folder for report.html, overview.png, a store and an image to try it with."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        """Takes some minutes on two cores."""
        say = _quiet if self.json else print
        outcome = run_demo(self.out, DemoOptions(), say)
        if self.json:
            print_json(outcome.to_dict())
            return 0
        print(outcome.table())
        if outcome.fixed:
            print(outcome.fixed_table())
        print(f"wrote {self.out / 'report.html'} and {self.out / 'overview.png'}")
        print_next("evercal", "localize", self.out / STORE, self.out / QUERY)
        return 0


@dataclass(frozen=True)
class DemoOptions:
    """How much the demo does."""

    rooms: "tuple[CellRoom, ...] | None" = None
    """Two or more; those that come with the package when None."""
    stage: "StageOptions | None" = None
    """How a room is learned; the preset `demo` when None."""


def _quiet(line: str) -> None:
    """In place of `print` where stdout is for JSON."""


def run_demo(out: Path, options: DemoOptions, say: Callable[[str], None] = _quiet) -> DemoOutcome:
    """Learns the rooms with both methods, evaluates after each, and writes pictures and report.

    Args:
        out: folder for the results; made when missing, results of an earlier demo are replaced.
        options: how much.
        say: told in a line what comes next.

    Raises:
        InputError: `out` holds something else under a name that the demo needs.
    """
    from evercal.datasets import write_image
    from evercal.localization.localizer import Localizer
    from evercal.reports.demo_page import write_pictures
    from evercal.simulation.mini import mini_rooms
    from evercal.storage import MANIFEST, replace_folder

    store = out / STORE
    if store.exists() and not (store / MANIFEST).is_file():
        raise InputError(f"{store}: exists and is not an evercal store; give another --out")
    out.mkdir(parents=True, exist_ok=True)
    rooms = options.rooms or mini_rooms()
    scenes = [room.scene for room in rooms]
    outcome = DemoOutcome([scene.name for scene in scenes])
    work = Path(tempfile.mkdtemp(prefix=".demo-", dir=out))
    try:
        # Stage 1 is the same training twice: a store says which strategy it was made with.
        for method in METHODS:
            _run_method(work / method, method, scenes, options, outcome, say)
        replace_folder(work / "evercal", store)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    localizer = Localizer.open(store)
    outcome.fixed = [_find_fixed(localizer, room) for room in rooms if room.fixed is not None]
    write_pictures(out, localizer, rooms, outcome)
    middle = scenes[0].test[len(scenes[0].test) // 2]
    write_image(out / QUERY, middle.read_image())
    return outcome


def _find_fixed(localizer: "Localizer", room: "CellRoom") -> FixedCamera:
    """One pose from all images of a camera that stands still, compared with the truth."""
    import numpy as np

    from evercal.geometry import SE3, average_poses, pose_distance

    assert room.fixed is not None
    frames, poses, inliers = room.fixed.test, [], []
    for frame in frames:
        estimate = localizer.localize(frame.read_image(), frame.camera)
        if estimate.scene == room.scene.name and estimate.base_from_camera is not None:
            poses.append(estimate.base_from_camera)
            inliers.append(estimate.inliers)
    truth = frames[0].base_from_camera
    if not poses or truth is None:
        return FixedCamera(room.scene.name, len(frames), len(poses), None, None)
    found = average_poses(SE3.stack(poses), np.array(inliers, float))
    metres, radians = pose_distance(found, truth)
    error = float(1000 * metres), float(np.rad2deg(radians))
    return FixedCamera(room.scene.name, len(frames), len(poses), *error)


def _run_method(
    store: Path,
    method: str,
    scenes: "list[Scene]",
    options: DemoOptions,
    outcome: DemoOutcome,
    say: Callable[[str], None],
) -> None:
    from evercal.cli.learn_bars import LearnBars
    from evercal.continual.learn_scene import LearnOptions, learn_scene
    from evercal.continual.presets import preset
    from evercal.localization.localizer import Localizer

    how = LearnOptions(options.stage or preset("demo"), method)
    outcome.accuracy[method], outcome.seconds[method] = [], []
    for i, scene in enumerate(scenes):
        say(f"{METHODS[method]}: learning {scene.name}")
        began = time.perf_counter()
        with LearnBars() as bars:
            report = learn_scene(store, scene, how, bars)
        outcome.seconds[method].append(time.perf_counter() - began)
        if method == "evercal":
            outcome.memory_bytes = report.memory_bytes
        row = _accuracies(Localizer.open(store), scenes[: i + 1])
        outcome.accuracy[method].append(row)


def _accuracies(localizer: "Localizer", scenes: "list[Scene]") -> list[float]:
    """Per cent of test frames within 5 cm and 5 deg, for each scene."""
    from evercal.cli.console import progress_bar
    from evercal.evaluation import evaluate, scores

    count = sum(len(scene.test) for scene in scenes)
    with progress_bar("evaluating", count, "image") as bar:

        def show(done: int, total: int) -> None:
            bar.update(done - bar.n)

        named = {scene.name: scene for scene in scenes}
        results = evaluate(localizer, named, on_frame=show)
    rows = scores(results).scenes
    return [rows[scene.name].accuracy_5cm_5deg for scene in scenes]
