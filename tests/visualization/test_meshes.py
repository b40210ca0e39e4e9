"""What links look like: meshes cut down to size, and rods where one is missing."""

import json
import os
import re

import numpy as np
import pytest
from robots import robot_file
from scipy.spatial import cKDTree
from urdf_mutations import joint, robot

from dhcal_pin.exceptions import DhcalError
from dhcal_pin.robot.chain import Chain
from dhcal_pin.robot.collision import obstacles_from_urdf
from dhcal_pin.robot.urdf import parse_urdf
from dhcal_pin.ros_packages import MAX_MESH_BYTES
from dhcal_pin.visualization.meshes import GRID, Mesh, Visuals, allocate_triangles, visuals_of
from dhcal_pin.visualization.scene import MAX_TRIANGLES, kinematic_tree, scene_html

UR5 = "ur_description/urdf/ur5_robot.urdf"
EVERYTHING = 10**9


def looked(chain: Chain, folders=None, triangles: int = EVERYTHING) -> Visuals:
    return visuals_of(chain, kinematic_tree(chain, chain)["bodies"], folders, triangles)


def ball(rings: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """A sphere of radius 0.1 m about (1, 2, 3): corners and triangles."""
    lengths, widths = np.meshgrid(np.arange(rings) * 2 * np.pi / rings, np.linspace(0, np.pi, rings))
    corners = np.stack(
        [np.sin(widths) * np.cos(lengths), np.sin(widths) * np.sin(lengths), np.cos(widths)], -1
    )
    i, j = np.meshgrid(np.arange(rings - 1), np.arange(rings), indexing="ij")
    a, b = i * rings + j, i * rings + (j + 1) % rings
    triangles = np.stack([a, a + rings, b, b, a + rings, b + rings], -1).reshape(-1, 3)
    return 0.1 * corners.reshape(-1, 3) + [1.0, 2.0, 3.0], triangles


def volume(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles] - mesh.vertices.mean(0), 1, 0)
    return float(np.abs(np.einsum("ij,ij->", a, np.cross(b, c))) / 6)


def test_the_grid_moves_no_corner_by_more_than_half_a_step():
    corners, triangles = ball()
    mesh = Mesh.on_grid(corners, triangles)
    assert np.ptp(corners, axis=0).max() / GRID == pytest.approx(mesh.step)
    far = cKDTree(mesh.vertices).query(corners, p=np.inf)[0]
    assert far.max() <= 0.51 * mesh.step
    assert volume(mesh) == pytest.approx(4 / 3 * np.pi * 1e-3, rel=5e-3)


def test_a_simplified_mesh_keeps_its_form():
    mesh = Mesh.on_grid(*ball()).simplify(1000)
    assert 500 < len(mesh.triangles) <= 1000
    radius = np.linalg.norm(mesh.vertices - [1.0, 2.0, 3.0], axis=1)
    assert np.abs(radius - 0.1).max() < 1e-3
    assert volume(mesh) == pytest.approx(4 / 3 * np.pi * 1e-3, rel=0.02)


def spread(mesh: Mesh, count: int) -> np.ndarray:
    """Points (count, 3) all over a mesh, as many on each triangle as its area asks for."""
    rng = np.random.default_rng(0)
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    at = rng.choice(len(area), count, p=area / area.sum())
    u, v = np.sort(rng.random((2, count, 1)), axis=0)
    return u * a[at] + (v - u) * b[at] + (1 - v) * c[at]


@pytest.mark.parametrize("file", [UR5, "so_arm_description/urdf/so101.urdf"])
def test_a_robot_keeps_as_many_triangles_as_it_may_and_its_form(file):
    whole = looked(Chain.from_urdf(robot_file(file)))
    counts = [len(mesh.triangles) for mesh in whole.meshes]
    kept = allocate_triangles(counts, MAX_TRIANGLES)
    few = [mesh.simplify(most) for mesh, most in zip(whole.meshes, kept, strict=True)]
    assert 0.9 * MAX_TRIANGLES < sum(len(mesh.triangles) for mesh in few) <= MAX_TRIANGLES
    for mesh, cut in zip(whole.meshes, few, strict=True):
        away = cKDTree(spread(cut, 50_000)).query(spread(mesh, 2000))[0]
        assert np.quantile(away, 0.9) < 0.02 * np.ptp(mesh.vertices, axis=0).max()
        assert np.quantile(away, 0.99) < 0.03 * np.ptp(mesh.vertices, axis=0).max()


def test_small_meshes_stay_whole():
    assert allocate_triangles([4, 1600, 9, 400], 613) == [4, 400, 9, 200]
    assert allocate_triangles([0, 4, 0], 100) == [0, 4, 0]
    assert allocate_triangles([0, 0], 100) == [0, 0]
    assert allocate_triangles([10, 20], 400) == [10, 20]
    assert allocate_triangles([100, 100, 100], 30) == [10, 10, 10]
    assert allocate_triangles([], 30) == []


def test_two_meshed_arms_stay_small_and_come_out_the_same():
    nominal = Chain.from_urdf(robot_file(UR5))
    q = np.zeros((20, 6))
    first, second = (scene_html(nominal, nominal, q=q, triangles=EVERYTHING) for _ in range(2))
    assert first == second
    sizes = [
        len(first.encode()),
        *(len(scene_html(nominal, nominal, q=q, triangles=n).encode()) for n in (MAX_TRIANGLES, 15_000)),
    ]
    assert sizes[0] < 6e6
    assert sizes[1] < 2e6
    assert sizes[2] < 1.2e6


