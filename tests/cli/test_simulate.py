"""Command simulate."""

from pathlib import Path

import numpy as np
import pytest
from command_line import error_of, stdout_of, tool_positions

from dhcal_pin.calibration import calibrate
from dhcal_pin.io import read_measurement_file, read_robot
from dhcal_pin.io.rig_file import read_rig
from dhcal_pin.io.tables import read_table
from dhcal_pin.robot import Chain


def test_seed_determines_the_file(run, robot_folder):
    args = ("simulate", "arm.urdf", "-m", "6", "--noise", "0.1mm,0.01deg")
    for name, seed in (("a.csv", 3), ("b.csv", 3), ("c.csv", 4)):
        stdout_of(run(*args, "--seed", seed, "-o", name))
    assert Path("a.csv").read_bytes() == Path("b.csv").read_bytes()
    assert Path("a.csv").read_text().splitlines()[2:] != Path("c.csv").read_text().splitlines()[2:]


def test_the_tip_is_shown(run, robot_folder):
    text = Path("arm.urdf").read_text()
    more = (
        '<link name="jaw"/><joint name="grip" type="prismatic"><parent link="tool"/><child link="jaw"/>'
        '<axis xyz="1 0 0"/><limit lower="0" upper="0.03" effort="1" velocity="1"/></joint>'
    )
    tip = Chain.from_urdf("arm.urdf").tip
    Path("grip.urdf").write_text(text.replace("</robot>", f"{more}</robot>".replace('"tool"', f'"{tip}"')))
    for options, expected in (((), "tip jaw, 4 joints"), (("--tip", tip), f"tip {tip}, 3 joints")):
        said = run("simulate", "grip.urdf", "-m", "6", "-o", "s.csv", *options)[2]
        assert said.startswith(f"grip.urdf: {expected} from joint_1 to ")


def test_positions_equal_closed_form(run, robot_folder):
    stdout_of(run("simulate", "arm.urdf", "-m", "50", "--kind", "position", "-o", "s.csv"))
    measured = read_measurement_file("s.csv", Chain.from_urdf("arm.urdf")).data
    np.testing.assert_allclose(measured.positions() * 1e3, tool_positions(np.degrees(measured.q)), atol=1e-10)


def test_noise_has_the_given_standard_deviation(run, robot_folder):
    stdout_of(run("simulate", "arm.urdf", "-m", "3000", "--noise", "0.2mm,1mrad", "-o", "s.csv"))
    measured = read_measurement_file("s.csv", Chain.from_urdf("arm.urdf")).data
    off = measured.positions() * 1e3 - tool_positions(np.degrees(measured.q))
    np.testing.assert_allclose(off.std(0), 0.2, rtol=0.05)
    assert measured.has_stated_sigma
    errors = measured.errors(Chain.from_urdf("arm.urdf").forward_kinematics(measured.q), np.empty(0))[
        "orientation"
    ]
    np.testing.assert_allclose(errors.std(0), 1e-3, rtol=0.05)


def test_noise_of_images_is_in_pixels(run, robot_folder):
    """The simulated cameras show a millimetre as a pixel. Other kinds have no pixels."""
    command = ("simulate", "arm.urdf", "-m", "500", "--kind", "camera", "-o")
    pixels = {}
    for name, noise in (("exact.csv", "0mm"), ("a.csv", "0.2px"), ("b.csv", "0.2mm")):
        stdout_of(run(*command, name, "--noise", noise))
        table = read_table(name)
        pixels[name] = np.stack([table.values(table.columns[column].index) for column in "uv"])
    np.testing.assert_array_equal(pixels["a.csv"], pixels["b.csv"])
    np.testing.assert_allclose((pixels["a.csv"] - pixels["exact.csv"]).std(1), 0.2, rtol=0.05)
    assert Path("a.rig.toml").exists()
    for kind, noise in (("pose", "0.2px"), ("camera", "xpx")):
        status, _, err = run(
            "simulate", "arm.urdf", "-m", "5", "--kind", kind, "--noise", noise, "-o", "c.csv"
        )
        assert (status, f"--sigma '{noise}': not a number with a unit" in err) == (2, True)


@pytest.mark.parametrize(
    ("kind", "noise"), [("camera", "0.1deg"), ("position", "0.01deg"), ("inclination", "1mm")]
)
def test_noise_applies_to_the_kind(assert_refused, kind, noise):
    """A value that the kind does not need is ignored beside one that it needs, but not alone."""
    command = ("simulate", "arm.urdf", "-m", "5", "--kind", kind, "-o", "c.csv", "--sigma")
    assert_refused([f"--sigma {noise}: does not apply to the kind {kind}"], *command, noise)


