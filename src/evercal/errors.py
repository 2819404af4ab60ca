"""The one exception that a user is meant to read."""


class InputError(Exception):
    """Misuse or bad input.

    The message is one line that names the thing, shows what came and says what to do next. The
    command line prints it and exits with status 2; anything else that is raised is a bug. Line
    breaks become spaces: names from damaged files can hold any character.
    """

    def __init__(self, message: str = ""):
        super().__init__(" ".join(str(message).splitlines()))
