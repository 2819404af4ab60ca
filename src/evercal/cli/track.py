"""`evercal track`."""

from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from evercal.classes import frozen
from evercal.cli import args
from evercal.cli.console import numbers, require_writable, say
from evercal.errors import InputError
from evercal.reports.answers import unit_known

if TYPE_CHECKING:
    from evercal.localization.tracking import TrackedFrame

FEW_FRAMES = 10
"""Number of frames below which motion is not judged."""
MOST_RELOCALIZED = 1 / 3
"""Share of frames located from nothing above which the motion is too fast."""


@frozen
class Track(args.Verb):
    """Locate the frames of a camera, video or folder one after another.

    The last pose is the prior of the next one: a tracked frame takes less than half the time of a
    single image. Exit code 1 if no frame was located.

    Example: evercal track cell.evercal video.mp4 --out track.tum
    """

    store: args.Store
    source: Annotated[Positional[str], arg(metavar="SOURCE")]
    """Number (0) or device of a camera, an address (rtsp://...), a topic of ROS 2
    (ros2:/camera/image_raw), a video file or a folder."""
    out: Annotated[tuple[Path, ...], args.shown("FILE...", "(default: none)")] = ()
    """Files to write: .jsonl (JSON lines), .tum or .txt (TUM)."""
    scene: args.Scenes = ()
    camera: args.File = None
    """Intrinsics. Default: those of camera_info for a topic, else those of the camera that recorded
    the scene."""
    publish: Annotated[tuple[str, str] | None, args.shown("BASE CAMERA")] = None
    """Publish the poses in ROS 2 as tf and PoseWithCovarianceStamped: names of both frames."""
    at_most: Annotated[float | None, args.shown("MS")] = None
    """Time for a frame, milliseconds. What was left out is in the answer (`omitted`)."""
    smooth: Annotated[float, arg(metavar="SECONDS")] = 0.0
    """Time constant of smoothed poses; 0 writes measurements. A jump is followed at once."""
    rate: Annotated[float, arg(metavar="HZ")] = 15.0
    """Frames per second of a folder without times in its file names."""
    most: args.Count = None
    """Stop after so many frames."""

    def run(self) -> int:
        late = self.at_most is not None and self.at_most <= 0
        if late or self.rate <= 0 or self.smooth < 0:
            raise InputError("--rate and --at-most are above 0, --smooth is 0 or more")
        for path in self.out:
            require_writable(path, "--out")
        from evercal.live.sources import open_camera
        from evercal.localization.tracking import Tracker, TrackOptions
        from evercal.reports.track_files import TrackFile, track_row

        source = open_camera(self.source, self.rate, timeout_s=None)
        options = TrackOptions(
            fallback_s=1 / self.rate, at_most_ms=self.at_most, smooth=self.smooth
        )
        tracker: Tracker | None = None
        publisher = None
        if self.publish:
            from evercal.live.ros2.publishing import PosePublisher

            publisher = PosePublisher(*self.publish, static=False)
        states: Counter[str] = Counter()
        times: list[float] = []
        with source as frames, ExitStack() as stack:
            localizer = args.open_map(self.store, self.scene)
            files = [stack.enter_context(TrackFile(path)) for path in self.out]
            try:
                for name, stamp, image, _ in frames:
                    if not tracker:
                        size = (image.shape[1], image.shape[0])
                        camera = args.stated_camera(self.camera, size)
                        camera = camera or source.intrinsics()
                        tracker = Tracker(localizer, camera, options)
                    frame = tracker.track(image, stamp)
                    states[frame.state] += 1
                    times.append(frame.estimate.milliseconds)
                    known = unit_known(localizer, frame.estimate.scene)
                    for file in files:
                        file.write(frame, track_row(frame, name, known))
                    pose = frame.estimate.uncertain_pose
                    if publisher and pose and frame.state != "lost":
                        publisher.publish(pose, stamp)
                    if not self.json:
                        say(_line(name, frame, known))
                    if self.most is not None and len(times) >= self.most:
                        break
            except KeyboardInterrupt:
                pass
        if not times:
            raise InputError(f"{self.source}: no frame could be read")
        self._summary(states, times)
        return 0 if states["tracking"] + states["relocalized"] else 1

    def _summary(self, states: Counter[str], times: list[float]) -> None:
        import numpy as np

        middle, high = np.quantile(times, [0.5, 0.99]).tolist()
        tracked = states["tracking"]
        relocalized = states["relocalized"]
        lost = states["lost"]
        record: dict[str, object] = {
            "frames": len(times),
            "tracking": tracked,
            "relocalized": relocalized,
            "lost": lost,
            "ms_p50": middle,
            "ms_p99": high,
            "out": list(map(str, self.out)),
        }
        line = (
            f"{len(times)} frames: {tracked} tracked, {relocalized} relocalized, {lost} lost;"
            f" {middle:.0f} ms (median), {high:.0f} ms (99 %)"
        )
        lines = [line]
        if len(times) >= FEW_FRAMES and relocalized > MOST_RELOCALIZED * len(times):
            lines.append(
                f"warning: {relocalized} of {len(times)} frames are located from nothing: the view"
                " changes too much from frame to frame; give more frames a second, or move more"
                " slowly"
            )
        record["warnings"] = lines[1:]
        then: tuple[object, ...] = ()
        if not self.out:
            then = ("track", self.store, self.source, "--out", "track.jsonl")
        self.answer(record, *lines, then=then)


def _line(name: str, frame: "TrackedFrame", unit_known: bool) -> str:
    estimate = frame.estimate
    if frame.state == "lost" or not estimate.base_from_camera:
        return f"{name}: lost ({estimate.reason or estimate.status})"
    position = estimate.base_from_camera.translation_m
    pose = estimate.uncertain_pose
    where = f"{numbers(position, '+.4g')} in an unknown unit"
    if unit_known and pose:
        where = f"{numbers(1e3 * position, '+.1f')} +- {pose.sigma_mm:.1f} mm"
    line = f"{name}: {frame.state}, {estimate.scene}, {where}"
    line += f", {estimate.milliseconds:.0f} ms"
    if estimate.omitted:
        line += f", without {', '.join(estimate.omitted)}"
    return line
