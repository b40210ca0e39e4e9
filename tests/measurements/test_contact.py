"""Distances between touched points need contacts with these points."""

from pathlib import Path

import numpy as np
import pytest
from robots import URDF

from dhcal_pin import calibrate
from dhcal_pin.cli.main import main
from dhcal_pin.exceptions import UnknownNameError
from dhcal_pin.io import measurement_text
from dhcal_pin.measurements import Noise, PointContact, PointDistance, Position

pytestmark = pytest.mark.usefixtures("unsuspected")


def test_distances_between_points_that_nothing_touches_are_refused(sim_6dof, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    data = PointContact.simulate(sim_6dof, rng.uniform(-2, 2, (40, 6)), Noise(1e-4), rng)
    Path("arm.urdf").write_bytes((URDF / "sim_6dof.urdf").read_bytes())
    Path("touches.csv").write_text(measurement_text(data, sim_6dof))
    Path("distances.csv").write_text("point_a,point_b,distance[mm]\np1,socket,400\n")
    expected = "dhcal: distances.csv: no measurement touches the point 'socket'; choose from p1, p2, p3, p4\n"
    for command in (["calibrate", "-o", "out.urdf"], ["validate"]):
        assert main([command[0], "arm.urdf", "touches.csv", "distances.csv", *command[1:]]) == 2
        assert capsys.readouterr().err == expected
    assert not Path("out.urdf").exists()
    # Coordinates that are given need no contact.
    Path("rig.toml").write_text(
        "[instrument]\n" + "".join(f'"point_socket.{axis}" = 0.4\n' for axis in "xyz")
    )
    arguments = ["touches.csv", "distances.csv", "--instrument", "rig.toml", "-o", "out.urdf", "--force"]
    assert main(["calibrate", "arm.urdf", *arguments]) == 0


def test_distances_beside_positions_need_touches_in_python(sim_6dof):
    rng = np.random.default_rng(0)
    q = rng.uniform(-2, 2, (20, 6))
    distances = PointDistance(6, [("a", "b")], [0.4])
    positions = Position.simulate(sim_6dof, q, Noise(1e-4), rng)
    with pytest.raises(UnknownNameError, match="no measurement touches the point 'a'; expected"):
        calibrate(sim_6dof, [positions, distances])
