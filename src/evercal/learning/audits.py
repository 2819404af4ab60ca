"""Audit of a data set: episodes in worker processes, with results as lines of a file."""

import json
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path

from evercal.calibration.audit_by_arm import ArmAudit, Audited
from evercal.geometry import SE3
from evercal.learning.many import each_done
from evercal.learning.task import Item
from evercal.recordings.episodes.episode import Episode, Numbers
from evercal.recordings.poses.conventions import poses_from_numbers
from evercal.storage.text_files import named_errors

KNOWN = 2
"""Latest poses of a camera that are starts for its next episode."""


def audit_episodes(
    audit: ArmAudit,
    episodes: Iterable[Episode],
    rows: Path | None = None,
    workers: int = 1,
    ray: str | None = None,
) -> Iterator[Audited]:
    """Audit episodes, and yield results as they are ready.

    Args:
        audit: The robot, and how poses are compared.
        episodes: They are read while others are audited.
        rows: File of the results so far, a line for each; those in it are not audited again.
        workers: Processes; 1 for none beside this one.
        ray: Address of a Ray cluster, whose workers audit instead.
    """
    known: dict[str, list[SE3]] = {}
    done = set()

    def items() -> Iterator[Item]:
        for number, episode in enumerate(episodes):
            if (episode.name, episode.camera) not in done:
                yield number, (episode, known.get(episode.camera, [])[-KNOWN:])

    for result in _results(rows):
        done.add((result.episode, result.camera))
        yield result
    if workers == 1 and ray is None:
        results = (audit.done(*item) for item in items())
    else:
        results = each_done(audit, items(), workers, ray)
    for result in results:
        if result.corrected:
            convention = audit.convention_of(result.stated)
            pose = poses_from_numbers(result.corrected, convention)
            known.setdefault(result.camera, []).append(pose)
        if rows is not None:
            with open(rows, "a", encoding="utf-8") as file:
                file.write(f"\n{json.dumps(asdict(result))}")
        yield result


def _results(rows: Path | None) -> Iterator[Audited]:
    """The results in a file."""
    if rows is None or not rows.exists():
        return
    with named_errors(rows, "results"):
        for line in rows.read_text("utf-8").splitlines():
            with suppress(json.JSONDecodeError):  # a kill cut it off
                record = json.loads(line)
                for name in ("stated", "corrected"):
                    record[name] = tuple(record[name])
                yield Audited(**record)


def with_moves(results: Iterable[Audited]) -> list[Audited]:
    """Results by camera and name, with the episode since which a camera stands elsewhere."""
    named = []
    right = set()
    since: dict[object, str] = {}
    for result in sorted(results, key=lambda result: (result.camera, result.episode)):
        what = result.camera, result.stated
        if result.verdict == "right":
            right.add(what)
            since.pop(what, None)
        elif result.verdict == "wrong" and not result.mistake and what in right:
            first = since.setdefault(what, result.episode)
            result = replace(result, mistake=f"moved since {first}")
        named.append(result)
    return named


def corrections(results: Iterable[Audited]) -> dict[str, dict[str, Numbers]]:
    """Camera poses by episode and camera in the notation of the data set.

    They are as stated where that is right, else as the images show them.
    """
    poses: dict[str, dict[str, Numbers]] = {}
    for result in results:
        pose = result.corrected
        if result.verdict == "right":
            pose = result.stated
        if pose:
            poses.setdefault(result.episode, {})[result.camera] = pose
    return poses