def test_a_lost_mesh_costs_its_own_link_alone(tmp_path):
    source = robot_file(UR5)
    text = re.sub(rb"visual/forearm", b"visual/no_such_file", source.read_bytes().replace(b"\n", b" \n\t"))
    (tmp_path / "wrist3.dae").write_bytes(b"<COLLADA/>")
    text = re.sub(rb"package://[^\"]*visual/wrist3.dae", (tmp_path / "wrist3.dae").as_uri().encode(), text)
    whole = looked(Chain.from_urdf(source))
    lost = looked(Chain.from_urdf(parse_urdf(text, "arm.urdf")), list(source.parents))
    assert len(lost.meshes) == len(whole.meshes) - 2
    assert "no_such_file.dae (forearm_link)" in lost.note
    assert "wrist3.dae (wrist_3_link)" in lost.note
    kept = [shape for shape in whole.shapes if shape["body"] not in (3, 6)]
    assert [shape["body"] for shape in lost.shapes if "mesh" in shape] == [shape["body"] for shape in kept]
    assert {shape["body"] for shape in lost.shapes if "cylinder" in shape} == {3, 6}


def stl(*triangles) -> bytes:
    """A binary STL file."""
    body = b"".join(np.zeros(3, "<f4").tobytes() + np.array(t, "<f4").tobytes() + b"\0\0" for t in triangles)
    return bytes(80) + np.uint32(len(triangles)).tobytes() + body


TRIANGLE = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]


@pytest.mark.parametrize(
    "content",
    [
        stl(TRIANGLE, [[0, 0, 0], [1, np.nan, 0], [0, 1, 0]]),
        stl([[0, 0, np.inf], [1, 0, 0], [0, 1, 0]]),
        stl(TRIANGLE)[:100],
    ],
    ids=["nan", "infinite", "truncated"],
)
def test_a_mesh_that_is_not_finite_is_drawn_as_a_rod(tmp_path, content, capfd):
    (tmp_path / "bad.stl").write_bytes(content)
    (tmp_path / "good.stl").write_bytes(stl(TRIANGLE))
    visual = '<visual><geometry><mesh filename="{}.stl"/></geometry></visual>'
    text = robot(
        f'<link name="a">{visual.format("bad")}</link><link name="b">{visual.format("good")}</link>' + joint()
    )
    visuals = looked(Chain.from_urdf(parse_urdf(text, str(tmp_path / "arm.urdf"))))
    assert visuals.note.startswith(
        "Drawn as rods, because meshes are missing, unreadable or larger than 32 MiB: bad.stl (a)"
    )
    assert len(visuals.meshes) == 1
    # Link b is the tip.
    assert {shape["body"] for shape in visuals.shapes} == {0, 2}
    # Coal reports a mesh with NaN on stderr.
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("name", ["big.stl", "package://cell/big.stl"])
def test_a_mesh_that_would_take_too_much_memory_is_drawn_as_a_rod(tmp_path, name):
    """A sound mesh is not loaded for the picture, and not for the check of collisions, if it is too large."""
    package = tmp_path / "cell"
    package.mkdir()
    (package / "big.stl").write_bytes(stl(TRIANGLE))
    os.truncate(package / "big.stl", MAX_MESH_BYTES + 1)
    shape = f'<geometry><mesh filename="{name}"/></geometry>'
    link = f'<link name="a"><visual>{shape}</visual><collision>{shape}</collision></link><link name="b"/>'
    file = package if name == "big.stl" else tmp_path
    urdf = parse_urdf(robot(link + joint()), str(file / "arm.urdf"))
    assert "larger than 32 MiB: big.stl (a)" in looked(Chain.from_urdf(urdf)).note
    with pytest.raises(DhcalError, match=f"arm.urdf: the mesh {name} is larger than 32 MiB"):
        obstacles_from_urdf(urdf)
    os.truncate(package / "big.stl", len(stl(TRIANGLE)))
    assert len(looked(Chain.from_urdf(urdf)).meshes) == 1


@pytest.mark.parametrize("limit", [0, 1, 2, 10])
def test_no_mesh_vanishes(limit):
    mesh = Mesh.on_grid(*ball(10))
    assert 0 < len(mesh.simplify(limit).triangles) < len(mesh.triangles)


def test_without_any_mesh_the_whole_arm_is_a_skeleton(tmp_path):
    source = robot_file(UR5)
    # A copy of the robot finds the meshes of the installed package; one of another package finds none.
    copy = Chain.from_urdf(parse_urdf(source.read_bytes(), str(tmp_path / "arm.urdf")))
    assert len(looked(copy).meshes) == 7
    data = source.read_bytes().replace(b"package://example-robot-data/robots/", b"package://")
    chain = Chain.from_urdf(parse_urdf(data, str(tmp_path / "arm.urdf")))
    lost = looked(chain)
    assert not lost.meshes
    assert "and 4 more" in lost.note
    assert {shape["body"] for shape in lost.shapes} >= set(range(7))
    assert len(looked(chain, [source.parents[2]]).meshes) == 7
    assert "the package ur_description with --package-dir" in lost.note
    page = scene_html(chain)
    scene = json.loads(page.split('type="application/json">')[1].split("</script>")[0])
    assert scene["note"] == lost.note
