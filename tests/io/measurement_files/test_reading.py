"""Measurement files: units, digits, rotations, and errors that name the problem."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from robots import SCARA, write

from dhcal_pin import se3
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io import measurement_text, read_dh, read_measurement_file, read_measurements
from dhcal_pin.measurements import Pose, Position
from dhcal_pin.robot import Chain

HEADER = "shoulder[deg],lift[mm],x[mm],y[mm],z[mm]\n"


def test_values_are_in_si_units_and_in_the_order_of_the_file(tmp_path, scara):
    text = "# FARO\n\n" + HEADER + "90,-100,606.8,1,2\n\n# pause\n45,0,3,4,5\n"
    readings = read_measurement_file(write(tmp_path, "a.csv", text), scara)
    assert readings.data.q.tolist() == [[np.pi / 2, -0.1], [np.pi / 4, 0.0]]
    assert readings.data.positions().tolist() == [[0.6068, 0.001, 0.002], [0.003, 0.004, 0.005]]
    assert (readings.data.rows.tolist(), readings.data.source) == ([4, 7], str(tmp_path / "a.csv"))
    assert not readings.data.has_stated_sigma
    assert readings.commanded is None
    assert readings.measured_after is None


@pytest.mark.parametrize(
    ("header", "row"),
    [("x[m],y[m],z[m]", "0.6068,0.001,0.002"), ("z[um],x[cm],y[mm]", "2000,60.68,1")],
)
def test_any_unit_and_order_of_columns(tmp_path, header, row, scara):
    text = f"lift[m],{header},shoulder[mrad]\n-0.1,{row},250\n"
    data = read_measurements(write(tmp_path, "a.csv", text), scara)
    assert data.q.tolist() == [[0.25, -0.1]]
    assert data.positions().tolist() == [[0.6068, 0.001, 0.002]]


def test_byte_order_mark_and_windows_line_ends(tmp_path, scara):
    text = b"\xef\xbb\xbf" + HEADER.replace("\n", "\r\n").encode() + b"90,0,1,2,3\r\n"
    data = read_measurements(write(tmp_path, "a.csv", text), scara)
    assert data.positions().tolist() == [[0.001, 0.002, 0.003]]


def test_quaternions_and_rotation_vectors_agree(tmp_path, scara):
    # A turn by 120° about (1, 1, 1) takes x to y, y to z, z to x.
    third = 2 * np.pi / 3 / np.sqrt(3)
    cycle = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    chain, head = scara, HEADER.strip()
    for columns, cells in (
        ("qw,qx,qy,qz", "0.5,0.5,0.5,0.5"),
        ("qw,qx,qy,qz", "-0.5,-0.5,-0.5,-0.5"),
        ("qw,qx,qy,qz", "0.5001,0.5001,0.5001,0.5001"),
        ("rx[rad],ry[rad],rz[rad]", f"{third},{third},{third}"),
        ("rx[deg],ry[deg],rz[deg]", ",".join([f"{120 / np.sqrt(3)}"] * 3)),
    ):
        text = f"{head},{columns}\n0,0,1,2,3,{cells}\n"
        data = read_measurements(write(tmp_path, "a.csv", text), chain)
        np.testing.assert_allclose(data.rotations()[0], cycle, atol=1e-15)


def test_sigmas_sets_and_commanded_positions(tmp_path, scara):
    text = (
        HEADER.strip()
        + ",sigma_x[um],sigma_y[um],sigma_z[um],set,pose_id,commanded_x[mm],commanded_y[mm],commanded_z[mm]\n"
        + "0,0,1,2,3,10,20,30,fit,a,7,8,9\n90,0,1,2,3,10,20,40,holdout,b,7,8,9\n"
    )
    readings = read_measurement_file(write(tmp_path, "a.csv", text), scara)
    assert isinstance(readings.data, Position)
    assert readings.data.has_stated_sigma
    assert readings.data.sigma.tolist() == [[1e-5, 2e-5, 3e-5], [1e-5, 2e-5, 4e-5]]
    assert readings.fit.rows.tolist() == [2]
    assert readings.holdout.rows.tolist() == [3]
    assert readings.holdout.q[0, 0] == np.pi / 2
    assert readings.commanded is not None
    assert readings.commanded.tolist() == [[0.007, 0.008, 0.009]] * 2


def doubles(limit):
    return st.floats(-limit, limit)


@settings(max_examples=80, deadline=None)
@given(rows=st.lists(st.lists(doubles(1e3), min_size=5, max_size=5), min_size=1, max_size=4), data=st.data())
def test_written_positions_read_back_bit_identical(tmp_path_factory, rows, data, scara):
    folder, rows = tmp_path_factory.mktemp("csv"), np.array(rows)
    chain = scara
    sigma = data.draw(st.one_of(st.none(), st.floats(1e-9, 1.0)))
    wrote = Position(rows[:, :2], rows[:, 2:], sigma)
    again = read_measurements(write(folder, "a.csv", measurement_text(wrote, chain, ["a", "b"])), chain)
    assert isinstance(again, Position)
    assert again.q.tolist() == wrote.q.tolist()
    assert again.values.tolist() == wrote.values.tolist()
    assert again.has_stated_sigma == (sigma is not None)
    assert again.sigma.tolist() == wrote.sigma.tolist()


@settings(max_examples=80, deadline=None)
@given(
    rows=st.lists(st.lists(doubles(1e3), min_size=5, max_size=5), min_size=1, max_size=4),
    axis=st.lists(doubles(1.0), min_size=3, max_size=3).filter(lambda v: np.linalg.norm(v) > 0.1),
    angle=st.one_of(st.floats(0, np.pi), st.sampled_from([0.0, 1e-12, np.pi / 2, np.pi - 1e-9, np.pi])),
)
def test_written_poses_keep_their_rotation(tmp_path_factory, rows, axis, angle, scara):
    folder, rows = tmp_path_factory.mktemp("csv"), np.array(rows)
    chain = scara
    turn = se3.exp3(angle * np.array(axis) / np.linalg.norm(axis))
    poses = se3.transform(np.tile(turn, (len(rows), 1, 1)), rows[:, 2:])
    wrote = Pose(rows[:, :2], poses, 1e-4, 1e-5)
    again = read_measurements(write(folder, "a.csv", measurement_text(wrote, chain)), chain)
    assert isinstance(again, Pose)
    assert again.q.tolist() == wrote.q.tolist()
    assert again.positions().tolist() == rows[:, 2:].tolist()
    # Rounding of the rotation handed in is up to 1e-15 by itself.
    np.testing.assert_allclose(again.rotations(), wrote.rotations(), rtol=0, atol=2e-15)
    assert again.rotation_sigma.tolist() == wrote.rotation_sigma.tolist()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("x", "'x' has the name of a measurement column; rename"),
        ("to:shoulder", "'to:shoulder' starts with 'to:', .* second configuration of a row; rename"),
    ],
)
def test_a_joint_with_the_name_of_a_measurement_column_is_an_error(tmp_path, name, message):
    gantry = Chain.from_dh(read_dh(write(tmp_path, "g.dh.toml", SCARA.replace('"lift"', f'"{name}"'))))
    for act in (
        lambda: read_measurement_file(write(tmp_path, "a.csv", HEADER + "0,0,1,2,3\n"), gantry),
        lambda: measurement_text(Position(np.zeros((1, 2)), np.zeros((1, 3))), gantry),
    ):
        with pytest.raises(DhcalError, match=message):
            act()
