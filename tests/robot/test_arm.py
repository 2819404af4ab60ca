"""Chains of joints: closed forms, slopes by finite differences, URDFs that are refused."""

import time
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike

from evercal.geometry import SE3, pose_distance
from evercal.robot.arm import Arm
from evercal.robot.robot_model import RobotModel

from ..recordings.checks import refused

ALONG = '<origin xyz="0.4 0.1 0.2" rpy="0.3 -0.2 0.5"/>'


def joint(
    name: str,
    links: str,
    more: str = "",
    kind: str = "revolute",
    axis: str = "0 0 1",
    origin: str = ALONG,
) -> str:
    """A joint between two links of one letter each."""
    limit = '<limit lower="-3" upper="3" effort="1" velocity="1"/>'
    ends = f'<parent link="{links[0]}"/><child link="{links[1]}"/>'
    axis = axis and f'<axis xyz="{axis}"/>'
    return (
        f'<joint name="{name}" type="{kind}">{ends}{origin}{axis}{limit}{more}</joint>'
    )


def robot(folder: Path, *parts: str, links: str = "abcd") -> RobotModel:
    """A model of links of one letter each."""
    file = folder / "robot.urdf"
    listed = "".join(f'<link name="{link}"/>' for link in links)
    file.write_text(f'<robot name="r">{listed}{"".join(parts)}</robot>')
    return RobotModel(file)


def turned(*, by: float, about: ArrayLike = (0, 0, 1)) -> SE3:
    """A rotation."""
    return SE3.exp([0, 0, 0, *(by * np.asarray(about))])


def along() -> SE3:
    """The pose of ALONG, from its definition."""
    x, y, z = (
        turned(by=b, about=a) for b, a in zip((0.3, -0.2, 0.5), np.eye(3), strict=True)
    )
    return SE3.exp([0.4, 0.1, 0.2, 0, 0, 0]) @ z @ y @ x


def assert_pose(arm: Arm, values: list[float], expected: SE3) -> None:
    assert max(pose_distance(arm.poses(np.array([values]))[0], expected)) < 1e-9


# A gripper's two fingers, a joint beside the chain that drives one of it, and a slanted slide.
LONG = (
    joint("m", "bc", '<mimic joint="j" multiplier="-0.5" offset="0.2"/>', axis="0 2 0"),
    joint("j", "ab"),
    joint("s", "cd", kind="prismatic", axis="1 -2 2"),
    joint("w", "de", kind="continuous", axis="3 0 4"),
    joint("side", "af", '<mimic joint="w"/>', kind="prismatic"),
)


@pytest.mark.parametrize("ends", ["ae", "ea", "ef", "fe", "cb", "bd"])
def test_slopes_are_those_of_finite_differences(tmp_path: Path, ends: str) -> None:
    arm = robot(tmp_path, *LONG, links="abcdef").arm(*ends)
    values = np.random.default_rng(1).uniform(-1, 1, (5, len(arm.joints)))
    slopes = arm.slopes(values)
    step = 1e-6
    for i in range(values.shape[1]):
        moved = step * np.eye(values.shape[1])[i]
        change = (arm.poses(values - moved).inverse() @ arm.poses(values + moved)).log()
        np.testing.assert_allclose(slopes[:, :, i], change / (2 * step), atol=1e-8)
    back = robot(tmp_path, *LONG, links="abcdef").arm(*ends[::-1])
    back_values = values[:, [arm.joints.index(name) for name in back.joints]]
    both = arm.poses(values) @ back.poses(back_values)
    assert np.max(pose_distance(both, both @ both.inverse())) < 1e-9


@pytest.mark.parametrize("length", [1, 0.5, 3, 1e-6, -2])
def test_length_of_an_axis_is_no_scale(tmp_path: Path, length: float) -> None:
    """As pin and urchin read it; yourdfpy moves a slide by value times length."""
    axis = f"0 {0.6 * length} {0.8 * length}"
    way = np.array([0, 0.6, 0.8]) * np.sign(length)
    turn = robot(tmp_path, joint("j", "ab", axis=axis)).arm("a", "b")
    assert_pose(turn, [0.7], along() @ turned(by=0.7, about=way))
    slide = robot(tmp_path, joint("j", "ab", axis=axis, kind="prismatic")).arm("a", "b")
    assert_pose(slide, [0.7], along() @ SE3.exp([*(0.7 * way), 0, 0, 0]))


