"""`evercal demo`."""

import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from evercal.cli.console import print_json, print_next, progress_bar, size
from evercal.cli.device import Device
from evercal.errors import InputError

if TYPE_CHECKING:
    from evercal.continual.learn_scene import LearnReport
    from evercal.continual.stage import StageOptions
    from evercal.localization.localizer import Localizer
    from evercal.recordings import Recording
    from evercal.recordings.samples import SampleRoom
    from evercal.reports.demo_outcome import DemoOutcome

STORE = "store"
QUERY = "query.png"

Say = Callable[[str], None]


@dataclass(frozen=True)
class Demo:
    """Learn three rendered rooms, locate cameras in them to the millimetre, and write a report."""

    out: Annotated[Path, arg(metavar="DIR")] = Path("evercal-demo")
    """Folder for report.html, overview.png, the store and an image to try it with."""
    compare: bool = False
    """Train two networks on the same rooms as well, and compare what they remember; this takes some
    minutes more."""
    device: Device = "auto"
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        """Takes about a minute on two cores, and some minutes more with --compare."""
        options = DemoOptions(self.compare, device=self.device)
        outcome = run_demo(self.out, options, _quiet if self.json else _say)
        if self.json:
            print_json(outcome.to_dict())
            return 0
        print(f"wrote {self.out / 'report.html'} and {self.out / 'overview.png'}")
        print_next("evercal", "localize", self.out / STORE, self.out / QUERY)
        return 0


@dataclass(frozen=True)
class DemoOptions:
    """How much the demo does."""

    compare: bool = False
    """Train the networks of fine-tuning and of SARS + SPDD as well."""
    rooms: "tuple[SampleRoom, ...] | None" = None
    """Two or more; those that come with the package when None."""
    device: str = "auto"
    """What networks run on, see `features.device.device_of`."""


def _say(line: str) -> None:
    print(line, flush=True)


def _quiet(line: str) -> None:
    """In place of `print` where stdout is for JSON."""


