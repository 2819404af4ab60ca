"""Audits of many episodes: results in a file, worker processes, and what episodes share."""

from pathlib import Path

import pytest

from evercal.calibration.audit_by_arm import ArmAudit, Audited, Source
from evercal.calibration.episode_images import EpisodeImages
from evercal.learning.audits import audit_episodes, with_moves
from evercal.recordings.episodes.episode import Episode


@pytest.fixture
def audit() -> ArmAudit:
    return ArmAudit(unread)


def unread(episode: Episode) -> EpisodeImages:
    pytest.fail(f"{episode.name} was read")


def broken(count: int) -> list[Episode]:
    return [Episode(f"{i}", "side", problem=f"broken {i}") for i in range(count)]


def test_an_audit_goes_on_after_a_kill(audit: ArmAudit, tmp_path: Path) -> None:
    rows = tmp_path / "audit.rows"
    results = audit_episodes(audit, broken(4), rows)
    first = [next(results), next(results)]
    results.close()  # pyright: ignore[reportAttributeAccessIssue]
    whole = rows.read_bytes()
    assert whole.count(b"\n") == 2
    # The second line is cut off, so its episode is audited again.
    rows.write_bytes(whole[:-20])
    audit_once = ArmAudit(unread)
    again = [*audit_episodes(audit_once, broken(4), rows)]
    assert again[0] == first[0]
    assert [result.reason for result in again] == [f"broken {i}" for i in range(4)]
    assert [*audit_episodes(audit, [], rows)] == again


def test_episodes_are_audited_in_worker_processes(
    audit: ArmAudit, tmp_path: Path
) -> None:
    results = [*audit_episodes(audit, iter(broken(5)), tmp_path / "rows", 2)]
    assert sorted(result.reason for result in results) == [
        f"broken {i}" for i in range(5)
    ]


def test_poses_of_earlier_episodes_are_handed_on(tmp_path: Path) -> None:
    handed = []

    class Noting(ArmAudit):
        def done(self, number: int, source: Source) -> Audited:
            handed.append([pose.translation_m[0] for pose in source[1]])
            corrected = (float(number), 0.0, 0.0, 0.0, 0.0, 0.0)
            return Audited(
                source[0].name, source[0].camera, corrected, "wrong", "", "", corrected
            )

    noting = Noting(unread)
    assert len([*audit_episodes(noting, broken(4), tmp_path / "rows")]) == 4
    assert handed == [[], [0], [0, 1], [1, 2]]


def result(
    episode: int, verdict: str, stated: float = 0.0, mistake: str = ""
) -> Audited:
    corrected = (9.0,) if verdict != "unknown" else ()
    return Audited(f"{episode:02d}", "side", (stated,), verdict, "", mistake, corrected)  # type: ignore[arg-type]


def test_episodes_after_a_move_name_its_begin() -> None:
    results = [
        result(0, "wrong"),  # before any right one
        result(1, "right"),
        result(2, "unknown"),
        result(3, "wrong", mistake="inverse"),
        result(5, "wrong"),
        result(4, "wrong"),
        result(6, "wrong", stated=1.0),  # another pose is stated
        result(7, "right"),
        result(8, "wrong"),
    ]
    named = {item.episode: item.mistake for item in with_moves(results)}
    assert named == {
        "00": "", "01": "", "02": "", "03": "inverse", "04": "moved since 04",
        "05": "moved since 04", "06": "", "07": "", "08": "moved since 08",
    }  # fmt: skip
