"""Normal equations of correction curves: against the plain rows, and against the R factor of the rows."""

import pickle

import numpy as np
import pytest
from robots import measured_arm, random_joints, random_table
from slow_cases import some_slow

import dhcal_pin.estimation.folds as folds
import dhcal_pin.estimation.problem as problem_module
from dhcal_pin import Chain, calibrate
from dhcal_pin.estimation import Problem, linearize_and_factor, select_parameters
from dhcal_pin.estimation.folds import factor_partition
from dhcal_pin.estimation.normal_equations import NormalEquations
from dhcal_pin.estimation.problem import UnfactoredSystem, normal_equations, uses_normal_equations
from dhcal_pin.estimation.qr import append_rows, rank
from dhcal_pin.measurements import Noise, Pose, Position

SETS = "minimal,base,tool,gain,coupling,compliance,harmonics,curves"


def curved_problem(kind=Pose, m=300, seed=0, sets=SETS, reach=2.5):
    """Return a problem of a UR5 with errors of all kinds, and a point near its solution."""
    rng = np.random.default_rng(seed)
    arm = measured_arm("ur5")
    errors = select_parameters(arm, sets)
    x = np.minimum(errors.priors, 1e-3) * rng.standard_normal(len(errors.parameters))
    data = kind.simulate(errors.at(x), rng.uniform(-reach, reach, (m, 6)), Noise(5e-5, 1e-4), rng)
    return Problem(errors, (data,), 1 / errors.priors), 0.9 * x


def plain_rows(problem, x):
    """Return the whitened rows [J | r] of all samples, shape (p+1, k, m)."""
    linearization = problem.linearize(x)
    return np.concatenate([linearization.rows(chunk) for chunk in problem.chunks], 2)


def assert_same_products(problem, x):
    rows = plain_rows(problem, x).reshape(len(x) + 1, -1)
    expected = rows @ rows.T
    scale = np.sqrt(np.diag(expected))
    scale[scale == 0] = 1.0
    found = normal_equations(problem, x).products
    np.testing.assert_allclose(found / scale / scale[:, None], expected / scale / scale[:, None], atol=1e-12)


@pytest.mark.parametrize("kind", [Pose, Position])
@pytest.mark.parametrize("m", [300, 2100])
def test_products_are_those_of_the_plain_rows(kind, m):
    """With one chunk of samples and with two."""
    assert_same_products(*curved_problem(kind, m))


@pytest.mark.parametrize("seed", range(5))
def test_products_of_random_arms(seed):
    """Revolute and prismatic joints, and coefficients of some of the joints only."""
    rng = np.random.default_rng(seed)
    table = random_table(rng)
    arm = Chain.from_dh(table)
    errors = select_parameters(arm, "dh,gain,coupling,harmonics")
    kept = [p for p in errors.parameters if p.coefficient_index is None or rng.uniform() < 0.5]
    errors = type(errors)(arm, tuple(kept))
    x = 1e-3 * rng.standard_normal(len(kept))
    data = Pose.simulate(arm, random_joints(rng, table, 40), Noise(1e-4, 1e-4), rng)
    assert_same_products(Problem(errors, (data,), np.ones(len(kept))), x)


@pytest.mark.parametrize("kind", [Pose, Position])
def test_covariances_of_the_rows(kind):
    problem, x = curved_problem(kind, 30)
    rng = np.random.default_rng(1)
    root = problem.errors.priors[:, None] * rng.standard_normal((len(x), 50))
    rows = np.tensordot(root, plain_rows(problem, x)[:-1], (0, 0))
    expected = np.einsum("rim,rjm->mij", rows, rows)
    (chunk,) = problem.chunks
    found = problem.linearize(x).structured_rows(chunk).covariances(root @ root.T)
    np.testing.assert_allclose(found, expected, atol=1e-10 * np.abs(expected).max())


