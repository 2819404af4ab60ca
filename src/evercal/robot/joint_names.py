"""Which column of a table holds the values of which joint, by their names."""

import re
from collections.abc import Sequence

_FILLERS = {
    *("joint", "joints", "j", "a", "axis", "q", "motor", "angle", "pos", "position"),
    *(
        "state",
        "observation",
        "actual",
        "measured",
        "main",
        "follower",
        "robot",
        "value",
    ),
}
"""Words of names that tell no joint from another."""
_GRIPPERS = {"gripper", "jaw", "finger", "hand", "grip"}
"""Words of columns that are no joint of the arm."""
_ORDERED = 3
"""Number of joints from which unknown names may be in order."""
_ALIASES = {
    frozenset({"rotation"}): frozenset({"shoulder", "pan"}),
    frozenset({"pitch"}): frozenset({"shoulder", "lift"}),
    frozenset({"wrist", "pitch"}): frozenset({"wrist", "flex"}),
}
"""Other words for joints, of the first URDF of the SO-100."""


def joints_by_column(
    columns: Sequence[str],
    joints: Sequence[str],
    ordered: bool,
) -> dict[str, str]:
    """Joints of columns whose names differ: `shoulder_pan.pos`, `J1` for `joint_1`.

    Columns without any known word may be in the order of the joints, if they are `ordered` and
    their number is the same.
    """
    arm = [column for column in columns if not _words(column) & _GRIPPERS]
    numbers = [re.findall(r"\d+", column)[-1:] for column in arm]
    from_zero = numbers == [[str(i)] for i in range(len(arm))]
    in_order = dict(zip(arm, joints, strict=False))
    ordered &= len(arm) == len(joints) >= _ORDERED
    if from_zero and ordered:
        return in_order
    found = {}
    for column in columns:
        words = _words(column)
        equal = [joint for joint in joints if words == _words(joint)]
        larger = [joint for joint in joints if words and words < _words(joint)]
        if column in joints:
            equal = [column]
        if len(equal or larger) == 1:
            (found[column],) = equal or larger
    known = frozenset(word for joint in joints for word in _words(joint))
    if ordered and not any(_words(column) & known for column in arm):
        return in_order
    return found


def _words(name: str) -> frozenset[str]:
    """Words and numbers of a name that tell a joint from others."""
    plain = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()
    words = re.findall(r"[a-z]+|[1-9]\d*|0", plain)
    telling = frozenset(words) - _FILLERS
    return _ALIASES.get(telling, telling)
