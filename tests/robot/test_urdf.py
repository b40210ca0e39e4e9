"""URDF reading against Pinocchio and bytes written by hand."""

import math
import re
from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest
from urdf_mutations import (
    ENDS,
    FILES,
    LIMIT,
    LINKS,
    ROBOTS,
    SOUND,
    UNSOUND,
    joint,
    largest,
    pinocchio_origins,
    robot,
)

from dhcal_pin.exceptions import DhcalError
from dhcal_pin.robot import parse_urdf, read_urdf
from dhcal_pin.robot.urdf_edit import with_origins
from dhcal_pin.robot.urdf_path import build_model


def test_there_are_69_robots():
    assert len(FILES) == 69
    assert UNSOUND.keys() <= set(FILES)


@pytest.mark.parametrize("name", UNSOUND)
def test_invalid_robots_are_refused_with_the_line(name):
    with pytest.raises(DhcalError, match=re.escape(name) + UNSOUND[name]):
        read_urdf(ROBOTS / name)


@pytest.mark.parametrize("name", SOUND)
def test_robots_agree_with_pinocchio(name):
    urdf = read_urdf(ROBOTS / name)
    assert with_origins(urdf, {one.name: one.origin for one in urdf.joints}) == urdf.data
    assert largest(pinocchio_origins(urdf.data), {one.name: one.origin for one in urdf.joints}) <= 1e-13

    model = pin.buildModelFromXML(urdf.data.decode())
    bodies = [frame.name for frame in model.frames if frame.type == pin.FrameType.BODY]
    assert sorted(bodies) == sorted(urdf.links)
    assert bodies[0] == urdf.root
    assert urdf.name == model.name
    for one in urdf.joints:
        if one.type in ("revolute", "prismatic"):
            i = model.joints[model.getJointId(one.name)].idx_q
            ours = [0.0 if math.isinf(limit) else limit for limit in (one.lower, one.upper)]
            # Where the file has no limit, Pinocchio has zero.
            assert ours == [model.lowerPositionLimit[i], model.upperPositionLimit[i]]
        if one.type in ("revolute", "prismatic", "continuous"):
            subspace = model.joints[model.getJointId(one.name)].createData().S
            moved = subspace[:3] if one.type == "prismatic" else subspace[3:]
            np.testing.assert_allclose(one.axis, moved.ravel(), atol=1e-15)


def test_rotation_of_rpy_agrees_with_pinocchio():
    for rpy in np.random.default_rng(2).uniform(-7, 7, (200, 3)):
        text = " ".join(map(repr, rpy.tolist()))
        origin = parse_urdf(robot(LINKS + joint(f'<origin rpy="{text}"/>')), "f").joint("j").origin
        np.testing.assert_allclose(origin[:3, :3], pin.rpy.rpyToMatrix(*rpy), atol=2e-15, rtol=0)


@pytest.mark.parametrize(
    "text",
    ["1e-3 +1. -.5", "  1E-3   1.0 -5e-1  ", "1e-3\t1.\r\n-0.5", "&#49;e-3&#32;1&#x20;-.5", "0.001 1 -0.5"],
)
def test_unusual_but_valid_numbers(text):
    urdf = parse_urdf(robot(LINKS + joint(f'<origin xyz="{text}"/>')), "f")
    assert urdf.joint("j").origin[:3, 3].tolist() == [1e-3, 1.0, -0.5]


