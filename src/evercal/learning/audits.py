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
from evercal.recordings.episodes.episode import Episode
from evercal.recordings.poses.conventions import poses_from_numbers
from evercal.storage.text_files import named_errors

KNOWN = 2
"""Latest poses of a camera that are starts for its next episode."""


def audit_episodes(
    audit: ArmAudit,
    episodes: Iterable[Episode],
    rows: Path,
    workers: int = 1,
    ray: str | None = None,
) -> Iterator[Audited]:
    """Audit episodes, and yield results as they are ready.

    Args:
        audit: How poses are compared.
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
        with open(rows, "a", encoding="utf-8") as file:
            file.write(f"\n{json.dumps(asdict(result))}")
        yield result


def _results(rows: Path) -> Iterator[Audited]:
    """The results in a file."""
    with open(rows, "a+", encoding="utf-8") as file, named_errors(rows, "results"):
        file.seek(0)
        for line in file:
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
