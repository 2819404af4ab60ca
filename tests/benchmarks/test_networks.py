"""The commands of the experiments on networks."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import networks
from evercal.cli import _parse
from evercal.cli.bench import Bench
from evercal.errors import InputError


def test_all_commands_are_valid_and_resume_in_folders_of_their_own() -> None:
    listed = networks.commands(Path("rooms"), Path("runs"))
    benches = [
        command
        for commands in listed.values()
        for command in commands
        if command[:2] == ("evercal", "bench")
    ]
    assert len(benches) == 13
    folders = set()
    for command in benches:
        parsed = _parse(list(command[1:]), as_json=False)
        assert isinstance(parsed, Bench)
        assert parsed.data == Path("rooms") / parsed.suite
        folders.add(parsed.out)
    assert len(folders) == 8, "the gate is a part of experiment A"


def test_a_dry_run_prints_the_commands_and_runs_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert networks.run(("a", "memory"), tmp_path, tmp_path, dry=True) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"rooms sim-mini --sweep-only --out {tmp_path}/sim-mini"
    assert len(lines) == 11
    assert not list(tmp_path.iterdir())


def test_filled_sars_has_the_setting_of_sars_spdd() -> None:
    rows = {row["name"]: row for row in networks._tuned(networks.SELECTIONS[networks.FILLED])}
    assert rows["sars_spdd_filled"]["with"] == rows["sars_spdd"]["with"]
    assert rows["sars_spdd_filled"]["of"] == "sars_spdd_filled"
    assert set(rows) - set(networks.SELECTED) == {"sars_spdd_filled"}


def test_an_unknown_experiment_is_refused() -> None:
    known = "choose of tune, gate, a, memory, b, c, real, paper, tables"
    for names in ((), ("d",)):
        with pytest.raises(InputError, match=known):
            networks.run(names)
