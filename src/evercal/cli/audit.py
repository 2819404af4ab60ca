"""`evercal audit`."""

import dataclasses
import hashlib
from collections import Counter
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional

from evercal.classes import frozen
from evercal.cli import args
from evercal.cli.console import require_writable
from evercal.errors import InputError
from evercal.progress import progress_bar

if TYPE_CHECKING:
    from evercal.calibration.audit_by_arm import Audited

Tolerance = Annotated[float | None, args.shown("N")]


@frozen
class Audit(args.Verb):
    """List recorded episodes whose stated camera pose is wrong.

    The pose is compared with the images of the episode: by a map of the scene, or with --urdf by
    the robot arm that they show, in a LeRobot data set or a folder in DROID's layout. Exit code 1
    if any is wrong.

    Example: evercal audit cell.evercal episodes/ --calibration tripod.json
    """

    writes = ("out",)
    folders: Annotated[Positional[tuple[Path, ...]], args.shown("[MAP] DIR")] = ()
    """A map and the folder of the episodes: recorded scenes, or images beside a calibration.json or
    a 4x4 matrix base_from_camera.txt. With --urdf, the folder of the data set only."""
    calibration: args.File = None
    """Pose of the camera in episodes that state none themselves."""
    scene: args.Scenes = ()
    images: args.Count = None
    """Images per episode that are located. Default: 5; with --urdf 10."""
    most_mm: Tolerance = None
    """Tolerance of the position. Default: 5; with --urdf 20."""
    most_deg: Tolerance = None
    """Tolerance of the rotation. Default: 0.5; with --urdf 1."""
    urdf: args.File = None
    """URDF of the robot, with its meshes: the arm in the images shows the camera's pose."""
    camera: args.File = None
    """With --urdf: intrinsics of the cameras; for DROID also its intrinsics.json."""
    image_topic: args.Topic = None
    """With --urdf: audit this camera of a LeRobot data set only."""
    pose_convention: args.Name = None
    """With --urdf: how camera poses are stated. Default: rpy of six numbers, xyzw of seven, else
    matrix."""
    joints: Annotated[str | None, args.shown("rad|deg")] = None
    """With --urdf: unit of the joint values. Default: rad."""
    without: Annotated[tuple[str, ...], args.shown("LINK")] = ()
    """With --urdf: links that are not mounted."""
    out: args.File = None
    """With --urdf: write the camera poses of all episodes here, corrected where they are wrong.
    Results so far are beside it, so that the same command goes on after a stop."""
    workers: args.Count = None
    """With --urdf: processes. Default: one for each core."""
    ray: args.Address = None
    """With --urdf: audit on a Ray cluster: auto, HOST:PORT or ray://HOST:PORT. All its machines
    reach the data set."""

    def run(self) -> int:
        numbers = (self.images, self.most_mm, self.most_deg)
        if any(number is not None and number <= 0 for number in numbers):
            raise InputError(
                "--images is at least 1, --most-mm and --most-deg are above 0"
            )
        if self.urdf is not None:
            return self._by_arm(self.urdf)
        if len(self.folders) != 2:
            raise InputError(
                "give MAP and DIR; or a data set alone, with --urdf and --camera"
            )
        from evercal.calibration.audit import audit, episode_folders

        store, folder = self.folders
        stated = args.transform_of(self.calibration)
        total = len(episode_folders(folder))
        localizer = args.open_map(store, self.scene)
        most = (self.most_mm or 5.0, self.most_deg or 0.5)
        with progress_bar("episodes", total, "episode") as bar:
            episodes = audit(
                localizer, folder, stated, self.images or 5, most, bar.update
            )
        wrong = 0
        records = []
        lines = []
        for episode in episodes:
            wrong += episode.verdict == "wrong"
            records.append(dataclasses.asdict(episode))
            lines.append(f"{episode.verdict:8s} {episode.name}: {episode.reason}")
        lines.append(f"{wrong} of {len(episodes)} episodes state a wrong camera pose")
        self.answer({"episodes": records}, *lines)
        return 1 if wrong else 0

    def _by_arm(self, urdf: Path) -> int:
        if len(self.folders) != 1 or not self.camera or not self.out:
            raise InputError(
                "--urdf: give the folder of one data set, intrinsics with --camera, and --out"
            )
        require_writable(self.out, "--out")
        from evercal.calibration.audit_by_arm import ArmAudit
        from evercal.calibration.episode_images import EpisodeImages
        from evercal.learning.audits import audit_episodes, with_moves
        from evercal.processes import cores
        from evercal.recordings.episodes import episodes_in
        from evercal.recordings.poses.conventions import pose_convention
        from evercal.recordings.read_options import ReadOptions
        from evercal.robot.link_shapes import robot_body
        from evercal.robot.robot_model import RobotModel
        from evercal.storage.text_files import named_errors

        model = RobotModel(urdf)
        options = ReadOptions(image_topic=self.image_topic, pose_convention=self.joints)
        count = self.images or 10
        total, episodes = episodes_in(
            self.folders[0], model, self.camera, options, count
        )
        convention = None
        if self.pose_convention:
            with named_errors("--pose-convention", "convention"):
                convention = pose_convention(self.pose_convention)
        audit = ArmAudit(
            partial(EpisodeImages, robot_body(model, (), without=self.without)),
            convention,
            args.transform_of(self.calibration),
            (self.most_mm or 20.0, self.most_deg or 1.0),
        )
        # Other options have other results.
        asked = {**self.given, "workers": None, "ray": None, "json": None}
        asked |= {"files": (urdf.read_bytes(), self.camera.read_bytes())}
        digest = hashlib.sha256(repr(asked).encode()).hexdigest()[:8]
        rows = self.out.with_suffix(f".{digest}.rows")
        results = []
        with progress_bar("episodes", total, "camera") as bar:
            for result in audit_episodes(
                audit, episodes, rows, self.workers or cores(), self.ray
            ):
                results.append(result)
                bar.update()
        return self._corrected(with_moves(results), self.out)

    def _corrected(self, results: "list[Audited]", out: Path) -> int:
        from evercal.storage import write_json

        record = {"extrinsics": {}, "episodes": []}
        lines = []
        mistakes = Counter[str]()
        for result in results:
            record["episodes"].append(dataclasses.asdict(result))
            mistakes[result.verdict] += 1
            if result.corrected:
                poses = record["extrinsics"].setdefault(result.episode, {})
                poses[result.camera] = result.corrected
            if result.verdict != "right":
                what = f"{result.mistake}: " if result.mistake else ""
                where = f"{result.episode} {result.camera}"
                lines.append(f"{result.verdict:8s} {where}: {what}{result.reason}")
        write_json(out, record)
        wrong = mistakes["wrong"]
        line = f"{wrong} of {len(results)} camera poses are wrong"
        self.answer(record, *lines, f"{line}, {mistakes['unknown']} unknown")
        return 1 if wrong else 0