def test_all_fields_of_joints_and_links():
    inside = '<mimic joint="j" multiplier="-2"/><axis xyz="0 3 4"/>'
    third = joint(inside, "k", "prismatic", '<parent link="b"/><child link="c"/>').replace('lower="-1" ', "")
    third = f'<link name="c"/>{third}'
    urdf = parse_urdf(robot(f"{LINKS}\n{joint()}\n{third}"), "arm.urdf")
    j, k = urdf.joints
    assert (j.name, j.type, j.parent, j.child, j.lower, j.upper, j.line) == (
        "j",
        "revolute",
        "a",
        "b",
        -1,
        2,
        3,
    )
    assert j.axis.tolist() == [1, 0, 0]
    assert j.mimic is None
    assert (k.lower, k.upper, k.mimic, k.line) == (-math.inf, 2, ("j", -2.0, 0.0), 4)
    np.testing.assert_allclose(k.axis, [0, 0.6, 0.8], atol=1e-16)
    assert np.array_equal(k.origin, np.eye(4))
    assert (urdf.root, urdf.leaves(), urdf.path("a"), urdf.path("c")) == ("a", ("c",), (), (j, k))
    with pytest.raises(DhcalError, match=r"^arm.urdf: unknown joint 'jj'; did you mean 'j'"):
        urdf.joint("jj")
    with pytest.raises(DhcalError, match=r"^arm.urdf: unknown link 'tool'; choose from 'a', 'b', 'c'$"):
        urdf.path("tool")


def test_continuous_joints_have_no_limits_and_fixed_joints_need_no_axis():
    urdf = parse_urdf(robot(LINKS + joint('<axis xyz="0 0 0"/>', kind="fixed")), "f")
    assert urdf.joint("j").axis.tolist() == [1, 0, 0]
    continuous = parse_urdf(robot(LINKS + joint(kind="continuous")), "f").joint("j")
    assert (continuous.lower, continuous.upper) == (-math.inf, math.inf)


def two(first: str, second: str) -> str:
    return f"{LINKS}\n{first}\n{second}"


