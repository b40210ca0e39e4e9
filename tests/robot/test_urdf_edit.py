"""URDF rewriting against Pinocchio, yourdfpy, lxml and bytes written by hand."""

import math
import re
import warnings
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from lxml import etree
from mutations import mutated
from urdf_mutations import (
    EXAMPLES,
    HAND,
    LENIENT,
    LINKS,
    ROBOTS,
    SOUND,
    WORD,
    joint,
    largest,
    perturbed,
    pinocchio_origins,
    robot,
)

from dhcal_pin import se3
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.robot import parse_urdf, read_urdf
from dhcal_pin.robot.urdf_edit import with_origins


def yourdfpy_origins(path: Path) -> dict[str, np.ndarray]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what it imports
        import yourdfpy

        read = yourdfpy.URDF.load(
            str(path), build_scene_graph=False, load_meshes=False, build_collision_scene_graph=False
        )
    return {
        one.name: np.eye(4) if one.origin is None else np.asarray(one.origin) for one in read.robot.joints
    }


def changed_lines(old: bytes, new: bytes) -> tuple[int, int]:
    """How many lines have other quoted values, and how many are new; any other difference fails."""
    before, replaced, inserted = old.split(b"\n"), 0, 0
    values = re.compile(rb"""\b(xyz|rpy)\s*=\s*("[^"]*"|'[^']*')""")
    k = 0
    for line in new.split(b"\n"):
        if k < len(before) and line == before[k]:
            k += 1
        elif re.fullmatch(rb"[ \t]*<origin xyz=(.)[^'\"]*\1 rpy=\1[^'\"]*\1/>\r?", line) and not (
            k < len(before) and b"<origin" in before[k]
        ):
            inserted += 1
        else:
            kept = values.sub(b"", before[k])
            # An attribute that was not there comes with one blank before it.
            assert values.sub(b"", line).replace(b" ", b"") == kept.replace(b" ", b"")
            k, replaced = k + 1, replaced + 1
    assert k == len(before)
    return replaced, inserted


def other_elements(data: bytes) -> list[tuple]:
    """All of the file but its joints' origins, as lxml reads it."""
    root = etree.fromstring(data, etree.XMLParser(recover=True))
    origins = set(root.findall("joint/origin"))
    return [
        (one.tag, dict(one.attrib), (one.text or "").strip()) for one in root.iter() if one not in origins
    ]


@pytest.mark.parametrize("name", SOUND)
def test_new_origins_change_only_their_lines_and_read_back(name, tmp_path):
    urdf = read_urdf(ROBOTS / name)
    wanted = perturbed(urdf)
    data = with_origins(urdf, wanted)

    root = etree.fromstring(urdf.data, etree.XMLParser(recover=True))
    missing = sum(one.find("origin") is None for one in root.findall("joint"))
    replaced, inserted = changed_lines(urdf.data, data)
    assert inserted == missing
    assert len(wanted) - missing <= replaced <= 2 * len(wanted)
    assert other_elements(data) == other_elements(urdf.data)

    assert largest(pinocchio_origins(data), wanted) <= 1e-13
    path = tmp_path / "out.urdf"
    path.write_bytes(data)
    assert largest(yourdfpy_origins(path), wanted) <= 1e-12
    again = {one.name: one.origin for one in parse_urdf(data, "out").joints}
    assert largest(again, wanted) <= 2e-15


HALF_TURN = np.array([[-1, 0, 0, 1.5], [0, -1, 0, 0], [0, 0, 1, -0.25], [0, 0, 0, 1.0]])  # about z
NEW = {b"XYZ": b"1.5 0.0 -0.25", b"RPY": b"0.0 0.0 3.141592653589793"}


@pytest.mark.parametrize("name", HAND)
@pytest.mark.parametrize("head", ["", "\ufeff<?xml version='1.0' encoding='utf-8'?>\r\n<!-- é < Ω -->"])
def test_bytes_of_rewritten_origins(name, head):
    old, new = ((head + robot(LINKS + text).decode()).encode() for text in HAND[name])
    urdf = parse_urdf(old, "hand.urdf")
    assert with_origins(urdf, {"j": urdf.joint("j").origin}) == old
    data = with_origins(urdf, {"j": HALF_TURN})
    assert data == new.replace(b"XYZ", NEW[b"XYZ"]).replace(b"RPY", NEW[b"RPY"])
    assert largest(pinocchio_origins(data), {"j": HALF_TURN}) <= 1e-15


