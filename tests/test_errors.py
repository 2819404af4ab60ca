"""What a user reads of an error."""

import pytest

from evercal.cli.console import print_json, say
from evercal.errors import InputError, with_options
from evercal.reports.page import environment
from evercal.service.viewer.html import chip_html, rows_html

MESSAGE = "give `robot_poses`, or `pose_convention` deg; `X` and `2` are no arguments"
PRINTED = "give --robot-poses, or --pose-convention deg; `X` and `2` are no arguments"


def test_an_error_names_arguments_and_the_command_line_prints_options(capsys):
    error = InputError(MESSAGE)
    assert str(error) == MESSAGE
    assert error.fields == ("robot_poses", "pose_convention")
    say(str(error))
    print_json({"error": str(error)})
    printed = capsys.readouterr().out.splitlines()
    assert printed == [PRINTED, f'{{"error": "{PRINTED}"}}']


def test_pages_and_reports_of_the_command_line_print_options():
    assert PRINTED in chip_html("failed", MESSAGE)
    assert PRINTED in rows_html([("robot", MESSAGE)])
    template = environment().from_string("{{ text | options }}")
    assert template.render(text=MESSAGE) == PRINTED


@pytest.mark.parametrize("text", ["", "no argument", "`", "``", "` robot_poses`"])
def test_other_text_stays(text):
    assert with_options(text) == text
    assert InputError(text).fields == ()