BACK = '<parent link="b"/><child link="a"/>'
INERTIAL = (
    '<inertial><mass value="2.5"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
)
REFUSED = [
    # (bytes, line, fragment)
    (b"", 1, "empty"),
    (b" \r\n ", 1, "empty"),
    (robot(LINKS).replace(b'"r"', b'"\xff"'), 1, "not UTF-8; convert"),
    (b"<robot>\n<a>\n" + b"\xe9", 3, "not UTF-8; convert"),
    (robot(LINKS).decode().encode("utf-16"), 1, "not UTF-8; convert"),
    (robot(LINKS).decode().encode("utf-16-le"), 1, "UTF-16; convert the file to UTF-8"),
    (
        b'<?xml version="1.0" encoding="ISO-8859-1"?>' + robot(LINKS),
        1,
        "'iso-8859-1'; convert the file to UTF-8",
    ),
    (b'<?xml version="1.0" encoding="ascii"?><!-- \xc3\xa9 -->' + robot(LINKS), 1, "'ascii'; convert"),
    (b"<!DOCTYPE robot>\n" + robot(LINKS), 1, "<!DOCTYPE>: document types and entities are not accepted"),
    (
        b'<?xml version="1.0"?>\n<!DOCTYPE r [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]>\n<robot name="&b;"/>',
        2,
        "not accepted; remove it",
    ),
    (robot('<link name="a"/>\n<?x y?>'), 3, "<?x?>: processing instructions are not accepted; remove it"),
    (robot('<link name="&a;"/>'), 2, "broken XML: undefined entity"),
    (robot('<link name="${prefix}a"/>'), 2, "unexpanded xacro; expand it first: xacro FILE > out.urdf"),
    (robot('\n<link name="$(arg p)a"/>'), 3, "expand it first"),
    (robot('<xacro:macro name="m"/>'), 2, "<xacro:macro>: unexpanded xacro"),
    (robot(LINKS)[:-3], 3, "broken XML: unclosed token"),
    (robot(LINKS)[:-9], 2, "broken XML: no element found"),
    (robot("<link name='a'>"), 3, "broken XML: mismatched tag"),
    (robot('<link name="a" name="b"/>'), 2, "broken XML: duplicate attribute"),
    (robot(LINKS) + b"<robot/>", 3, "broken XML: junk after document element"),
    (b"name: robot", 1, "broken XML"),
    (b"\n<sdf version='1.6'><model/></sdf>", 2, "<sdf>: this is SDF, not URDF"),
    (b"<" + b"a" * 10_000 + b"/>", 1, "aaa>: this is not a URDF"),
    (b"<html/>", 1, "<html>: this is not a URDF; expected <robot> as the outermost element"),
    (b"<robot><link name='a'/></robot>", 1, "<robot>: no name"),
    (robot(""), 1, "<robot>: no links"),
    (robot("<a>" * 64 + "</a>" * 64), 2, "nested too deep; at most 64"),
    (robot("<link/>"), 2, "link '': no name"),
    (robot(LINKS + "\n<link name='a'/>"), 3, "link 'a': the name is already used on line 2"),
    (robot(two(joint(), joint())), 4, "joint 'j': the name is already used on line 3"),
    (robot(LINKS + joint().replace('name="j"', "")), 2, "joint '': no name"),
    (robot(LINKS + joint().replace('name="j"', 'name=""')), 2, "joint '': no name"),
    (
        robot(LINKS + joint().replace('type="revolute"', "")),
        2,
        "joint 'j': no type; expected one of revolute",
    ),
    (robot(LINKS + joint(kind="ball")), 2, "joint 'j': unknown type 'ball'; choose from revolute"),
    (robot(LINKS + joint(ends='<child link="b"/>')), 2, "joint 'j': no <parent>; expected"),
    (robot(LINKS + joint(ends='<parent link="a"/>')), 2, "joint 'j': no <child>; expected"),
    (robot(LINKS + joint(ends='<parent link="a"/>\n<child/>')), 3, "joint 'j' <child>: no link"),
    (
        robot(LINKS + joint(ends='<parent link="a"/>\n<child link="c"/>')),
        3,
        "<child>: unknown link 'c'; choose from 'a', 'b'",
    ),
    (
        robot(LINKS + joint(ends='<parent link="aa"/><child link="b"/>')),
        2,
        "unknown link 'aa'; did you mean 'a'",
    ),
    (robot(LINKS + '<joint name="j" type="fixed"/>'), 2, "joint 'j': no <parent>"),
    *(
        (
            robot(LINKS + joint(element + "\n" + element)),
            3,
            f"joint 'j' <{name}>: a second element of this kind; keep one",
        )
        for name, element in (
            ("origin", "<origin/>"),
            ("axis", '<axis xyz="1 0 0"/>'),
            ("mimic", '<mimic joint="j"/>'),
        )
    ),
    (robot(LINKS + joint('\n<parent link="a"/>')), 3, "joint 'j' <parent>: a second element"),
    (robot(LINKS + joint('\n<child link="a"/>')), 3, "joint 'j' <child>: a second element"),
    (robot(LINKS + joint("\n" + LIMIT)), 3, "joint 'j' <limit>: a second element"),
    *(
        (robot(LINKS + joint(f'\n<origin {key}="{text}"/>')), 3, f"joint 'j' <origin>: {key} has {what}")
        for key in ("xyz", "rpy")
        for text, what in (
            ("", "0 numbers; expected 3"),
            ("1 2", "2 numbers; expected 3"),
            ("1 2 3 4", "4 numbers; expected 3"),
            ("1,2,3", "1 number; expected 3"),
            ("1 nan 3", "'nan'; expected a finite number"),
            ("1 inf 3", "'inf'"),
            ("1 1e999 3", "'1e999'"),
            ("1 0x1 3", "'0x1'"),
            ("1 1_0 3", "'1_0'"),
            ("1 1f 3", "'1f'"),
            ("1 . 3", "'.'"),
            ("1&#9;2 3 4", "'1\\t2'"),
            ("1 ١ 3", "'١'"),
        )
    ),
    (robot(LINKS + joint('<origin xyz="0 0 10001"/>')), 2, "xyz is beyond ±10000; expected metres"),
    (robot(LINKS + joint('<origin rpy="0 0 1e22"/>')), 2, "rpy is beyond ±10000"),
    (robot(LINKS + joint('<origin quat_xyzw="0 0 0 1"/>')), 2, "quat_xyzw is ignored by most readers"),
    (robot(LINKS + joint('<origin rpy="0 0 0" quat_xyzw="0 0 0 1"/>')), 2, "write the rotation as rpy"),
    (robot(LINKS + joint("<axis/>")), 2, "<axis>: no xyz; expected xyz=..."),
    (robot(LINKS + joint('<axis xyz="0 z 1"/>')), 2, "<axis>: xyz has 'z'"),
    *(
        (robot(LINKS + joint(f'<axis xyz="{text}"/>', kind=kind)), 2, "expected a direction of length 1")
        for kind in ("revolute", "continuous", "prismatic")
        for text in ("0 0 0", "0 1e-200 0", "1e300 1e300 1e300", "-0 0 0")
    ),
    (robot(LINKS + joint().replace(LIMIT, "")), 2, "joint 'j': a revolute joint has no <limit>"),
    (robot(LINKS + joint(kind="prismatic").replace(LIMIT, "")), 2, "a prismatic joint has no <limit>"),
    (robot(LINKS + joint().replace('effort="3"', "")), 2, "joint 'j' <limit>: no effort"),
    (robot(LINKS + joint().replace('velocity="4"', "")), 2, "joint 'j' <limit>: no velocity"),
    *(
        (robot(LINKS + joint().replace(f'{key}="{old}"', f'{key}="{new}"')), 2, f"<limit>: {key} has")
        for key, old in (("lower", "-1"), ("upper", "2"), ("effort", "3"), ("velocity", "4"))
        for new in ("", "nan", "-inf", "1 2", "x")
    ),
    (robot(LINKS + joint().replace('"-1"', '"3"')), 2, "<limit>: lower 3 is above upper 2; swap them"),
    (robot(LINKS + joint().replace('"-1"', '"2.001"')), 2, "lower 2.001 is above upper 2; swap them"),
    (robot(LINKS + joint('<dynamics damping="x"/>')), 2, "<dynamics>: damping has 'x'"),
    (robot(LINKS + joint("<dynamics/>")), 2, "<dynamics>: neither damping nor friction; add one"),
    (robot(LINKS + joint('<calibration rising="x"/>')), 2, "<calibration>: rising has 'x'"),
    (robot(LINKS + joint("<safety_controller/>")), 2, "<safety_controller>: no k_velocity"),
    (robot(LINKS + joint("<mimic/>")), 2, "<mimic>: no joint"),
    (robot(LINKS + joint('<mimic joint="j" offset="x"/>')), 2, "<mimic>: offset has 'x'"),
    (robot(LINKS + joint('<mimic joint="j" multiplier="nan"/>')), 2, "<mimic>: multiplier has 'nan'"),
    (robot(LINKS + joint('\n<mimic joint="j"/>')), 3, "the joint mimics itself in a cycle"),
    (
        robot(
            two(joint('<mimic joint="k"/>'), joint('<mimic joint="j"/>', "k")).replace(ENDS, ENDS, 1)
        ).replace(
            b'<joint name="k" type="revolute">' + ENDS.encode(),
            b'<link name="c"/><joint name="k" type="revolute"><parent link="b"/><child link="c"/>',
        ),
        3,
        "in a cycle; remove one <mimic>",
    ),
    (robot(two(joint(), joint(name="k"))), 4, "joint 'k': its child 'b' is already the child of joint 'j'"),
    (robot(two(joint(), joint(name="k", ends=BACK))), 3, "links must form a tree"),
    (robot(LINKS + "\n" + joint(ends='<parent link="b"/><child link="b"/>')), 3, "links must form a tree"),
    (
        robot('<link name="a"/>\n<link name="b"/>'),
        3,
        "link 'b': neither this link nor link 'a' is the child of a joint; a robot has one root",
    ),
    # Pinocchio leaves out the mass of these links and only prints a message.
    *(
        (
            robot(f'<link name="a"><inertial>\n{inside}</inertial></link>'),
            3,
            f"link 'a' <inertial> {fragment}",
        )
        for inside, fragment in (
            ('<mass value="2,5"/>', "<mass>: value has '2,5'; expected a finite number"),
            ('<mass value="1kg"/>', "<mass>: value has '1kg'"),
            ('<mass value="nan"/>', "<mass>: value has 'nan'"),
            ('<mass value="-1"/>', "<mass>: value is outside of 0 to 1e+06; expected kilograms"),
            ("<mass/>", "<mass>: no value"),
            ('<mass value="1"/><mass value="2"/>', "<mass>: a second element of this kind"),
            ('<mass value="1"/><origin xyz="0 0 a"/>', "<origin>: xyz has 'a'"),
            ('<mass value="1"/><inertia ixx="0,1"/>', "<inertia>: ixx has '0,1'"),
        )
    ),
    (robot('<link name="a"><inertial/></link>'), 2, "link 'a' <inertial>: no <mass>"),
    (robot(f'<link name="a">{INERTIAL}\n{INERTIAL}</link>'), 3, "<inertial>: a second element of this kind"),
    (
        robot("".join(f'<link name="{i}"/>\n' for i in range(20_002))),
        20_003,
        "too many; at most 20000",
    ),
]