def test_unchanged_translation_or_rotation_keeps_its_text():
    old = robot(LINKS + joint('<origin xyz=" 1 2.00 3 " rpy="0.1 .2 +3e-1"/>'))
    urdf = parse_urdf(old, "f")
    moved = urdf.joint("j").origin.copy()
    moved[:3, 3] = -0.0, 0.1, 1e-7
    assert with_origins(urdf, {"j": moved}) == old.replace(b" 1 2.00 3 ", b"0.0 0.1 1e-07")
    turned = se3.transform(np.diag([1.0, -1.0, -1.0]), [1, 2, 3])
    assert with_origins(urdf, {"j": turned}) == old.replace(b"0.1 .2 +3e-1", b"3.141592653589793 0.0 0.0")


def test_non_ascii_names():
    links = '<link name="ä"/><link name="ß"/>'
    ends = '<parent link="ä"/><child link="ß"/>'
    data = robot(links + joint(name="ö", kind="fixed", ends=ends)).replace(b'"r"', '"ŕ"'.encode())
    urdf = parse_urdf(data, "f")
    assert (urdf.name, urdf.links, urdf.root, urdf.joint("ö").child) == ("ŕ", ("ä", "ß"), "ä", "ß")
    assert largest(pinocchio_origins(with_origins(urdf, {"ö": HALF_TURN})), {"ö": HALF_TURN}) <= 1e-15


@pytest.mark.parametrize("away", [0.0, 1e-16, 1e-12, 1e-9, 1e-8, 1e-7, 1e-6, 1e-3])
@pytest.mark.parametrize("sign", [-1, 1])
def test_pitch_near_a_quarter_turn_keeps_every_digit(away, sign):
    rng = np.random.default_rng(1)
    urdf = parse_urdf(robot(LINKS + joint()), "f")
    for roll, yaw in rng.uniform(-math.pi, math.pi, (20, 2)):
        wanted = np.eye(4)
        wanted[:3, :3] = pin.rpy.rpyToMatrix(roll, sign * (math.pi / 2 - away), yaw)
        data = with_origins(urdf, {"j": wanted})
        assert np.abs(parse_urdf(data, "f").joint("j").origin - wanted).max() <= 2e-15
        assert largest(pinocchio_origins(data), {"j": wanted}) <= 3e-15
    exact = se3.transform([[0, 0, sign], [0, 1, 0], [-sign, 0, 0]], np.zeros(3))
    data = with_origins(urdf, {"j": exact})
    assert np.abs(parse_urdf(data, "f").joint("j").origin - exact).max() <= 2e-15


@pytest.mark.parametrize(
    ("origin", "what"),
    [
        (np.full((4, 4), np.nan), "finite"),
        (np.eye(3), r"\(4, 4\)"),
        (np.diag([1.0, 1, -1, 1]), "rotation"),
        (np.diag([1.0, 1, 1 + 1e-6, 1]), "rotation"),
        (np.diag([2.0, 2, 2, 1]), "rotation"),
        (np.diag([1.0, 1, 1, 2]), "rotation"),
        (se3.translation([0, 0, 2e4]), "within 10000 m"),
    ],
)
def test_new_origins_must_be_rigid(origin, what):
    urdf = parse_urdf(robot(LINKS + "\n" + joint()), "f.urdf")
    with pytest.raises(DhcalError, match=rf"^f.urdf:3: joint 'j': the new origin .*expected .*{what}"):
        with_origins(urdf, {"j": origin})


def test_new_origins_of_unknown_joints_are_refused():
    with pytest.raises(DhcalError, match="unknown joint 'k'; choose from 'j'"):
        with_origins(parse_urdf(robot(LINKS + joint()), "f"), {"k": np.eye(4)})


def accepted(data: bytes) -> bool:
    """Check that bytes are refused in one line, or else can be rewritten; return whether they are read."""
    try:
        urdf = parse_urdf(data, "fuzz.urdf")
    except DhcalError as error:
        refusal = str(error)
    else:
        assert with_origins(urdf, {one.name: one.origin for one in urdf.joints}) == data
        wanted = perturbed(urdf)
        again = parse_urdf(with_origins(urdf, wanted), "again.urdf")
        assert largest({one.name: one.origin for one in again.joints}, wanted) <= 1e-13
        assert again.links == urdf.links
        return True
    # The dot matches no line end.
    assert re.fullmatch(r"fuzz\.urdf:\d+: .{10,600}", refusal)
    return False


@settings(max_examples=300, deadline=None, derandomize=True, suppress_health_check=LENIENT)
@given(**EXAMPLES)
def test_any_bytes_are_refused_or_rewritten(data, mutations):
    accepted(mutated(data, mutations, WORD))


@pytest.mark.slow
@settings(max_examples=3000, deadline=None, derandomize=True, suppress_health_check=LENIENT)
@given(**EXAMPLES)
def test_any_bytes_are_refused_or_rewritten_and_pinocchio_agrees(data, mutations):
    data = mutated(data, mutations, WORD)
    if accepted(data):
        pinocchio_origins(data)
