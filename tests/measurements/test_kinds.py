"""Conformance of all measurement kinds: it walks `KINDS`, so a new kind is tested without an edit here."""

import json
from pathlib import Path

import numpy as np
import pytest
from robots import URDF

from dhcal_pin import se3
from dhcal_pin.calibration import calibrate
from dhcal_pin.calibration.evaluation import fit_instrument_parameters
from dhcal_pin.cli.main import main
from dhcal_pin.estimation import Problem, select_parameters
from dhcal_pin.estimation.problem import linearize_and_factor
from dhcal_pin.io import measurement_text, read_measurements
from dhcal_pin.measurements import KINDS, Noise, PlaneContact, PointContact, PointDistance, Pose
from dhcal_pin.measurements.base import concatenate, whitened_jacobian
from dhcal_pin.robot.conditions import Conditions

KIND = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)


def setting(chain, kind, seed=0, m=8):
    """Return noisy measurements of a disturbed robot, and values to differentiate at."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-np.pi, np.pi, (m, chain.n_joints))
    errors = select_parameters(chain, "dh,base,tool")
    x = 0.1 * rng.normal(size=len(errors.parameters))
    data = kind.simulate(errors.at(x), q, Noise(1e-3, 1e-3), rng).initialized(errors.at(x))
    u = np.nan_to_num([unknown.nominal for unknown in data.instrument_parameters]) + 0.05 * rng.normal(
        size=len(data.instrument_parameters)
    )
    return data, errors, x, u, rng


def check_derivatives(kind, sim_6dof_actual, seeds):
    h = 1e-6
    for seed in seeds:
        data, errors, x, u, rng = setting(sim_6dof_actual, kind, seed)
        x = x + 0.2 * rng.normal(size=len(x))
        model = errors.derivative(x)
        frames = model[0].forward_kinematics(data.configurations())
        residual = data.residual(frames, u)
        rows = whitened_jacobian(data, model, frames, u, residual)
        assert rows.shape == (len(x), *residual.shape)
        bound = 1e-6 * max(1.0, np.abs(rows).max())
        for k in range(len(x)):
            step = h * np.eye(len(x))[k]
            up, down = (
                data.residual(errors.at(x + s * step).forward_kinematics(data.configurations()), u)
                for s in (1, -1)
            )
            np.testing.assert_allclose(rows[k], -(up - down) / (2 * h), atol=bound)
        own = data.instrument_jacobian(frames, u)
        assert own.shape == (len(u), *data.residual(frames, u).shape)
        for k in range(len(u)):
            step = h * np.eye(len(u))[k]
            up, down = (data.residual(frames, u + s * step) for s in (1, -1))
            np.testing.assert_allclose(
                own[k], -(up - down) / (2 * h), atol=max(bound, 1e-6 * np.abs(own).max())
            )


@KIND
def test_r_factor_equals_that_of_all_rows(kind, sim_6dof_actual):
    """300 samples are more than one chunk: the R factor is updated chunk by chunk."""
    data, errors, x, u, _ = setting(sim_6dof_actual, kind, m=300)
    problem = Problem(errors, (data,), np.zeros(len(x) + len(u)))
    at = np.concatenate([x, u - [unknown.nominal for unknown in problem.instrument_parameters]])
    (chunk,) = problem.chunks
    rows = problem.linearize(at).rows(chunk).reshape(len(at) + 1, -1)
    found = linearize_and_factor(problem, at, small_angle=False)
    packed = np.block([[found.r, found.z[:, None]], [np.zeros(len(at)), np.sqrt(found.min_cost)]])
    scale = np.linalg.norm(rows, axis=1)
    scale[scale == 0] = 1.0
    np.testing.assert_allclose(
        (packed / scale).T @ (packed / scale), rows @ rows.T / np.outer(scale, scale), atol=1e-12
    )


@KIND
def test_derivatives_equal_central_differences(kind, sim_6dof_actual):
    check_derivatives(kind, sim_6dof_actual, range(10))


@pytest.mark.slow
@KIND
def test_derivatives_in_200_states(kind, sim_6dof_actual):
    check_derivatives(kind, sim_6dof_actual, range(200))


def truth_of(kind, chain, m, noise=None, seed=0):
    """Return simulated measurements and their instrument parameters, fitted with the robot fixed."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-2.5, 2.5, (m, chain.n_joints))
    data = kind.simulate(chain, q, noise or Noise(), rng).initialized(chain)
    names = fit_instrument_parameters(chain, [data], {})
    return data, np.array([names[unknown.name] for unknown in data.instrument_parameters])


