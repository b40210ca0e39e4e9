"""The written URDF without its sidecar, against Pinocchio, known true arms and real series."""

import json
import tomllib
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from robots import DATA, MAPS, missing, nominal_arm, robot_file
from slow_cases import some_slow

import dhcal_pin as dh
from dhcal_pin.cli import main
from dhcal_pin.diagnostics import fit_frames
from dhcal_pin.exceptions import UnknownNameError
from dhcal_pin.io import read_measurements, read_robot
from dhcal_pin.measurements import Measurement
from dhcal_pin.robot import Chain, Transmission

pytestmark = pytest.mark.usefixtures("unsuspected")

UR5 = "ur_description/urdf/ur5_robot.urdf"
# Largest ratio of the error of the URDF alone to that of a calibration without joint errors.
MAX_RATIO = 1.02


def true_arm(nominal: Chain, rng: np.random.Generator) -> Chain:
    """Return the arm with errors of its geometry and eccentric joints."""
    motions = np.tile(np.eye(4), (nominal.tool_frame_index + 1, 1, 1))
    for j in range(2, nominal.tip_frame):
        xi = np.concatenate([rng.normal(0, 4e-4, 3), rng.normal(0, 1e-3, 3)])
        motions[j] = pin.exp6(xi).homogeneous
    transmission = Transmission.zero(nominal.loads)
    transmission.harmonics[:2] = rng.normal(0, 6e-4, (2, 2, nominal.n_joints))
    return nominal.perturbed(motions).with_transmission(transmission)


@pytest.fixture(scope="module")
def calibrated():
    """Nominal and true arm, and calibrations of 150 positions with and without joint errors."""
    rng = np.random.default_rng(11)
    nominal = nominal_arm("ur5")
    truth = true_arm(nominal, rng)
    q = rng.uniform(-1.5, 1.5, (150, 6))
    tool = np.array([0.05, 0.02, 0.1])
    poses = truth.poses(q)
    data = dh.Position(q, (poses[:, :3, :3] @ tool + poses[:, :3, 3]) + rng.normal(0, 3e-5, (150, 3)))
    return truth, tool, dh.calibrate(nominal, data), dh.calibrate(nominal, data, extend="none")


def error_of(chain: Chain, *data: Measurement) -> float:
    """Return the RMS error of the position with the base and the tool that fit best [m]."""
    return fit_frames(chain, data, {}).comparisons[-1].after["position_rms_m"]


def test_urdf_alone_is_as_good_as_a_calibration_without_joint_errors(calibrated):
    truth, tool, fit, geometry = calibrated
    assert fit.chain.error_families
    q = np.random.default_rng(12).uniform(-1.5, 1.5, (400, 6))
    poses = truth.poses(q)
    fresh = dh.Position(q, poses[:, :3, :3] @ tool + poses[:, :3, 3])
    alone, none, complete = (
        error_of(chain, fresh) for chain in (fit.chain.urdf_alone, geometry.chain, fit.chain)
    )
    assert alone <= MAX_RATIO * none
    assert complete < 0.2 * alone
    # Its own base and tool are those of the complete model.
    stated_frames = dh.Result.validate(replace(geometry, chain=fit.chain.urdf_alone), fresh)
    assert stated_frames["position_rms_m"] < 1.1 * alone
    # The origins that belong to the joint errors are worse without them.
    assert error_of(replace(fit.chain, transmission=None), fresh) > 1.03 * alone
    stated = fit.comparisons[0].after_alone
    assert stated is not None
    assert alone == pytest.approx(stated["position_rms_m"], rel=0.2)