@pytest.mark.parametrize(("data", "line", "fragment"), REFUSED, ids=range(len(REFUSED)))
def test_invalid_files_are_refused_with_the_line(data, line, fragment):
    with pytest.raises(DhcalError) as caught:
        parse_urdf(data, "dir/arm.urdf")
    text = str(caught.value)
    assert text.startswith(f"dir/arm.urdf:{line}: ")
    assert fragment in text
    assert "\n" not in text
    assert len(text) < 400


def test_unusual_but_valid_files_are_accepted():
    for data in (
        robot('<link name="a"><origin/><origin/></link>'),
        b'<?xml version="1.0" encoding="US-ASCII"?>' + robot('<link name="a"/>'),
        b'<?xml version = "1.0"?>\n<!-- ${a} <xacro:b/> -->' + robot('<link name="a">$(b)</link>'),
        robot('<link name="a"/><!-- <!DOCTYPE r> -->').replace(b"<robot", b'<robot xmlns:xacro="x"'),
        robot('<link name="a"/>' + "<a>" * 63 + "</a>" * 63),
        robot('<link name="a"><inertial><mass value="1"/></inertial><visual/></link>'),
        robot(f'<link name="a">{INERTIAL}<visual><inertial/></visual></link><x><inertial/></x>'),
        robot('<link name="a"/><link name="b" />' + joint('<origin xyz="1e4 -1e4 0"/>', "a")),
    ):
        assert parse_urdf(data, "f").root == "a"
        assert pin.buildModelFromXML(data.decode()).nframes >= 2


