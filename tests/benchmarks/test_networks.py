"""The experiments on networks."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import networks
from evercal.errors import InputError


def test_experiments_have_valid_options_and_folders_of_their_own() -> None:
    known = networks.experiments(Path("rooms"), Path("runs"), "cpu")
    folders = {experiment.out for of in known.values() for experiment in of}
    assert len(folders) == 14, "the gate is a part of experiment A"
    for experiment in (experiment for of in known.values() for experiment in of):
        assert experiment.data is not None
        assert experiment.data.parent == Path("rooms")
        assert experiment.data.name.removesuffix("-480") == experiment.suite
        assert experiment._stage(0).fit.iterations >= networks.STEPS
        names = [strategy.name for strategy in experiment._strategies()]
        assert len(set(names)) == len(names)


def test_filled_sars_has_the_setting_of_sars_spdd() -> None:
    for head in (False, True):
        plain, filled = networks.chosen(("sars_spdd", "sars_spdd_filled"), head)
        assert filled.description()["method"] == {
            **plain.description()["method"],  # pyright: ignore[reportGeneralTypeIssues]
            "selector": "sars_filled",
        }


def test_an_unknown_experiment_is_refused() -> None:
    listed = "choose of gate, a, memory, b, c, d-gate, d, share, real, paper"
    for names in ((), ("e",)):
        with pytest.raises(InputError, match=listed):
            networks.run(names)
