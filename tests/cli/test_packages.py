"""Robots of example-robot-data and folders with meshes, in the commands that read a robot."""

import json
import shutil
from pathlib import Path

import pytest
from command_line import stderr_of, stdout_of
from robots import UR10

from dhcal_pin.io import read_robot

# Two links, the second with a mesh of a package that is not beside the URDF.
ARM = """<robot name="arm"><link name="base"/>
<link name="link"><VISUAL><geometry><mesh filename="package://my_arm/meshes/box.stl"/></geometry></VISUAL></link>
<joint name="turn" type="revolute"><parent link="base"/><child link="link"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<link name="tip"/><joint name="end" type="fixed"><origin xyz="0.3 0 0.2"/>
<parent link="link"/><child link="tip"/></joint></robot>"""
TETRAHEDRON = [(0, 0, 0), (0.3, 0, 0), (0, 0.3, 0), (0, 0, 0.3)]


def stl(corners):
    """A tetrahedron as STL text."""
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    lines = ["solid box"]
    for face in faces:
        lines += ["facet normal 0 0 0", "outer loop"]
        lines += ["vertex " + " ".join(map(str, corners[i])) for i in face]
        lines += ["endloop", "endfacet"]
    return "\n".join([*lines, "endsolid box", ""])


@pytest.fixture
def workspace(tmp_path, monkeypatch):
    """Working folder with a URDF, and beside it a ROS workspace with the package of its mesh."""
    folder = tmp_path / "work"
    folder.mkdir()
    monkeypatch.chdir(folder)
    for name in ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH"):
        monkeypatch.delenv(name, raising=False)
    Path("arm.urdf").write_text(ARM.replace("VISUAL", "visual"))
    Path("solid.urdf").write_text(ARM.replace("VISUAL", "collision"))
    meshes = tmp_path / "ros" / "share" / "my_arm" / "meshes"
    meshes.mkdir(parents=True)
    (meshes / "box.stl").write_text(stl(TETRAHEDRON))
    return tmp_path / "ros"


def scene_of(page):
    """The scene of a page, as the page reads it."""
    return json.loads(Path(page).read_text().split('type="application/json">')[1].split("</script>")[0])