@pytest.mark.parametrize("reach", [0.1, 0.5, 2.5])
def test_the_r_factor_is_that_of_the_plain_rows(reach):
    """Over short ranges of the joints, most terms are combinations of others."""
    problem, x = curved_problem(reach=reach)
    rows = plain_rows(problem, x).reshape(len(x) + 1, -1).T
    system = UnfactoredSystem(normal_equations(problem, x), problem, x)
    expected = np.linalg.svd(rows[:, :-1], compute_uv=False)
    np.testing.assert_allclose(system.singular_values, expected, atol=1e-13 * expected[0])
    np.testing.assert_array_equal(system.rows, np.triu(system.rows))
    products = rows.T @ rows
    scale = np.linalg.norm(rows, axis=0)
    found = system.rows.T @ system.rows
    np.testing.assert_allclose(found / scale / scale[:, None], products / scale / scale[:, None], atol=1e-12)
    np.testing.assert_allclose(rows[:, :-1] @ system.null_space, 0, atol=1e-8 * expected[0])
    assert system.null_space.shape[1] == len(x) - np.sum(expected > 1e-9 * expected[0])


def test_each_member_agrees_with_the_triangular_system():
    problem, x = curved_problem()
    weights, rng = problem.weights, np.random.default_rng(0)
    system, triangular = normal_equations(problem, x), linearize_and_factor(problem, x, small_angle=False)
    assert uses_normal_equations(problem)
    assert system.cost == pytest.approx(triangular.cost, rel=1e-12)
    columns = rng.uniform(size=len(x)) < 0.7
    other_problem, _ = curved_problem(seed=1)
    others = normal_equations(other_problem, x), linearize_and_factor(other_problem, x, small_angle=False)
    step = triangular.solve(weights, x)[0]
    pairs = [
        (system, triangular, weights, x),
        (system.scaled(3.0), triangular.scaled(3.0), weights, x),
        (system.select(columns), triangular.select(columns), weights[columns], x[columns]),
        (system.merged(others[0]), triangular.merged(others[1]), weights, x),
        (system.recentered(0.5 * step), triangular.recentered(0.5 * step), weights, x),
    ]
    for normal, reference, w, at in pairs:
        delta, cost = normal.solve(w, at)
        expected, expected_cost = reference.solve(w, at)
        std = np.linalg.norm(reference.sqrt_covariance(w)[0], axis=1)
        np.testing.assert_allclose(delta / std, expected / std, atol=1e-5)
        assert cost == pytest.approx(expected_cost, rel=1e-9)
        np.testing.assert_allclose(np.linalg.norm(normal.sqrt_covariance(w)[0], axis=1), std, rtol=1e-7)
        both = normal.with_priors(w, at), reference.with_priors(w, at)
        np.testing.assert_allclose(*(np.abs(np.diag(each.r)) for each in both), rtol=1e-7)
        assert both[0].cost == pytest.approx(both[1].cost, rel=1e-9)
        assert normal.squared_error(delta) == pytest.approx(reference.squared_error(delta), rel=1e-9)
        root = reference.sqrt_covariance(w)[0]
        found = normal.predicted_variance(normal.sqrt_covariance(w)[0])
        assert found == pytest.approx(reference.predicted_variance(root), rel=1e-7)
        difference = (normal.covariance(w) - reference.covariance(w)) / std / std[:, None]
        assert np.abs(difference).max() < 1e-7
        # A small damping refines the step without it, a large one needs a decomposition of its own.
        for damping in (1e-8, 1e-2):
            rows = damping**0.5 * np.linalg.norm(both[1].r, axis=0), rng.standard_normal(len(w))
            damped = [append_rows(each, *rows) for each in both]
            expected = damped[1].best_step()
            np.testing.assert_allclose(damped[0].best_step() / std, expected / std, atol=1e-5)
            assert damped[0].min_cost == pytest.approx(damped[1].min_cost, rel=1e-9)
            assert damped[0].roundoff == pytest.approx(damped[1].roundoff, rel=1e-7)
            sizes = np.linalg.norm(damped[1].rows, axis=0)
            found, expected = (each.rows.T @ each.rows / sizes / sizes[:, None] for each in damped)
            np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.parametrize("m", [300, 2100])
