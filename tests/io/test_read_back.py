"""Robots that other programs read back before they are written."""

from dataclasses import replace

import numpy as np
import pytest
from mjcf_robots import ROBOTS
from robots import URDF, nominal_arm, robot_file, write

from dhcal_pin import se3
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io import read_back, read_robot, urdf_files
from dhcal_pin.io.read_back import READER_TOL, READERS, Reader, require_agreement
from dhcal_pin.robot import Chain
from dhcal_pin.robot.formats.mjcf import parse_mjcf


def robots() -> dict[str, Chain]:
    arms = {
        name: Chain.from_urdf(parse_mjcf(text.encode(), f"{name}.xml"), tip)
        for name, (text, tip) in ROBOTS.items()
    }
    arms["ur10"] = nominal_arm("ur10")
    arms["talos, from the left hand"] = read_robot(
        robot_file("talos_data/robots/talos_reduced.urdf"), "gripper_right_base_link", root="arm_left_7_link"
    )
    return arms


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_all_programs_agree(reader):
    arms = [chain for chain in robots().values() if type(chain.urdf) in reader.reads]
    assert len(arms) >= 2
    q = np.random.default_rng(0).uniform(-2, 2, (5, 64))
    for chain in arms:
        values = q[:, : chain.n_joints]
        np.testing.assert_allclose(reader.poses(chain, values), chain.poses(values), atol=1e-12)


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
@pytest.mark.parametrize(("error", "is_refused"), [(0.1 * READER_TOL, False), (10 * READER_TOL, True)])
def test_a_robot_that_a_program_reads_differently_is_not_written(
    monkeypatch, tmp_path, reader, error, is_refused
):
    def wrong(chain, q):
        shift = 0.0 if chain.urdf.source.endswith("nominal") else error
        return reader.poses(chain, q) @ se3.translation([0, shift, 0])

    name = "ur5e" if "MuJoCo" in reader.name else "ur10"
    nominal = robots()[name]
    nominal = Chain.from_urdf(replace(nominal.urdf, source="nominal"), nominal.tip)
    monkeypatch.setattr(read_back, "READERS", (reader._replace(poses=wrong),))
    path = tmp_path / ("out.xml" if name == "ur5e" else "out.urdf")
    if not is_refused:
        assert urdf_files(nominal, path)
        return
    words = rf"not written: {reader.name} computes a tip that differs by 9\.9e-09|1e-08"
    with pytest.raises(DhcalError, match=words):
        urdf_files(nominal, path)
    assert not list(tmp_path.iterdir())


def broken(chain, q):
    raise RuntimeError("not read")


def test_a_program_that_does_not_read_the_nominal_robot_is_left_out(monkeypatch, tmp_path):
    chain = read_robot(URDF / "sim_6dof.urdf")
    readers = (
        Reader("P", "pinocchio", (type(chain.urdf),), broken),
        Reader("Q", "no_such_module", (type(chain.urdf),), broken),
    )
    monkeypatch.setattr(read_back, "READERS", readers)
    require_agreement(chain, chain, tmp_path / "out.urdf")
    monkeypatch.setattr(
        read_back,
        "READERS",
        (
            readers[0]._replace(
                poses=lambda chain, q: broken(chain, q) if chain is not nominal else chain.poses(q)
            ),
        ),
    )
    nominal = chain.nominal()
    with pytest.raises(DhcalError, match=r"out\.urdf: not written: P cannot read it"):
        require_agreement(chain, nominal, tmp_path / "out.urdf")


def test_axes_that_are_not_normalized_do_not_stop_a_calibration(tmp_path):
    """A prismatic joint moves twice as far in yourdfpy."""
    text = (URDF / "sim_6dof.urdf").read_text()
    path = write(
        tmp_path,
        "arm.urdf",
        text.replace('type="revolute"', 'type="prismatic"', 1).replace(
            '<axis xyz="0 0 1"/>', '<axis xyz="0 0 2"/>', 1
        ),
    )
    chain = read_robot(path)
    files = urdf_files(chain.perturbed_at({2: se3.translation([1e-3, 0, 0])}), tmp_path / "out.urdf")
    assert (tmp_path / "out.urdf") in files