def test_convert_copies_a_robot_by_name(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    stdout_of(run("convert", "example:ur10", "ur10.urdf"))
    assert Path("ur10.urdf").read_bytes() == UR10.read_bytes()
    # A robot with many tips, and a sidecar that a copy leaves behind.
    stdout_of(run("convert", "example:pr2", "pr2.urdf"))
    Path("ur10.calibration.toml").write_text("[base]\nxyz_m = [1.0, 0.0, 0.0]\n")
    for target in ("two.urdf", "two.dh.toml", "two.origins.csv", "two.yaml"):
        command = ("convert", "ur10.urdf", target, *(() if target == "two.urdf" else ("--tip", "tool0")))
        assert "note: ur10.calibration.toml is not copied" in run(*command)[2]
    # A sidecar without a manifest can be read with any robot.
    Path("two.calibration.toml").write_text("[base]\nxyz_m = [1.0, 0.0, 0.0]\n")
    note = "note: two.calibration.toml lies beside it and is read with it"
    assert note in run("convert", "ur10.urdf", "two.urdf")[2]
    assert read_robot("two.urdf").base[0, 3] == 1.0
    status, _, err = run("convert", "ur10.urdf", "three.urdf", "--convention", "modified")
    assert (status, "no DH convention" in err, Path("three.urdf").exists()) == (2, True, False)


def test_every_command_takes_a_robot_by_name(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    robot, tip = "example:ur10", ("--tip", "tool0")
    stdout_of(run("check", robot))
    stdout_of(run("simulate", robot, "-m", 30, "--noise", "0.1mm,0.01deg", "-o", "data.csv", *tip))
    stdout_of(run("calibrate", robot, "data.csv", "-o", "out.urdf", "--json", "r.json", *tip))
    assert str(UR10) in json.loads(Path("r.json").read_text())["inputs"]
    stdout_of(run("validate", "out.urdf", "data.csv", "--nominal", robot, *tip))
    stdout_of(run("inspect", "data.csv", "--robot", robot, *tip))
    stdout_of(run("plan", robot, "-n", 8, "--candidates", 60, "-o", "poses.csv", *tip))
    stdout_of(run("view", robot, "out.urdf", "--html", "scene.html", *tip))
    assert len(scene_of("scene.html")["meshes"]) == 7
    Path("targets.csv").write_text("x[mm],y[mm],z[mm]\n600,300,500\n")
    stdout_of(run("compensate", robot, "out.urdf", "targets.csv", "-o", "sent.csv", *tip))
    job = f'[[job]]\nrobot = "{robot}"\ntip = "tool0"\ndata = ["data.csv"]\noutput = "fleet.urdf"\n'
    Path("all.fleet.toml").write_text(job)
    stdout_of(run("calibrate", "all.fleet.toml", "-o", "summary.csv", "--jobs", 1))
    assert Path("fleet.urdf").read_bytes() == Path("out.urdf").read_bytes()
    Path("s.study.toml").write_text(
        f'seeds = 2\n[settings]\nrobot = "{robot}"\ntip = "tool0"\nnoise = "0.1mm,0.01deg"\nposes = 20\n'
    )
    stdout_of(run("study", "s.study.toml", "-o", "study.csv"))


def test_an_unknown_robot_lists_the_names(assert_refused):
    words = ["example:ur11", "unknown robot", "ur10", "panda"]
    assert_refused(words, "convert", "example:ur11", "new.urdf")
    assert_refused(words, "calibrate", "example:ur11", "data.csv", "-o", "out.urdf")
    assert_refused(words, "view", "arm.urdf", "example:ur11", "--html", "scene.html")
    Path("all.fleet.toml").write_text(
        '[[job]]\nrobot = "example:ur11"\ndata = ["data.csv"]\noutput = "out.urdf"\n'
    )
    assert_refused(words, "calibrate", "all.fleet.toml", "-o", "summary.csv")


@pytest.mark.parametrize("folder", ["share", "share/my_arm"])
def test_package_dir_finds_meshes(run, workspace, folder):
    stdout_of(run("view", "arm.urdf", "--html", "scene.html", "--package-dir", workspace / folder))
    assert (len(scene_of("scene.html")["meshes"]), scene_of("scene.html")["note"]) == (1, "")
    stdout_of(
        run("plan", "solid.urdf", "-n", 4, "--candidates", 20, "-o", "p.csv", "--json", "p.json",
            "--parameters", "offset", "--package-dir", workspace / folder)
    )  # fmt: skip
    assert not [note for note in json.loads(Path("p.json").read_text())["notes"] if "mesh" in note]


@pytest.mark.parametrize(("name", "folder"), [("ROS_PACKAGE_PATH", "share"), ("AMENT_PREFIX_PATH", ".")])
def test_environment_variables_of_ros_find_meshes(run, workspace, monkeypatch, name, folder):
    monkeypatch.setenv(name, f"/nowhere:{(workspace / folder).resolve()}")
    stdout_of(run("view", "arm.urdf", "--html", "scene.html"))
    assert len(scene_of("scene.html")["meshes"]) == 1


def test_missing_meshes_are_named_with_the_remedy(run, workspace):
    stdout_of(run("view", "arm.urdf", "--html", "scene.html"))
    note = scene_of("scene.html")["note"]
    for word in ("box.stl (link)", "package my_arm", "--package-dir", "ROS_PACKAGE_PATH", "AMENT_PREFIX"):
        assert word in note
    plan = ("plan", "solid.urdf", "-n", 4, "--candidates", 20, "-o", "p.csv", "--parameters", "offset")
    err = stderr_of(run(*plan))
    assert "mesh is missing" in err
    assert "the package my_arm with --package-dir" in err
    status, _, err = run(*plan, "--package-dir", "nowhere")
    assert (status, err.count("\n")) == (2, 1)
    assert "nowhere: no such folder" in err


def test_report_of_a_calibration_shows_the_meshes(run, workspace):
    shutil.copy("arm.urdf", "other.urdf")
    stdout_of(run("simulate", "arm.urdf", "-m", 20, "--noise", "0.1mm,0.01deg", "-o", "data.csv"))
    command = ("calibrate", "arm.urdf", "data.csv", "-o", "out.urdf", "--report", "r.html")
    stdout_of(run(*command, "--package-dir", workspace / "share", "--parameters", "offset,base,tool"))
    page = Path("r.html").read_text()
    assert "--package-dir" in page
    assert "Drawn as rods" not in page