def test_without_an_axis_a_joint_turns_about_x(tmp_path: Path) -> None:
    arm = robot(tmp_path, joint("j", "ab", axis="", origin="")).arm("a", "b")
    assert_pose(arm, [0.7], turned(by=0.7, about=(1, 0, 0)))


@pytest.mark.parametrize(
    ("parts", "driver", "factor", "constant"),
    [
        ((joint("m", "bc", '<mimic joint="j"/>'), joint("j", "ab")), "j", 1, 0),
        (
            (joint("j", "ab"), joint("m", "bc", '<mimic joint="j" multiplier="0"/>')),
            "j",
            0,
            0,
        ),
        # Beside the chain, and later in the file.
        (
            (
                joint("f", "ab", kind="fixed"),
                joint("m", "bc", '<mimic joint="x" multiplier="2" offset="0.1"/>'),
                joint("x", "ad"),
            ),
            "x",
            2,
            0.1,
        ),
        # A mimic of a mimic: 2 (3 x + 0.2) + 0.1.
        (
            (
                joint("f", "ab", kind="fixed"),
                joint("m", "bc", '<mimic joint="n" multiplier="2" offset="0.1"/>'),
                joint("n", "ad", '<mimic joint="x" multiplier="3" offset="0.2"/>'),
                joint("x", "de"),
            ),
            "x",
            6,
            0.5,
        ),
    ],
)
def test_mimic_joints_follow_their_driver(
    tmp_path: Path, parts: tuple[str, ...], driver: str, factor: float, constant: float
) -> None:
    arm = robot(tmp_path, *parts, links="abcde").arm("a", "c")
    assert arm.joints == (driver,)
    first = turned(by=0.3) if driver == "j" else SE3.identity()
    assert_pose(
        arm, [0.3], along() @ first @ along() @ turned(by=factor * 0.3 + constant)
    )