@KIND
def test_first_values_are_those_of_the_moved_base(kind, sim_6dof_actual):
    chain, rng, m = sim_6dof_actual, np.random.default_rng(4), 12
    data = kind.simulate(chain, rng.uniform(-2.5, 2.5, (m, chain.n_joints)), Noise(), rng)
    motion = se3.exp6(np.array([0.5, -0.3, 0.8, 0.4, -0.6, 1.0]))
    moved = chain.with_base_and_tool(motion @ chain.base, chain.tool)
    recorded = data.replace(recorded=Conditions(data.q, base_motion=np.tile(motion, (len(data.rows), 1, 1))))
    found, expected = (
        [parameter.nominal for parameter in item.instrument_parameters]
        for item in (recorded.initialized(chain), data.initialized(moved))
    )
    np.testing.assert_allclose(found, expected, atol=1e-9)


# Distances between points do not determine where the points are.
LOCATED = pytest.mark.parametrize(
    "kind", [kind for kind in KINDS.values() if kind is not PointDistance], ids=lambda kind: kind.kind
)


@LOCATED
def test_true_values_leave_no_residual(kind, sim_6dof_actual):
    data, u = truth_of(kind, sim_6dof_actual, 12)
    # In units of sigma, 1 mm; the wide priors shift the parameters by less.
    assert np.abs(data.residual(sim_6dof_actual.forward_kinematics(data.configurations()), u)).max() < 1e-4


@LOCATED
def test_noise_whitens_to_one(kind, sim_6dof_actual):
    data, u = truth_of(kind, sim_6dof_actual, 600, Noise(2e-4, 3e-4))
    assert data.has_stated_sigma
    residual = data.residual(sim_6dof_actual.forward_kinematics(data.configurations()), u)
    for rows in (group.rows for group in data.residual_groups.values()):
        if residual[rows].size > 100:
            assert np.std(residual[rows]) == pytest.approx(1.0, abs=0.1)


@KIND
def test_take_selects_samples(kind, sim_6dof_actual):
    data, _, _, u, _ = setting(sim_6dof_actual, kind)
    part = data.take(np.array([1, 4]))
    whole = data.residual(sim_6dof_actual.forward_kinematics(data.configurations()), u)
    mine = part.residual(sim_6dof_actual.forward_kinematics(part.configurations()), u)
    np.testing.assert_allclose(mine, whole[:, [1, 4]], rtol=1e-12)
    np.testing.assert_array_equal(part.rows, [2, 5])


@KIND
def test_residuals_are_divided_by_sigma(kind, sim_6dof_actual):
    data, _, _, u, _ = setting(sim_6dof_actual, kind)
    frames = sim_6dof_actual.forward_kinematics(data.configurations())
    scaled = data.with_scaled_sigma(dict.fromkeys(data.residual_groups, 4.0))
    np.testing.assert_allclose(scaled.residual(frames, u) * 4, data.residual(frames, u), rtol=1e-14)


def check_calibration(kind, sim_6dof, seeds):
    """Compare distances between held-out tool points, which do not depend on base and instrument."""
    for seed in seeds:
        rng = np.random.default_rng(seed)
        errors = select_parameters(sim_6dof, "minimal")
        truth = errors.at(np.array([1e-2 if p.unit == "rad" else 3e-3 for p in errors.parameters])
                          * rng.uniform(-1, 1, len(errors.parameters)))  # fmt: skip
        q = rng.uniform(-2.5, 2.5, (120, 6))
        data = [kind.simulate(truth, q, Noise(), rng)]
        if kind is PointDistance:
            contacts = PointContact.simulate(truth, q, Noise(), rng)
            at = truth.poses(contacts.q[:4])[:, :3, 3]
            pairs = [(i, j) for i in range(4) for j in range(i)]
            names = [(contacts.names[i], contacts.names[j]) for i, j in pairs]
            data = [
                contacts,
                PointDistance(6, names, [np.linalg.norm(at[i] - at[j]) for i, j in pairs]),
            ]
        fit = calibrate(sim_6dof, data, "minimal", priors="none")
        assert fit.converged
        other = rng.uniform(-2.5, 2.5, (50, 6))
        found, wanted = (chain.poses(other)[:, :3, 3] for chain in (fit.chain, truth))
        lengths = [np.linalg.norm(points[1:] - points[0], axis=1) for points in (found, wanted)]
        if {group.unit for group in kind.residual_groups.values()} == {"rad"}:
            # Angles do not determine lengths, but angles elsewhere.
            elsewhere = kind.simulate(truth, rng.uniform(-2.5, 2.5, (50, 6)), Noise(), rng)
            assert fit.validate(elsewhere)["residual_rms"] < 1e-9
            continue
        # Contacts with a plane or with points do not determine the scale.
        scale = np.sum(lengths[0]) / np.sum(lengths[1]) if kind in (PlaneContact, PointContact) else 1.0
        assert scale == pytest.approx(1, abs=0.2)
        assert np.abs(lengths[0] / scale - lengths[1]).max() < 1e-9


