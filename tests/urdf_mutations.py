"""URDF texts written by hand, random mutations of URDFs, and how Pinocchio reads them."""

import re

import numpy as np
import pinocchio as pin
from hypothesis import HealthCheck
from hypothesis import strategies as st
from lxml import etree
from mutations import mutation_lists
from robots import robot_file

from dhcal_pin import se3

ROBOTS = robot_file("")
FILES = sorted(path.relative_to(ROBOTS).as_posix() for path in ROBOTS.rglob("*.urdf"))
# Files of example-robot-data that are not sound, and what is said about them.
UNSOUND = {
    # An empty <robot> without a name: Pinocchio refuses it too.
    "ur_description/urdf/ur3.urdf": r":6: <robot>: no name",
}
SOUND = [name for name in FILES if name not in UNSOUND]
LINKS = '<link name="a"/><link name="b"/>'
LIMIT = '<limit lower="-1" upper="2" effort="3" velocity="4"/>'
ENDS = '<parent link="a"/><child link="b"/>'


def robot(inside: str) -> bytes:
    return f'<robot name="r">\n{inside}\n</robot>'.encode()


def joint(inside: str = "", name: str = "j", kind: str = "revolute", ends: str = ENDS) -> str:
    return f'<joint name="{name}" type="{kind}">{ends}{LIMIT}{inside}</joint>'


def pinocchio_origins(data: bytes) -> dict[str, np.ndarray]:
    """Pose of each link in its parent link at the neutral configuration, from Pinocchio, by joint."""
    # Pinocchio takes only spaces between numbers, XML any blank.
    text = data.decode("utf-8-sig").translate(dict.fromkeys(b"\t\r\n", " "))
    model = pin.buildModelFromXML(text)
    at = model.createData()
    pin.framesForwardKinematics(model, at, pin.neutral(model))
    root = etree.fromstring(data, etree.XMLParser(recover=True))

    def pose(link: str) -> pin.SE3:
        return at.oMf[model.getFrameId(link, pin.FrameType.BODY)]

    return {
        element.get("name"): (
            pose(element.find("parent").get("link")).inverse() * pose(element.find("child").get("link"))
        ).homogeneous
        for element in root.findall("joint")
    }