QUATERNION = '<origin xyz="1 0 0" quat_xyzw="0 0 0.6 0.8"/>'
MIMIC = '<mimic joint="{}"/>'


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ((joint("j", "ab"), joint("k", "bc", axis="0 0 0")), "joint k has the axis"),
        (
            (joint("j", "ab"), joint("k", "bc", kind="planar")),
            "joint k is planar; not supported",
        ),
        (
            (joint("j", "ab"), joint("k", "bc", kind="floating")),
            "joint k is floating; not supp",
        ),
        (
            (joint("j", "ab"), joint("k", "bc", kind="hinge")),
            "joint k is hinge; not supported",
        ),
        (
            (joint("j", "ab"), joint("k", "bc", origin=QUATERNION)),
            "k is turned by quat_xyzw",
        ),
        (
            (joint("j", "ab"), joint("k", "bc", origin=QUATERNION).replace('"', "'")),
            "joint k is turned by quat_xyzw",
        ),
        # A transmission names joints, too, in an element that may be closed at once.
        (
            (
                '<transmission name="t"><joint name="j"/></transmission>',
                joint("j", "ab"),
                joint("k", "bc", origin=QUATERNION),
            ),
            "joint k is turned by quat_xyzw",
        ),
        (
            (joint("j", "ab"), joint("k", "bc", MIMIC.format("x"))),
            "k mimics x, which is no moving",
        ),
        (
            (joint("j", "ab", kind="fixed"), joint("k", "bc", MIMIC.format("j"))),
            "no moving joint",
        ),
        (
            (joint("j", "ab"), joint("k", "bc", MIMIC.format("k"))),
            "k mimics k, which mimics it",
        ),
        (
            (joint("j", "ab", MIMIC.format("k")), joint("k", "bc", MIMIC.format("j"))),
            "joint k mimics j, which mimics it",
        ),
        (
            (
                joint("j", "ab", MIMIC.format("k")),
                joint("k", "bc", MIMIC.format("l")),
                joint("l", "cd", MIMIC.format("k")),
            ),
            "joint l mimics k, which mimics it",
        ),
        (
            (joint("j", "ab"), joint("k", "cd")),
            "no joints connect a and c; name others",
        ),
        (
            (joint("j", "xb"), joint("k", "bc")),
            "no joints connect a and c; name others",
        ),
        (
            (joint("j", "ab"), joint("k", "bx")),
            "no joints connect a and c; name others",
        ),
        (
            (joint("j", "ab"), joint("k", "bc"), joint("l", "ca")),
            "above link . form a circle",
        ),
        (
            (joint("j", "ad"), joint("k", "bc"), joint("l", "cb")),
            "above link b form a circle",
        ),
    ],
)
def test_chains_that_are_not_understood_are_refused_by_name(
    tmp_path: Path, parts: tuple[str, ...], message: str
) -> None:
    refused(message, robot(tmp_path, *parts).arm, "a", "c")


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ((joint("j", "ab"), joint("j", "bc")), "'j' comes twice; give each link and"),
        (('<link name="a"/>', joint("j", "ab")), "'a' comes twice; give each link"),
        (
            (joint("j", "ab"), joint("k", "cb")),
            "'b' comes twice; a link is below one joint",
        ),
        *(
            ((joint("j", "ab", origin=f'<origin xyz="{xyz}"/>'),), f"'{xyz}' are not")
            for xyz in ("0 0 1 0", "0 0 nan", "0 0 1e300", "")
        ),
        ((joint("j", "ab", origin="<origin/><origin/>"),), "j: it has two of origin"),
        ((joint("j", "aa"),), "joint j: 'a' is its parent and its child"),
        ((joint("j", "ab", axis="0 0 1 0"),), "'0 0 1 0' are not three finite numbers"),
    ],
)
def test_urdfs_without_one_meaning_are_refused(
    tmp_path: Path, parts: tuple[str, ...], message: str
) -> None:
    refused(message, robot, tmp_path, *parts)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        # What a recovering reader leaves out: the arm would lose an offset.
        (('xyz="0.4 0.1 0.2"', "xyz=0.4 0.1 0.2"), "no usable URDF: it is no XML: not well"),
        (('rpy="0.3', '& rpy="0.3'), "it is no XML: not well-formed .* line 1, column"),
        (('<joint name="j"', '<!DOCTYPE r><joint name="j"'), "it is no XML"),
        (("<robot", '<?xml version="1.0" encoding="a"?><robot'), "XML: unknown encoding"),
        (("<robot", "<!DOCTYPE robot><robot"), "it has a DOCTYPE, which no URDF needs"),
        (("<link", "<l"), "it has no links; make a URDF"),
        (("</robot>", "</robot><robot/>"), "it is no XML: junk after document element"),
        (('type="revolute"', 'Type="revolute"'), "joint j: its 'type' is missing"),
        (("<parent ", "<parnt "), "joint j: its 'parent link' is missing"),
        (('<child link="b"', '<child lnk="b"'), "joint j: its 'child link' is missing"),
        (('<link name="a"/>', "<link/>"), "URDF: link None: its 'name' is missing"),
        (('lower="-3"', 'lower="left"'), "joint j: could not convert string to float: 'left'"),
    ],
)  # fmt: skip
def test_what_is_no_urdf_is_refused_in_one_line(
    tmp_path: Path, change: tuple[str, str], message: str
) -> None:
    file = robot(tmp_path, joint("j", "ab")).path
    text = file.read_text()
    assert change[0] in text
    count = -1 if change[0] == "<link" else 1
    file.write_text(text.replace(*change, count))
    refused(message, RobotModel, file)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("<origin", "<orgin"), "joint j has 'orgin ...'; did you mean 'origin ...'?"),
        (
            ("<origin", "<Origin"),
            "joint j has 'Origin ...'; did you mean 'origin ...'?",
        ),
        (
            (' xyz="0.4', ' XYZ="0.4'),
            "joint j has 'origin XYZ'; did you mean 'origin xyz'?",
        ),
        (("rpy=", "ryp="), "joint j has 'origin ryp'; did you mean 'origin rpy'?"),
        (("<axis", "<axes"), "joint j has 'axes xyz'; did you mean 'axis xyz'?"),
        (
            ('<axis xyz="0', '<axis xzy="0'),
            "joint j has 'axis xzy'; did you mean 'axis xyz'?",
        ),
        (("<limit", "<limits"), "joint j has 'limits .*; did you mean 'limit .*?"),
        (("upper=", "uper="), "joint j has 'limit uper'; did you mean 'limit upper'?"),
        (("<mimic", "<mimick"), "joint m has 'mimick .*; did you mean 'mimic .*?"),
        (
            ("multiplier", "multiplyer"),
            "joint m has 'mimic multiplyer'; did you mean 'mimic multi",
        ),
    ],
)
def test_misspelt_parts_of_a_joint_are_named_where_it_is_used(
    tmp_path: Path, change: tuple[str, str], message: str
) -> None:
    mimic = '<mimic joint="j" multiplier="2" offset="0"/>'
    parts = [joint("j", "ab"), joint("m", "bc", mimic), joint("k", "cd")]
    parts[:2] = [part.replace(*change) for part in parts[:2]]
    model = robot(tmp_path, *parts)
    refused(message.replace("?", r"\?"), model.arm, "a", "c")
    assert model.arm("c", "d").joints == ("k",)


