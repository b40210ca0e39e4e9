"""Programs for controllers, read back as the controllers read them."""

import csv
import io
import re

import numpy as np
import pytest
from robots import measured_arm, nominal_arm, paper
from scipy.spatial.transform import Rotation

from dhcal_pin.exceptions import DhcalError
from dhcal_pin.programs import REST_TIME, Program, Stop, program_text
from dhcal_pin.robot import Chain


def program_of(chain: Chain, count: int = 5, **options) -> Program:
    q = np.random.default_rng(0).uniform(-1, 1, (count, chain.n_joints))
    poses = chain.poses(q)
    stops = [Stop(f"pose {i + 1}", q[i], poses[i]) for i in range(count)]
    for i, changes in options.pop("changes", {}).items():
        stops[i] = Stop(stops[i].name, stops[i].q, stops[i].pose, **changes)
    return Program(chain, "test", "Mind the arm.", stops)


def run_urscript(text: str) -> list[tuple]:
    """Execute the statements of a script: moves with joint positions and speeds, rests and popups."""
    head, *lines = [line for line in text.splitlines() if not line.lstrip().startswith("#")]
    assert head == "def dhcal_program():"
    assert lines[-2:] == ["end", "dhcal_program()"]
    variables, events = {}, []
    for line in lines[:-2]:
        statement = line.split("#")[0].strip()
        if match := re.fullmatch(r"(\w+) = ([\d.]+)", statement):
            variables[match[1]] = float(match[2])
        elif match := re.fullmatch(r"movej\(\[(.*)\], a=(\w+), v=(\w+)\)", statement):
            q = np.array(match[1].split(", "), float)
            events.append(("move", q, variables[match[2]], variables[match[3]]))
        elif match := re.fullmatch(r"sleep\((\w+)\)", statement):
            events.append(("rest", variables[match[1]]))
        else:
            match = re.fullmatch(r'popup\("([^"]*)", title="dhcal", warning=True, blocking=True\)', statement)
            assert match, statement
            events.append(("popup", match[1]))
    return events


def test_urscript_moves_slowly_and_rests_at_every_stop():
    program = program_of(nominal_arm("ur10"))
    events = run_urscript(program_text(program, "moves.script"))
    assert events[0] == ("popup", "Mind the arm.")
    assert [event[0] for event in events[1:]] == ["move", "rest"] * 5
    for stop, move, rest in zip(program.stops, events[1::2], events[2::2], strict=True):
        np.testing.assert_allclose(move[1], stop.q, atol=5e-10)
        assert max(move[2:]) <= 0.5
        assert rest[1] == REST_TIME


def test_urscript_passes_way_points_and_waits_before_a_move_that_may_collide():
    way = np.full(6, 0.25)
    program = program_of(nominal_arm("ur10"), changes={2: {"way": (way,)}, 3: {"is_way_free": False}})
    events = run_urscript(program_text(program, "moves.SCRIPT"))
    kinds = [event[0] for event in events]
    assert kinds == ["popup", *["move", "rest"] * 2, "move", "move", "rest", "popup", *["move", "rest"] * 2]
    np.testing.assert_array_equal(events[5][1], way)
    assert "to pose 4, may collide" in events[8][1]


@pytest.mark.parametrize("name", ["slide", "panda"])
def test_urscript_is_for_six_revolute_joints(name):
    with pytest.raises(DhcalError, match="6 revolute joints"):
        program_text(program_of(measured_arm(name)), "moves.script")


@pytest.mark.parametrize("arm", [lambda: nominal_arm("ur10"), lambda: measured_arm("slide")])
def test_trajectory_respects_speeds_and_rests(arm):
    chain = arm()
    way = np.full(chain.n_joints, 0.1)
    program = program_of(chain, changes={1: {"way": (way,)}})
    head, *lines = program_text(program, "a.trajectory.csv").splitlines()
    assert head.split(",") == ["time", *chain.joint_names]
    table = np.array([line.split(",") for line in lines], float)
    time, q = table[:, 0], table[:, 1:]
    assert time[0] == 0
    assert len(table) == 11
    steps, moved = np.diff(time), np.diff(q, axis=0)
    rests = ~moved.any(1)
    assert rests.sum() == 5
    np.testing.assert_allclose(steps[rests], REST_TIME, atol=1e-6)
    rates = np.abs(moved[~rests]) / steps[~rests, None]
    limit = np.where(chain.is_prismatic, 0.1, 0.5)
    assert (rates <= limit * (1 + 1e-6)).all()
    # One joint moves at the limit, so the arm is not slower than it must be.
    np.testing.assert_allclose((rates / limit).max(1), 1, atol=1e-6)
    np.testing.assert_allclose(q[[0, 3, 5, 7, 9]], [stop.q for stop in program.stops], atol=5e-10)
    np.testing.assert_array_equal(q[2], way)


def test_trajectory_respects_velocity_limits_of_the_urdf():
    chain = Chain.from_urdf("example:so100")
    limit = float(chain.model.velocityLimit[0])
    program = program_of(chain)
    table = np.loadtxt(io.StringIO(program_text(program, "a.trajectory.csv")), delimiter=",", skiprows=1)
    steps = np.diff(table, axis=0)
    moving = steps[:, 1:].any(1)
    assert (np.abs(steps[moving, 1]) / steps[moving, 0] <= min(0.5, limit / 2) * (1 + 1e-6)).all()


def test_trajectory_does_not_contain_a_move_that_may_collide():
    program = program_of(nominal_arm("ur10"), changes={3: {"is_way_free": False}})
    with pytest.raises(DhcalError, match=r"the way to pose 4 may collide.*\.script"):
        program_text(program, "a.trajectory.csv")


def test_robodk_table_has_degrees_millimetres_and_the_angles_of_robodk():
    chain = measured_arm("slide")
    program = program_of(chain)
    rows = list(csv.DictReader(io.StringIO(program_text(program, "a.robodk.csv"))))
    assert list(rows[0]) == ["J1", "J2", "J3", "J4", "J5", "X", "Y", "Z", "R", "P", "W"]
    for row, stop in zip(rows, program.stops, strict=True):
        values = {key: float(value) for key, value in row.items()}
        assert values["J1"] == pytest.approx(np.degrees(stop.q[0]), abs=1e-8)
        assert values["J3"] == pytest.approx(1e3 * stop.q[2], abs=1e-8)
        np.testing.assert_allclose([values[key] for key in "XYZ"], 1e3 * stop.pose[:3, 3], atol=1e-8)
        # RoboDK: transl(x, y, z)*rotz(w)*roty(p)*rotx(r).
        turned = Rotation.from_euler("ZYX", [values[key] for key in "WPR"], degrees=True)
        np.testing.assert_allclose(turned.as_matrix(), stop.pose[:3, :3], atol=1e-9)


def test_unknown_endings_are_refused():
    with pytest.raises(DhcalError, match=r"a\.txt: unknown ending; choose from \.script"):
        program_text(program_of(Chain.from_dh(paper("sim_6dof"))), "a.txt")
