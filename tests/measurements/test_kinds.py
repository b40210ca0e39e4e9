"""Conformance of every kind of measurement: it walks the list, a new kind needs no edit here."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from robots import URDF

from dhcal_pin import se3
from dhcal_pin._kernels import apply_observation_matrix
from dhcal_pin.calibration.evaluation import instrument_values
from dhcal_pin.calibration.procedure import calibrate
from dhcal_pin.cli.main import main
from dhcal_pin.estimation.parameters import select_parameters
from dhcal_pin.estimation.problem import Problem, linearize_and_factor
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io.measurement_csv import measurement_text, read_measurements
from dhcal_pin.measurements import KINDS
from dhcal_pin.measurements.base import Noise, whitened_jacobian
from dhcal_pin.measurements.contact import PlaneContact, PointContact, PointDistance
from dhcal_pin.measurements.pose import Pose
from dhcal_pin.measurements.position import Position

KIND = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)


def setting(chain, kind, seed=0, m=8):
    """Readings of an arm that is a little off, noisy, and the errors and unknowns to differentiate by."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-np.pi, np.pi, (m, chain.n_joints))
    errors = select_parameters(chain, "dh,base,tool")
    x = 0.1 * rng.normal(size=len(errors.parameters))
    data = kind.simulate(errors.at(x), q, Noise(1e-3, 1e-3), rng).initialized(errors.at(x))
    u = np.nan_to_num([unknown.nominal for unknown in data.instrument_parameters]) + 0.05 * rng.normal(
        size=len(data.instrument_parameters)
    )
    return data, errors, x, u, rng


def derivatives_hold(kind, sim_6dof_actual, seeds):
    h = 1e-6
    for seed in seeds:
        data, errors, x, u, rng = setting(sim_6dof_actual, kind, seed)
        x = x + 0.2 * rng.normal(size=len(x))
        chain, bodies, twists = errors.derivative(x)
        frames = chain.forward_kinematics(data.configurations())
        residual = data.residual(frames, u)
        rows = whitened_jacobian(data, frames, chain.tool_jacobian(frames, bodies, twists), u, residual)
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
def test_the_triangle_keeps_what_the_rows_tell(kind, sim_6dof_actual):
    """Rows are reduced on the way and in one piece; 300 samples are more than are taken at a time."""
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
def test_derivative_equals_central_differences(kind, sim_6dof_actual):
    derivatives_hold(kind, sim_6dof_actual, range(10))


@pytest.mark.slow
@KIND
def test_derivative_in_200_states(kind, sim_6dof_actual):
    derivatives_hold(kind, sim_6dof_actual, range(200))