def test_what_other_programs_add_to_a_urdf_is_skipped(tmp_path: Path) -> None:
    more = '<controller_gains Kp="1"/><drake:origin/><joint_properties damping="1"/>'
    part = joint("j", "ab", more).replace("<limit", '<limit drake:lower="1" power="2"')
    part = part.replace("<joint ", '<joint dont_collapse="true" ')
    file = robot(tmp_path, part.replace("<axis", '<axis rpy="0 0 0"')).path
    beside = '<RefLink/><loop_joint/><sensor:camera/><gazebo><joint name="j"/></gazebo>'
    text = file.read_text().replace("</robot>", f"{beside}</robot>")
    file.write_text(f'\n<?xml version="1.0"?>{text}')
    assert RobotModel(file).arm("a", "b").joints == ("j",)


def test_a_chain_of_many_links_takes_time_in_proportion(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def chain(length: int) -> float:
        links = [f'<link name="{i}"/>' for i in range(length + 1)]
        ends = '<parent link="{}"/><child link="{}"/>'
        for i in range(length):
            inside = ends.format(i, i + 1)
            links.append(f'<joint name="{i}" type="revolute">{inside}</joint>')
        file = tmp_path / "long.urdf"
        file.write_text(f'<robot name="r">{"".join(links)}</robot>')
        start = time.process_time()
        arm = RobotModel(file).arm("0", str(length))
        assert len(arm.joints) == length
        return time.process_time() - start

    chain(100)
    assert chain(8_000) < 20 * chain(1_000)
    monkeypatch.setenv("EVERCAL_LIMITS", "elements=100")
    refused("elements in XML, at most 100", chain, 1_000)


def test_a_urdf_that_was_cut_off_is_refused(tmp_path: Path) -> None:
    file = robot(tmp_path, *LONG, links="abcdef").path
    text = file.read_text()
    file.write_text(text[: text.index('<joint name="s"')])
    refused("a part is missing", RobotModel, file)


def test_parts_outside_the_chain_do_not_matter(tmp_path: Path) -> None:
    shape = f'<link name="e"><visual>{QUATERNION}<geometry><box size="1 1 1"/></geometry></visual>'
    shape += f'<collision>{QUATERNION}<geometry><box size="1 1 1"/></geometry></collision></link>'
    arm = robot(
        tmp_path,
        shape,
        joint("j", "ae", f"<!-- {QUATERNION} -->"),
        joint("k", "eb", kind="floating", origin=QUATERNION),
        joint("l", "ac", axis="0 0 0"),
        joint("m", "ed", MIMIC.format("x")),
    ).arm("a", "e")
    assert_pose(arm, [0.4], along() @ turned(by=0.4))


def test_offsets_of_the_first_and_the_last_joint_are_not_determined(
    tmp_path: Path,
) -> None:
    model = robot(tmp_path, *LONG, links="abcdef")
    # j also drives the second joint, so its offset is more than a turn of the base.
    assert model.arm("a", "e").joints == ("j", "s", "w")
    assert model.arm("a", "e").free().tolist() == [True, True, False]
    assert model.arm("e", "a").joints == ("w", "s", "j")
    assert model.arm("e", "a").free().tolist() == [False, True, True]
    # w moves both ends.
    assert model.arm("f", "e").joints == ("w", "j", "s")
    assert model.arm("f", "e").free().tolist() == [True, True, True]
    assert model.arm("a", "b").free().tolist() == [False]
    assert model.arm("d", "d").free().tolist() == []
    chain = [joint(f"j{i}", "abcdefg"[i : i + 2], axis="0 1 0") for i in range(6)]
    six = robot(tmp_path, *chain, links="abcdefg").arm("a", "g")
    assert six.free().tolist() == [False, True, True, True, True, False]