def test_urdf_and_sidecar_together_are_the_fitted_model(calibrated, tmp_path):
    *_, fit, _ = calibrated
    path = tmp_path / "arm.urdf"
    dh.write_urdf(fit, path)
    q = np.random.default_rng(13).uniform(-3, 3, (50, 6))
    expected = fit.chain.poses(q)
    np.testing.assert_allclose(read_robot(path, "tool0").poses(q), expected, rtol=0, atol=1e-12)

    # An independent reader: Pinocchio, and the sidecar as its documentation describes it.
    sidecar = tomllib.loads((tmp_path / "arm.calibration.toml").read_text())
    model = pin.buildModelFromUrdf(str(path))
    for placement, expected_placement in zip(model.jointPlacements, fit.model.jointPlacements, strict=True):
        np.testing.assert_allclose(placement.homogeneous, expected_placement.homogeneous, rtol=0, atol=1e-14)
    pose = {
        name: pin.SE3(pin.exp3(np.array(table["rotvec_rad"])), np.array(table["xyz_m"])).homogeneous
        for name, table in {**sidecar["link"], "": sidecar["base"], "tool": sidecar["tool"]}.items()
    }
    for link in sidecar["link"]:
        frame = model.frames[model.getFrameId(link)]
        if model.frames[frame.parentFrame].parentJoint == frame.parentJoint and frame.name == "tool0":
            model.frames[model.getFrameId(link)].placement *= pin.SE3(pose[link])
        else:
            model.jointPlacements[frame.parentJoint] *= pin.SE3(pose[link])
    loads = pin.buildModelFromUrdf(str(path))
    loads_data, data = loads.createData(), model.createData()
    for position, target in zip(q, expected, strict=True):
        torque = pin.computeGeneralizedGravity(loads, loads_data, position)
        actual = position.copy()
        for i, name in enumerate(fit.chain.joint_names):
            terms = sidecar["joint"].get(name, {})
            actual[i] += sum(
                s * np.sin(k * position[i]) + c * np.cos(k * position[i])
                for k, s, c in terms.get("harmonics", [])
            )
            actual[i] += terms.get("gain", 0) * position[i]
            actual[i] += terms.get("compliance_rad_per_nm", 0) * torque[i]
            actual[i] += sum(
                value * position[fit.chain.joint_names.index(other)]
                for other, value in terms.get("coupling", {}).items()
            )
        pin.framesForwardKinematics(model, data, actual)
        tip = data.oMf[model.getFrameId("tool0")].homogeneous
        np.testing.assert_allclose(pose[""] @ tip @ pose["tool"], target, rtol=0, atol=1e-12)


def test_robot_that_is_read_is_written_again_equally(calibrated, tmp_path):
    *_, fit, _ = calibrated
    first, second = tmp_path / "first.urdf", tmp_path / "second.urdf"
    dh.write_urdf(fit, first)
    read = read_robot(first, "tool0")
    dh.write_urdf(read, second)
    assert first.read_bytes() == second.read_bytes()
    q = np.random.default_rng(14).uniform(-3, 3, (20, 6))
    np.testing.assert_allclose(read_robot(second, "tool0").poses(q), read.poses(q), rtol=0, atol=1e-13)


def test_calibration_without_joint_errors_adds_nothing_to_the_urdf(calibrated, tmp_path):
    *_, fit = calibrated
    dh.write_urdf(fit, tmp_path / "arm.urdf")
    assert "[link" not in (tmp_path / "arm.calibration.toml").read_text()
    assert fit.comparisons[0].after_alone is None


def test_unknown_link_of_a_sidecar_is_named(calibrated, tmp_path):
    *_, fit, _ = calibrated
    dh.write_urdf(fit, tmp_path / "arm.urdf")
    sidecar = tmp_path / "arm.calibration.toml"
    sidecar.write_text(sidecar.read_text().replace("[link.forearm_link]", "[link.forarm_link]"))
    with pytest.raises(UnknownNameError, match=r"arm\.calibration\.toml.*'forarm_link'.*forearm_link"):
        read_robot(tmp_path / "arm.urdf", "tool0")