def test_the_mass_of_a_link_is_that_of_pinocchio(capfd):
    data = robot(f'<link name="a"/><link name="b">{INERTIAL}<visual/></link>' + joint())
    model = build_model(parse_urdf(data, "f"))
    assert model.inertias[1].mass == 2.5
    # Pinocchio's parser reports the empty <visual> on stderr.
    assert capfd.readouterr().err == ""


def test_unreadable_files(tmp_path):
    for path, what in (
        (tmp_path / "none.urdf", "No such file"),
        (tmp_path, "Is a directory"),
        ("a\0b", "null byte"),
    ):
        with pytest.raises(DhcalError, match=what) as caught:
            read_urdf(path)
        assert str(caught.value).startswith(f"{path}: cannot be read")
    path = tmp_path / "huge.urdf"
    with path.open("wb") as file:
        file.truncate((16 << 20) + 1)
    with pytest.raises(DhcalError, match=r"huge.urdf: the file is larger than 16 MiB"):
        read_urdf(path)


def chain(n: int) -> bytes:
    """Return a chain of n joints whose links come first, in reverse order."""
    links = "".join(f'<link name="l{i}"/>' for i in reversed(range(n + 1)))
    joints = "\n".join(
        joint(name=f"j{i}", ends=f'<parent link="l{i}"/><child link="l{i + 1}"/>') for i in range(n)
    )
    return robot(f"{links}\n{joints}")


def test_chains_are_accepted_up_to_500_joints():
    urdf = parse_urdf(chain(500), "f")
    assert (urdf.root, urdf.leaves()) == ("l0", ("l500",))
    path = urdf.path("l500")
    assert len(path) == 500
    assert all(first.child == second.parent for first, second in pairwise(path))
    assert pin.buildModelFromXML(urdf.data.decode()).njoints == 501
    for n in (501, 20_000):
        with pytest.raises(DhcalError, match=r"^f:503: joint 'j500': more than 500 joints in a row"):
            parse_urdf(chain(n), "f")