def truth_of(kind, chain, m, noise=None, seed=0):
    """Simulated readings and the unknowns that were simulated, as near as a fit of them alone tells."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-2.5, 2.5, (m, chain.n_joints))
    data = kind.simulate(chain, q, noise or Noise(), rng).initialized(chain)
    names = instrument_values(chain, [data], {})
    return data, np.array([names[unknown.name] for unknown in data.instrument_parameters])


# Distances between points alone do not say where the points are.
PLACED = pytest.mark.parametrize(
    "kind", [kind for kind in KINDS.values() if kind is not PointDistance], ids=lambda kind: kind.kind
)


@PLACED
def test_truth_leaves_no_residual(kind, sim_6dof_actual):
    data, u = truth_of(kind, sim_6dof_actual, 12)
    # In sigmas of a millimetre; wide priors pull at the unknowns by less.
    assert np.abs(data.residual(sim_6dof_actual.forward_kinematics(data.configurations()), u)).max() < 1e-4


@PLACED
def test_noise_whitens_to_one(kind, sim_6dof_actual):
    data, u = truth_of(kind, sim_6dof_actual, 600, Noise(2e-4, 3e-4))
    assert data.has_stated_sigma
    residual = data.residual(sim_6dof_actual.forward_kinematics(data.configurations()), u)
    for rows in data.residual_groups.values():
        if residual[rows].size > 100:
            assert np.std(residual[rows]) == pytest.approx(1.0, abs=0.1)


@KIND
def test_slices_are_slices(kind, sim_6dof_actual):
    data, _, _, u, _ = setting(sim_6dof_actual, kind)
    part = data.take(np.array([1, 4]))
    whole = data.residual(sim_6dof_actual.forward_kinematics(data.configurations()), u)
    mine = part.residual(sim_6dof_actual.forward_kinematics(part.configurations()), u)
    np.testing.assert_allclose(mine, whole[:, [1, 4]], rtol=1e-12)
    np.testing.assert_array_equal(part.rows, [2, 5])


@KIND
def test_sigmas_divide(kind, sim_6dof_actual):
    data, _, _, u, _ = setting(sim_6dof_actual, kind)
    frames = sim_6dof_actual.forward_kinematics(data.configurations())
    scaled = data.with_scaled_sigma(dict.fromkeys(data.residual_groups, 4.0))
    np.testing.assert_allclose(scaled.residual(frames, u) * 4, data.residual(frames, u), rtol=1e-14)


def other_places_are_found(kind, sim_6dof, seeds):
    """Distances between held-out tool points, which no gauge of base or instrument touches."""
    for seed in seeds:
        rng = np.random.default_rng(seed)
        errors = select_parameters(sim_6dof, "minimal")
        truth = errors.at(np.array([1e-2 if p.unit == "rad" else 3e-3 for p in errors.parameters])
                          * rng.uniform(-1, 1, len(errors.parameters)))  # fmt: skip
        q = rng.uniform(-2.5, 2.5, (120, 6))
        data = [kind.simulate(truth, q, Noise(), rng)]
        if kind is PointDistance:
            touch = PointContact.simulate(truth, q, Noise(), rng)
            at = truth.poses(touch.q[:4])[:, :3, 3]
            pairs = [(i, j) for i in range(4) for j in range(i)]
            names = [(touch.names[i], touch.names[j]) for i, j in pairs]
            data = [
                touch,
                PointDistance(6, names, [np.linalg.norm(at[i] - at[j]) for i, j in pairs]),
            ]
        fit = calibrate(sim_6dof, data, "minimal", priors="none")
        assert fit.converged
        other = rng.uniform(-2.5, 2.5, (50, 6))
        found, wanted = (chain.poses(other)[:, :3, 3] for chain in (fit.chain, truth))
        lengths = [np.linalg.norm(points[1:] - points[0], axis=1) for points in (found, wanted)]
        # Plane and points alone do not see the scale.
        scale = np.sum(lengths[0]) / np.sum(lengths[1]) if kind in (PlaneContact, PointContact) else 1.0
        assert scale == pytest.approx(1, abs=0.2)
        assert np.abs(lengths[0] / scale - lengths[1]).max() < 1e-9


@KIND
def test_noise_free_calibration_finds_other_places(kind, sim_6dof):
    other_places_are_found(kind, sim_6dof, range(2))


@pytest.mark.slow
@KIND
def test_noise_free_calibration_in_50_seeds(kind, sim_6dof):
    other_places_are_found(kind, sim_6dof, range(50))


def test_paper_rows_are_its_r_and_sine(sim_6dof, sim_6dof_actual):
    """Seen in the tool frame, the small-angle rows are R and (35), (36)."""
    from robots import paper

    from dhcal_pin.paper.factors import error_factors, tool_error

    q = np.random.default_rng(3).uniform(-3, 3, (11, 6))
    data = Pose.simulate(sim_6dof_actual, q, Noise(), np.random.default_rng(0))
    errors = select_parameters(sim_6dof, "dh")
    chain, bodies, twists = errors.derivative(np.zeros(24))
    frames = chain.forward_kinematics(q)
    residual, mixture = data.small_angle(frames, np.array([]))
    velocities = chain.tool_jacobian(frames, bodies, twists)
    rows = apply_observation_matrix(velocities, mixture, np.empty((24, *residual.shape)))
    rotation = chain.poses(q)[:, :3, :3]
    into_tool = np.zeros((11, 6, 6))
    into_tool[:, :3, :3] = into_tool[:, 3:, 3:] = np.swapaxes(rotation, 1, 2)
    seen = np.einsum("mij,jm->mi", into_tool, residual) * 1e-3
    np.testing.assert_allclose(seen, tool_error(data.poses, chain.poses(q)), atol=1e-15)
    order = [next(i for i, p in enumerate(errors.parameters) if p.name == f"{key}{j}")
             for key in ("theta", "d", "a", "alpha") for j in range(1, 7)]  # fmt: skip
    mine = np.einsum("mij,pjm->mip", into_tool, rows)[:, :, order] * 1e-3
    np.testing.assert_allclose(mine, error_factors(paper("sim_6dof"), q), atol=1e-14)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda q, p: Position(q, p[:3, :3, 3]), "Position: positions has 3 entries for 5 samples"),
        (lambda q, p: Position(q, p[:, :3, 3] * np.nan), "finite"),
        (lambda q, p: Position(q, p[:, :3, 3], -1e-3), "positive"),
        (lambda q, p: Pose(q, p * 2), "sample 1 is not a rotation"),
        (lambda q, p: Pose(q, p, 1e-3), "expected both or neither"),
    ],
)
def test_wrong_readings_are_refused(make, message, sim_6dof):
    q = np.zeros((5, 6))
    with pytest.raises(DhcalError, match=message):
        make(q, sim_6dof.poses(q))


def test_left_handed_rotation_is_refused(sim_6dof):
    poses = sim_6dof.poses(np.zeros((2, 6)))
    poses[:, :3, 0] *= -1
    with pytest.raises(DhcalError, match="not a rotation"):
        Pose(np.zeros((2, 6)), poses)


def test_small_rotation_noise_is_a_rotation(sim_6dof):
    data = Pose.simulate(sim_6dof, np.zeros((50, 6)), Noise(0, 0.2), np.random.default_rng(0))
    spread = se3.log3(data.poses[:, :3, :3] @ np.swapaxes(sim_6dof.poses(np.zeros((50, 6)))[:, :3, :3], 1, 2))
    assert np.std(spread) == pytest.approx(0.2, rel=0.15)


@KIND
def test_file_round_trip_is_exact(kind, sim_6dof_actual, tmp_path):
    """Every column's every digit, sigmas included; rotations to rounding."""
    for noise in (Noise(), Noise(1e-4, 2e-4)):
        q = np.random.default_rng(1).uniform(-2.5, 2.5, (9, 6))
        data = kind.simulate(sim_6dof_actual, q, noise, np.random.default_rng(0))
        path = tmp_path / "data.csv"
        path.write_text(measurement_text(data, sim_6dof_actual, ["a comment"]))
        again = read_measurements(path, sim_6dof_actual)
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
def test_simulated_file_calibrates(kind, tmp_path, monkeypatch):
    """`dhcal simulate` for every kind, then `dhcal calibrate` on its file."""
    monkeypatch.chdir(tmp_path)
    nominal, actual = str(URDF / "sim_6dof.dh.toml"), str(URDF / "sim_6dof_actual.dh.toml")
    assert main(["simulate", nominal, "--truth", actual, "-m", "40", "--kind", kind.kind, "-o", "d.csv",
                 "--noise", "0.1mm,0.01deg"]) == 0  # fmt: skip
    assert main(["calibrate", nominal, "d.csv", "-o", "o.urdf", "--json", "r.json"]) == 0
    result = json.loads(Path("r.json").read_text())
    assert result["converged"]
    for key in ("position_rms_m", "residual_rms"):
        if key in result["after"] and kind is not PointDistance:
            assert result["after"][key] < 1e-3


def test_a_mixture_of_five_kinds_converges(sim_6dof, sim_6dof_actual):
    rng = np.random.default_rng(0)
    kinds = [KINDS[name] for name in ("pose", "wires", "plane", "distance", "relative")]
    draw = lambda m: rng.uniform(-2.5, 2.5, (m, 6))  # noqa: E731
    data = [kind.simulate(sim_6dof_actual, draw(30), Noise(), rng) for kind in kinds]
    fit = calibrate(sim_6dof, data, "dh", priors="none")
    assert fit.converged
    assert fit.validate(Pose.simulate(sim_6dof_actual, draw(50), Noise(), rng))["position_max_m"] < 1e-9