@pytest.mark.parametrize("seed", range(5))
def test_all_corners_are_in_the_images(run, robot_folder, seed):
    """The reach of a UR10 is larger than usual images."""
    command = ("simulate", "example:ur10", "--tip", "tool0", "-n", "50", "--kind", "camera")
    stdout_of(run(*command, "--sigma", "0.2px", "--seed", seed, "-o", "a.csv"))
    table, cameras = read_table("a.csv"), read_rig("a.rig.toml").cameras
    widths = np.array([cameras[name].width for name in table.text(table.columns["camera"])])
    for name in "uv":
        pixels = table.values(table.columns[name].index)
        assert np.all((pixels > -0.5) & (pixels < widths - 0.5))


def test_random_errors_have_the_given_standard_deviation(run, robot_folder):
    """The nominal robot with base and tool fitted leaves the errors of three joint origins."""
    command = ("simulate", "arm.urdf", "-m", "40", "--kind", "pose")
    stdout_of(run(*command, "--errors", "1mm,0.3deg", "-o", "a.csv"))
    stdout_of(run(*command, "--errors", "1mm,0.3deg", "--seed", "1", "-o", "b.csv"))
    stdout_of(run(*command, "--errors", "0mm", "-o", "exact.csv"))
    nominal = Chain.from_urdf("arm.urdf")
    norms = {}
    for name in ("a.csv", "b.csv", "exact.csv"):
        measured = read_measurement_file(name, nominal).data
        norms[name] = np.linalg.norm(measured.positions() - nominal.poses(measured.q)[:, :3, 3], axis=1)
    assert norms["exact.csv"].max() < 1e-12
    assert (norms["a.csv"][:10] != norms["b.csv"][:10]).all()
    # 0.3 degrees turn an arm of 745 mm by 4 mm.
    assert 1e-3 < np.median(norms["a.csv"]) < 2e-2
    status, _, err = run(*command, "--errors", "1mm", "--truth", "arm.dh.toml", "-o", "c.csv")
    assert (status, "--errors: not allowed with --truth" in err) == (2, True)


@pytest.mark.parametrize(
    ("lower", "upper"), [(-30.0, 45.0), (190.0, 300.0), (-400.0, -200.0), (-10.0, 600.0)]
)
def test_joint_positions_respect_limits(run, robot_folder, lower, upper):
    table = Path("arm.dh.toml").read_text()
    first = table.index("[[joint]]", table.index("[[joint]]") + 1)
    Path("tight.dh.toml").write_text(f"{table[:first]}lower = {lower}\nupper = {upper}\n{table[first:]}")
    stdout_of(run("simulate", "tight.dh.toml", "-m", "200", "-o", "s.csv"))
    q = np.degrees(read_measurement_file("s.csv", read_robot("tight.dh.toml")).data.q)
    assert lower <= q[:, 0].min() < q[:, 0].max() <= upper
    assert np.ptp(q[:, 0]) > 0.5 * min(upper - lower, 180)
    assert np.abs(q[:, 1:]).max() <= 180


def test_known_distances_are_those_of_the_touched_points(run, robot_folder):
    """Touches alone leave the size of the robot open; with distances of the same simulation it is found."""
    for kind in ("point", "point_distance"):
        words = ("-n", "60", "--errors", "1mm,0.3deg", "--kind", kind, "--seed", "4", "-o", f"{kind}.csv")
        stdout_of(run("simulate", "arm.urdf", *words))
    chain = Chain.from_urdf("arm.urdf")
    files = ("point.csv", "point_distance.csv")
    touches, known = (read_measurement_file(file, chain).data for file in files)
    fit = calibrate(chain, [touches, known], "minimal,tool", extend="none")
    points = np.array([[fit.instruments[f"point_{name}.{axis}"] for axis in "xyz"] for name in known.names])
    lengths = np.linalg.norm(points[known.label[:, 1]] - points[known.label[:, 0]], axis=1)
    np.testing.assert_allclose(lengths, known.values[:, 0], atol=1e-6)
    err = error_of(run("simulate", "arm.urdf", "-n", "1", "--kind", "point_distance", "-o", "one.csv"))
    assert "expected 2 samples or more" in err
