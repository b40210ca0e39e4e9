"""Robots of example-robot-data by name, and the folders in which meshes are found."""

from importlib import metadata
from pathlib import Path

import pytest
from robots import robot_file

from dhcal_pin.exceptions import DhcalError
from dhcal_pin.robot import Chain
from dhcal_pin.ros_packages import example_robots, mesh_folders, mesh_remedy, resolve_robot_path


def test_robots_have_the_names_of_their_files():
    robots = example_robots()
    # As the loaders of example-robot-data name them.
    assert robots["ur10"] == robot_file("ur_description/urdf/ur10_robot.urdf")
    assert robots["ur3"] == robot_file("ur_description/urdf/ur3_robot.urdf")
    assert robots["panda"] == robot_file("panda_description/urdf/panda.urdf")
    assert robots["anymal_c_simple_description/anymal"].parts[-3] == "anymal_c_simple_description"
    assert len(set(robots.values())) == len(robots) > 50
    assert list(robots) == sorted(robots)


def test_a_robot_is_read_by_name():
    by_name = Chain.from_urdf("example:ur10", "tool0")
    by_path = Chain.from_urdf(robot_file("ur_description/urdf/ur10_robot.urdf"), "tool0")
    assert by_name.urdf.data == by_path.urdf.data
    assert by_name.urdf.source == by_path.urdf.source
    assert resolve_robot_path(Path("arm.urdf")) == "arm.urdf"


def test_an_unknown_name_lists_all_names():
    with pytest.raises(DhcalError, match=r"^example:ur11: unknown robot .* panda, .* ur10, .* z1$"):
        resolve_robot_path("example:ur11")


def test_without_the_package_the_message_says_how_to_install_it(monkeypatch):
    def absent(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "distribution", absent)
    with pytest.raises(DhcalError, match=r"pip install 'dhcal-pin\[robots\]'"):
        resolve_robot_path("example:ur10")
    assert mesh_folders("/one/two/r.urdf", ["/meshes/arm"]) == [
        "/meshes/arm",
        "/meshes",
        "/one/two",
        "/one",
        "/",
    ]


def test_remedy_names_the_package():
    assert "the package ur_description with --package-dir" in mesh_remedy("package://ur_description/base.stl")
    assert "ROS_PACKAGE_PATH or AMENT_PREFIX_PATH" in mesh_remedy("meshes/base.stl")