def run_demo(out: Path, options: DemoOptions, say: Say = _quiet) -> "DemoOutcome":
    """Learns the rooms, measures, and writes pictures and report.

    Args:
        out: folder for the results; made when missing, results of an earlier demo are replaced.
        options: how much.
        say: told in a line what happens and what came out.

    Raises:
        InputError: `out` holds something else under a name that the demo needs, or no such device.
    """
    from evercal.features.device import device_of
    from evercal.localization.localizer import Localizer
    from evercal.recordings import write_image
    from evercal.recordings.samples import sample_rooms
    from evercal.reports.demo_outcome import MAP, METHODS, DemoOutcome
    from evercal.reports.demo_page import write_pictures
    from evercal.storage import MANIFEST, replace_folder

    began, store = time.perf_counter(), out / STORE
    if store.exists() and not (store / MANIFEST).is_file():
        raise InputError(f"{store}: exists and is not an evercal store; give another --out")
    device_of(options.device)  # refused before anything is learned
    out.mkdir(parents=True, exist_ok=True)
    rooms = options.rooms or sample_rooms()
    scenes = [room.scene for room in rooms]
    outcome = DemoOutcome([scene.name for scene in scenes])
    work = Path(tempfile.mkdtemp(prefix=".demo-", dir=out))
    try:
        for method in METHODS if options.compare else (MAP,):
            _learn_rooms(work / method, method, scenes, _Teller(outcome, say, options))
        replace_folder(work / MAP, store)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    localizer = Localizer.open(store, device=options.device)
    _measure(localizer, rooms, outcome, say)
    write_pictures(out, localizer, rooms, outcome)
    middle = scenes[0].test[len(scenes[0].test) // 2]
    write_image(out / QUERY, middle.read_image())
    outcome.seconds = time.perf_counter() - began
    say(f"all of this took {outcome.seconds:.0f} s")
    return outcome


@dataclass(frozen=True)
class _Teller:
    """Where results go."""

    outcome: "DemoOutcome"
    say: Say
    options: DemoOptions


def _learn_rooms(store: Path, method: str, scenes: "Sequence[Recording]", teller: _Teller) -> None:
    """Learns the rooms one after the other; where methods are compared, evaluates after each."""
    from evercal.cli.learn_bars import LearnBars
    from evercal.continual.learn_scene import LearnOptions, learn_scene
    from evercal.continual.strategies import STRATEGIES
    from evercal.localization.localizer import Localizer
    from evercal.reports.demo_outcome import MAP, METHODS

    outcome, say, seconds = teller.outcome, teller.say, 0.0
    for i, scene in enumerate(scenes):
        say(f"{METHODS[method]}: learning {scene.name} from {len(scene.train)} posed images")
        began = time.perf_counter()
        options = LearnOptions(_stage(method), STRATEGIES[method], device=teller.options.device)
        with LearnBars() as bars:
            report = learn_scene(store, scene, options, bars)
        seconds += time.perf_counter() - began
        if method == MAP:
            _note_map(report, outcome, say)
        else:
            say(f"  {report.iterations} training steps in {report.seconds / 60:.1f} minutes")
        if teller.options.compare:
            localizer = Localizer.open(store, device=teller.options.device)
            row = _accuracies(localizer, scenes[: i + 1])
            outcome.accuracy.setdefault(method, []).append(row)
    outcome.minutes[method] = seconds / 60


def _stage(method: str) -> "StageOptions":
    from evercal.continual.presets import preset
    from evercal.reports.demo_outcome import MAP

    return preset("fast" if method == MAP else "demo")


def _note_map(report: "LearnReport", outcome: "DemoOutcome", say: Say) -> None:
    from evercal.reports.demo_outcome import LearnedRoom

    adjusted = report.adjusted
    residual = adjusted.residual_px if adjusted is not None else float("nan")
    frames, kept, marks = report.train_frames, report.frames_kept, report.landmarks
    room = LearnedRoom(report.scene, frames, kept, marks, residual, report.seconds)
    outcome.learned.append(room)
    outcome.memory_bytes = report.memory_bytes
    say(
        f"  {kept} keyframes with {marks} landmarks in {report.seconds:.0f} s; after bundle"
        f" adjustment the median reprojection error is {residual:.2f} px; all rooms take"
        f" {size(report.memory_bytes)}"
    )


def _accuracies(localizer: "Localizer", scenes: "Sequence[Recording]") -> list[float]:
    """Per cent of test images within 5 cm and 5 deg, for each scene."""
    from evercal.evaluation import evaluate, scores

    count = sum(len(scene.test) for scene in scenes)
    with progress_bar("evaluating", count, "image") as bar:

        def show(done: int, total: int) -> None:
            bar.update(done - bar.n)

        named = {scene.name: scene for scene in scenes}
        results = evaluate(localizer, named, on_frame=show)
    rows = scores(results).scenes
    return [rows[scene.name].accuracy_5cm_5deg for scene in scenes]


def _measure(
    localizer: "Localizer", rooms: "Sequence[SampleRoom]", outcome: "DemoOutcome", say: Say
) -> None:
    """Asks the map everything that the report shows, and says it in sentences."""
    from evercal.reports import demo_sentences as told
    from evercal.reports.demo_measurements import Look

    if outcome.accuracy:
        say(outcome.table())
    with progress_bar("locating", 0, "image") as bar:
        look = Look(localizer, rooms, bar.update)
        bar.total = look.images()
        steps = (
            (look.locate_test_images, told.about_test_images),
            (look.locate_changed_rooms, told.about_changed_rooms),
            (look.find_fixed_cameras, told.about_fixed_cameras),
            (look.show_unknown_room, told.about_unknown_room),
        )
        for measure, sentences in steps:
            measure(outcome)
            bar.clear()
            for line in sentences(outcome):
                say(line)