@KIND
def test_noise_free_calibration_is_exact_elsewhere(kind, sim_6dof):
    check_calibration(kind, sim_6dof, range(1))


@pytest.mark.slow
@KIND
def test_noise_free_calibration_in_50_seeds(kind, sim_6dof):
    check_calibration(kind, sim_6dof, range(50))


@KIND
def test_resample_replaces_the_configurations_only(kind, sim_6dof):
    data, _, _, _, rng = setting(sim_6dof, kind)
    q = rng.uniform(-1, 1, data.configurations().shape)
    other = data.resample(q)
    np.testing.assert_array_equal(other.configurations(), q)
    assert other.to_columns().keys() == data.to_columns().keys()
    np.testing.assert_array_equal(other.rows, data.rows)


@KIND
def test_concatenate_is_the_inverse_of_take(kind, sim_6dof):
    data, _, _, _, _ = setting(sim_6dof, kind)
    parts = [data.take(slice(0, 3)), data.take(slice(3, None))]
    joined = concatenate(parts)
    for name in data.sample_fields:
        np.testing.assert_array_equal(getattr(joined, name), getattr(data, name))


@KIND
def test_repr_is_short_and_names_kind_and_samples(kind, sim_6dof):
    for noise in (Noise(), Noise(1e-4, 2e-4)):
        data = kind.simulate(sim_6dof, np.zeros((5, 6)) + 0.3, noise, np.random.default_rng(0))
        text = repr(data)
        assert text.startswith(f"{kind.__name__}({len(data.rows)} samples, ")
        sigma = {"camera": "0.1 px", "inclination": "0.0115 deg"}.get(kind.kind, "0.1 mm")
        assert (f"sigma {sigma}" in text) == data.has_stated_sigma
        assert len(text) < 80


@KIND
def test_measurements_are_immutable(kind, sim_6dof):
    data, _, _, _, _ = setting(sim_6dof, kind)
    with pytest.raises(AttributeError):
        data.q = np.zeros((1, 6))


@KIND
def test_file_round_trip_is_exact(kind, sim_6dof_actual, tmp_path):
    """All columns agree in every digit, sigmas included; rotation vectors up to rounding."""
    for noise in (Noise(), Noise(1e-4, 2e-4)):
        q = np.random.default_rng(1).uniform(-2.5, 2.5, (9, 6))
        data = kind.simulate(sim_6dof_actual, q, noise, np.random.default_rng(0))
        path = tmp_path / "data.csv"
        path.write_text(measurement_text(data, sim_6dof_actual, ["a comment"]))
        again = read_measurements(path, sim_6dof_actual, rig=getattr(data, "rig", None))
        assert type(again) is kind
        assert again.has_stated_sigma == data.has_stated_sigma
        np.testing.assert_array_equal(again.configurations(), data.configurations())
        for name, values in data.to_columns().items():
            found = again.to_columns()[name]
            if data.columns[name] == "angle" and "sigma" not in name:
                np.testing.assert_allclose(found, values, atol=4e-15)
            else:
                assert list(found) == list(values), name


@KIND
def test_simulated_file_calibrates(kind, tmp_path, monkeypatch, unsuspected_once, inside_only):
    """`dhcal simulate` for every kind, then `dhcal calibrate` on its file."""
    monkeypatch.chdir(tmp_path)
    nominal, actual = str(URDF / "sim_6dof.dh.toml"), str(URDF / "sim_6dof_actual.dh.toml")
    assert main(["simulate", nominal, "--truth", actual, "-m", "40", "--kind", kind.kind, "-o", "d.csv",
                 "--noise", "0.1mm,0.01deg"]) == 0  # fmt: skip
    rig = ["--rig", "d.rig.toml"] if Path("d.rig.toml").exists() else []
    assert (
        main(["calibrate", nominal, "d.csv", *rig, "-o", "o.urdf", "--json", "r.json", "--extend", "none"])
        == 0
    )
    result = json.loads(Path("r.json").read_text())
    assert result["converged"]
    for key in ("position_rms_m", "residual_rms"):
        if key in result["after"] and kind is not PointDistance:
            assert result["after"][key] < (1.0 if result["after"].get("unit") == "px" else 1e-3)


def test_five_kinds_are_calibrated_together(sim_6dof, sim_6dof_actual, unsuspected_once):
    rng = np.random.default_rng(0)
    kinds = [KINDS[name] for name in ("pose", "wires", "plane", "distance", "relative")]
    draw = lambda m: rng.uniform(-2.5, 2.5, (m, 6))  # noqa: E731
    data = [kind.simulate(sim_6dof_actual, draw(30), Noise(), rng) for kind in kinds]
    fit = calibrate(sim_6dof, data, "dh", priors="none")
    assert fit.converged
    assert fit.validate(Pose.simulate(sim_6dof_actual, draw(50), Noise(), rng))["position_max_m"] < 1e-9