def perturbed(urdf, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {one.name: one.origin @ se3.exp6(rng.normal(size=6) * 1e-2) for one in urdf.joints}


def largest(found: dict[str, np.ndarray], wanted: dict[str, np.ndarray]) -> float:
    assert found.keys() == wanted.keys()
    return max((np.abs(found[name] - wanted[name]).max() for name in wanted), default=0.0)


# Joints of other elements, which are none of the robot's.
ELSEWHERE = (
    '<ros2_control name="c"><joint name="j"><origin xyz="1 1 1"/></joint></ros2_control>'
    '<transmission name="t"><joint name="j"/><link name="a"/></transmission>'
    '<gazebo><joint name="j" type="revolute"><origin xyz="x"/></joint></gazebo><joints><origin/></joints>'
)
OPEN = '<joint name="j" type="fixed">'
HAND = {
    "crlf": (
        f'{OPEN}\r\n\t<origin rpy="0 0 0" xyz="0 0 1" />\r\n\t{ENDS}\r\n</joint>',
        f'{OPEN}\r\n\t<origin rpy="RPY" xyz="XYZ" />\r\n\t{ENDS}\r\n</joint>',
    ),
    "single quotes and >": (
        f"{OPEN}{ENDS}<origin note='/' other='>&quot;/>' xyz='0 0 1' rpy='0 0 0'/></joint>",
        f"{OPEN}{ENDS}<origin note='/' other='>&quot;/>' xyz='XYZ' rpy='RPY'/></joint>",
    ),
    "mixed quotes, entities, no rpy": (
        f"""{OPEN}{ENDS}<origin id='&#65;"rpy=' xyz="&#48; 0 1" ></origin></joint>""",
        f"""{OPEN}{ENDS}<origin id='&#65;"rpy=' xyz="XYZ" rpy="RPY" ></origin></joint>""",
    ),
    "several lines": (
        f'<joint\n type="fixed"\n name = "j">{ENDS}<origin\n xyz\n=\n"0\n\t0 1"\n rpy = " 0 0 0 "/></joint>',
        f'<joint\n type="fixed"\n name = "j">{ENDS}<origin\n xyz\n=\n"XYZ"\n rpy = "RPY"/></joint>',
    ),
    "no attributes, single quotes": (
        f"<joint name='j' type='fixed'>{ENDS}<origin/></joint>",
        f"<joint name='j' type='fixed'>{ENDS}<origin xyz='XYZ' rpy='RPY'/></joint>",
    ),
    "no attributes, something like one behind": (
        f"{OPEN}<origin />xyz = '5 5 5'{ENDS}</joint>",
        f"""{OPEN}<origin xyz="XYZ" rpy="RPY" />xyz = '5 5 5'{ENDS}</joint>""",
    ),
    "no xyz": (
        f'{OPEN}{ENDS}<origin rpy="0 0 0"/></joint>',
        f'{OPEN}{ENDS}<origin rpy="RPY" xyz="XYZ"/></joint>',
    ),
    "no origin": (
        f'{OPEN}\n   <!-- <origin xyz="9 9"/> -->\n\n   {ENDS}\n</joint>',
        f'{OPEN}\n   <!-- <origin xyz="9 9"/> -->\n\n   <origin xyz="XYZ" rpy="RPY"/>\n   {ENDS}\n</joint>',
    ),
    "no origin, crlf": (
        f"<joint name='j' type='fixed'>\r\n\t{ENDS}\r\n</joint>",
        f"<joint name='j' type='fixed'>\r\n\t<origin xyz='XYZ' rpy='RPY'/>\r\n\t{ENDS}\r\n</joint>",
    ),
    "no origin, one line": (
        f"{OPEN}{ENDS}</joint>",
        f'{OPEN}<origin xyz="XYZ" rpy="RPY"/>{ENDS}</joint>',
    ),
    "comments and CDATA": (
        f'{OPEN}<!-- <origin xyz="1 1 1"/> --><![CDATA[<origin xyz="2 2 2"/>]]>'
        f'<origin xyz="0 0 1" rpy="0 0 0"/>{ENDS}<!-- > --></joint>',
        f'{OPEN}<!-- <origin xyz="1 1 1"/> --><![CDATA[<origin xyz="2 2 2"/>]]>'
        f'<origin xyz="XYZ" rpy="RPY"/>{ENDS}<!-- > --></joint>',
    ),
    "same names elsewhere": (
        f'{ELSEWHERE}{OPEN}<origin xyz="0 0 1"/>{ENDS}</joint>{ELSEWHERE}',
        f'{ELSEWHERE}{OPEN}<origin xyz="XYZ" rpy="RPY"/>{ENDS}</joint>{ELSEWHERE}',
    ),
}
SEEDS = [
    *(
        (ROBOTS / name).read_bytes()
        for name in (
            "asr_twodof_description/urdf/TwoDofs.urdf",
            "double_pendulum_description/urdf/double_pendulum_continuous.urdf",
            "ur_description/urdf/ur5_robot.urdf",
        )
    ),
    *(robot(LINKS + old) for old, _ in HAND.values()),
    robot(
        f"{LINKS}\n<link name='c'/>"
        + joint('<origin xyz="1 2 3" rpy="0 1.5707963267948966 0"/>')
        + '<joint name="k" type="prismatic"><parent link="b"/><child link="c"/><axis xyz="0 1 1"/>'
        f'{LIMIT}<mimic joint="j" multiplier="2"/><dynamics damping="1"/></joint>'
    ),
]
TOKENS = [
    *(b"nan", b"inf", b"1e999", b"-1e5", b"1e-400", b"9" * 400, b"0", b"1.", b"0x10", b"fixed", b"${a}"),
    *(b"", b" ", b"\t", b"\r\n", b"'", b'"', b"<", b">", b"/>", b"=", b"&quot;", b"&#10;", b"&x;"),
    *(
        b"<!--",
        b"-->",
        b"<![CDATA[",
        b"]]>",
        b"<?x?>",
        b"<!DOCTYPE a>",
        b"\xef\xbb\xbf",
        b"\xc3\xa9",
        b"\xff",
    ),
    *(b"\0", b' xyz="1 2 3"', b" rpy='1 2 3'", b"<origin/>", b'<origin xyz="1 2 3"/>', b"</joint>"),
    *(b'<joint name="j" type="fixed">', b'<mimic joint="j"/>', b'<axis xyz="0 0 0"/>', b'<parent link="b"/>'),
]
WORD = re.compile(rb"[-+.\w]+|<[^>]*>|\"[^\"]*\"|\s+|.", re.DOTALL)
EXAMPLES = {"data": st.sampled_from(SEEDS), "mutations": mutation_lists(st.sampled_from(TOKENS))}
LENIENT = [HealthCheck.too_slow, HealthCheck.filter_too_much]
