"""Learning scenes one after another: what to keep, what to replay, how to distil."""

from importlib.util import find_spec

from evercal.errors import missing_extra

if find_spec("torch") is None:
    raise missing_extra("networks need torch", "networks")
