"""The calibration by an arm in view without one of its parts."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from unittest import mock

from evercal.calibration.arm_in_view import solve
from evercal.calibration.arm_in_view.equations import Priors
from evercal.robot.link_shapes import RobotBody, robot_body

_ROUGH_M = 0.003
"""Size of a cell in which a rough mesh has one vertex."""


def _with_priors(**changes: object) -> Callable[..., Priors]:
    original = solve.priors_of
    return lambda *given: replace(original(*given), **changes)


def _rough_body(*given: object) -> RobotBody:
    body = robot_body(*given)  # pyright: ignore[reportArgumentType]
    return replace(body, links=tuple(link.simplified(_ROUGH_M) for link in body.links))


def _no_offsets(*given: object) -> Priors:
    priors = _PRIORS_OF(*given)  # pyright: ignore[reportArgumentType]
    return replace(priors, usual=0 * priors.usual)


_PRIORS_OF = solve.priors_of
PARTS: dict[str, tuple[str, object]] = {
    "no common shift of outlines": ("priors_of", _with_priors(outline_px=1e-6)),
    "no joint offsets": ("priors_of", _no_offsets),
    "intrinsics always estimated": ("priors_of", _with_priors(lens_is_free=True)),
    "pose only": ("priors_of", _with_priors(pose_only=True)),
    "rough meshes, 3 mm": ("robot_body", _rough_body),
}
"""Name and value of the attribute of `solve` that is changed."""


@contextmanager
def without(part: str) -> Iterator[None]:
    """Leave out one of `PARTS`, or nothing if it has no name."""
    if not part:
        yield
        return
    name, value = PARTS[part]
    with mock.patch.object(solve, name, value):
        yield