def test_folds_are_those_of_problems_with_some_of_the_samples(m):
    """With one chunk of samples and with two, and samples in no fold."""
    problem, x = curved_problem(m=m)
    label = np.random.default_rng(0).integers(0, 3, m)
    folds = [(label == 0,), (label == 1,)]
    for fold, systems in zip(folds, factor_partition(problem, x, folds), strict=True):
        for mask, found in ((fold[0], systems.held_out), (~fold[0], systems.fitted)):
            expected = normal_equations(problem.with_data([problem.data[0].take(mask)]), x).products
            assert isinstance(found, NormalEquations)
            np.testing.assert_allclose(found.products, expected, atol=1e-9 * np.abs(expected).max())
        assert systems.n_rows == 6 * fold[0].sum()
        rest, held_out = (
            linearize_and_factor(problem.with_data([problem.data[0].take(mask)]), x, small_angle=False)
            for mask in (~fold[0], fold[0])
        )
        expected = held_out.predicted_variance(rest.sqrt_covariance(problem.weights)[0]) / systems.n_rows
        found = systems.prediction_std(problem.weights, np.ones(len(x), bool))
        assert found == pytest.approx(expected**0.5, rel=1e-7)


def test_samples_that_determine_few_unknowns():
    """Ten poses for 443 unknowns: the priors decide on the others."""
    problem, x = curved_problem(m=10)
    assert uses_normal_equations(problem)
    system, triangular = normal_equations(problem, x), linearize_and_factor(problem, x, small_angle=False)
    root, expected = (each.sqrt_covariance(problem.weights)[0] for each in (system, triangular))
    np.testing.assert_allclose(np.linalg.norm(root, axis=1), np.linalg.norm(expected, axis=1), rtol=1e-6)
    assert triangular.merged(system).cost == pytest.approx(2 * triangular.cost, rel=1e-9)
    # The rows have no direction that the poses do not determine.
    assert rank(system.r) == rank(triangular.r) == 60
    assert np.abs(np.tril(system.rows, -1)).max() == 0
    np.testing.assert_allclose(
        system.rows.T @ system.rows, system.products, atol=1e-9 * system.products.max()
    )


@pytest.mark.parametrize("m", some_slow([60, 220], {0}))
def test_calibration_is_the_same_with_the_r_factor_of_the_rows(monkeypatch, m):
    """The sets have 421 unknowns; 60 poses have fewer rows, 220 poses three times as many."""
    problem, _ = curved_problem(m=m, sets="minimal,base,tool,compliance,harmonics,curves")
    arm, data = problem.errors.chain, problem.data
    fit = calibrate(arm, data)
    for module in (problem_module, folds):
        monkeypatch.setattr(module, "uses_normal_equations", lambda problem: False)
    reference = calibrate(arm, data)
    assert fit.extension is not None
    assert reference.extension is not None
    assert "curves" in fit.extension.families
    assert fit.extension.families == reference.extension.families
    assert fit.extension.temperature == reference.extension.temperature
    assert fit.extension.region_ratio == pytest.approx(reference.extension.region_ratio, rel=1e-6)
    np.testing.assert_allclose(fit.x / reference.std, reference.x / reference.std, atol=1e-5)


def test_the_system_of_a_result_is_the_r_factor_of_the_rows():
    """It is computed when it is needed, and in another process, too."""
    problem, x = curved_problem()
    equations = normal_equations(problem, x)
    system = pickle.loads(pickle.dumps(UnfactoredSystem(equations, problem, x)))
    expected = linearize_and_factor(problem, x, small_angle=False)
    np.testing.assert_array_equal(system.rows, expected.rows)
    assert system.rank == expected.rank
    roots = (each.sqrt_covariance(problem.weights)[0] for each in (system, expected))
    variances = [np.sum(root**2, 1) for root in roots]
    np.testing.assert_allclose(*variances, rtol=1e-8)