@pytest.mark.parametrize(
    "series",
    some_slow(["Series_D/measurements_iso_cubes", "Series_B/measurements_joint_configurations"], ()),
)
def test_urdf_alone_of_half_a_real_series(series):
    """The other half is judged, which was not fitted."""
    if not DATA.exists():
        missing(f"measurements at {DATA}")
    nominal = read_robot("example:ur10", "tool0")
    data = read_measurements(DATA / f"ipa_ur10/{series}.csv", nominal, columns=MAPS / "ipa_ur10.toml")
    is_fitted = np.random.default_rng(5).permutation(len(data.rows)) % 2 == 0
    fitted, other = data.take(is_fitted), data.take(~is_fitted)
    # `test_no_real_series_is_refused` examines the sessions.
    fit, geometry = (dh.calibrate(nominal, fitted, extend=each) for each in ("auto", "none"))
    assert fit.extension is not None
    assert {"harmonics", "compliance", "curves"} <= set(fit.extension.families)
    assert fit.extension.temperature > 5
    alone = error_of(fit.chain.urdf_alone, other)
    assert alone <= MAX_RATIO * error_of(geometry.chain, other)
    assert error_of(fit.chain, other) < min(0.4 * alone, 0.17e-3)


@pytest.mark.slow
@pytest.mark.parametrize("arm", ["panda_1", "panda_2_clean"])
def test_urdf_alone_at_places_that_are_left_out(arm, tmp_path):
    """A ball on the hand in two sockets, 50 mm apart, at several places; one place judges each fit."""
    folder = DATA / "mukca_panda"
    if not folder.exists():
        missing(f"measurements at {folder}")
    nominal = read_robot(folder / "panda_with_ball.urdf", "ball_link")
    places = {}
    for place in sorted(path for path in (folder / arm).iterdir() if path.is_dir()):
        known = tmp_path / f"{place.name}.csv"
        known.write_text(f"point_a,point_b,distance[mm]\n{place.name}/hole_0,{place.name}/hole_1,50\n")
        files = [*sorted(place.glob("hole_[01].csv")), known]
        columns = [MAPS / "mukca_panda.toml"] * 2 + [None]
        pairs = zip(files, columns, strict=True)
        places[place.name] = [read_measurements(file, nominal, columns=each) for file, each in pairs]
    errors = []
    for left_out, judged in places.items():
        fitted = [item for name, items in places.items() if name != left_out for item in items]
        fits = [dh.calibrate(nominal, fitted, "placement,tool", extend=each) for each in ("auto", "none")]
        errors.append([error_of(fits[0].chain.urdf_alone, *judged), error_of(fits[1].chain, *judged)])
    alone, geometry = np.sqrt(np.mean(np.square(errors), 0))
    assert alone <= MAX_RATIO * geometry, errors


def test_commands_state_both_accuracies(calibrated, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    *_, fit, _ = calibrated
    robot = robot_file(UR5)
    (item,) = fit.data
    columns = [f"{name}[rad]" for name in fit.chain.joint_names] + ["x[m]", "y[m]", "z[m]"]
    rows = np.hstack([item.q, item.positions()])
    np.savetxt("data.csv", rows, delimiter=",", header=",".join(columns), comments="")
    status = main.main(
        ["calibrate", str(robot), "data.csv", "--tip", "tool0", "-o", "arm.urdf", "--json", "a.json"]
    )
    err = capsys.readouterr().err
    assert status == 0, err

    document = json.loads((tmp_path / "a.json").read_text())
    alone = document["urdf_alone"]
    assert alone["before"] == document["before"]
    assert (
        alone["cross_validated_after"]["position_rms_m"]
        > 2 * document["cross_validated_after"]["position_rms_m"]
    )
    assert "with the URDF alone" in " ".join(err.split())
    # `validate` of the URDF without its sidecar finds what was stated.
    (tmp_path / "arm.calibration.toml").unlink()
    assert (
        main.main(["validate", "arm.urdf", "data.csv", "--tip", "tool0", "--fit-frames", "--json", "v.json"])
        == 0
    )
    validated = json.loads((tmp_path / "v.json").read_text())
    assert validated["after"]["position_rms_m"] == pytest.approx(alone["after"]["position_rms_m"], rel=0.02)
    assert validated["urdf_alone"]["after"] == validated["after"]
