"""The paper's simulations: its Gauss-Newton loop from a nominal arm to an actual arm, without noise.

The loop repeats (37) to (39) on the joint sets of Tables 1 and 2 (6-DOF arm, poses) or on the first three
links (3-DOF arm, positions). Each run draws its joint sets with a seed of its own. The joint sets stay the
same in all iterations, or are drawn again in each. The error that counts is the tool error at random test
poses, because several sets of parameters can fit the same joint sets.
"""

from __future__ import annotations

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..estimation.error_model import ErrorModel
from ..estimation.parameters import select_parameters
from ..estimation.problem import Problem, linearize_and_factor
from ..estimation.solver import gauss_newton
from ..exceptions import DhcalError
from ..identifiability import observability
from ..measurements import KINDS
from ..measurements.base import Measurement, Noise
from ..robot.chain import Chain
from .experiment import paper_arm

# Number of runs, and number of test poses of each run.
SEEDS, TESTS = 50, 100
# First seed of the test poses, beyond the seeds of the runs; the seed before it draws `_N_PROBES` joint sets
# at which a parameter must be observable.
_FIRST_TEST_SEED = 10**6 + 1
_N_PROBES = 500
# A parameter whose observable fraction is smaller by more than this is not observable.
_UNOBSERVABLE_TOL = 1e-6
# A run has an exact fit if no whitened residual exceeds the first value, and has found the true parameters if
# no error exceeds the others [rad, m].
_EXACT_FIT_TOL = 1e-9
_TRUE_ANGLE_TOL, _TRUE_LENGTH_TOL = np.deg2rad(1e-6), 1e-9
# Iterations that the table shows.
_SHOWN_ITERATIONS = (0, 1, 2, 3, 5, 10)

# Rows of the table: title, arm, measurement kind, joint sets per iteration, and whether they are drawn again.
SETTINGS = (
    ("6-DOF, pose, 2 kept", "sim_6dof", "pose", 2, False),
    ("6-DOF, pose, 10 kept", "sim_6dof", "pose", 10, False),
    ("6-DOF, pose, 2 anew", "sim_6dof", "pose", 2, True),
    ("3-DOF, position, 3 kept", "sim_3dof", "position", 3, False),
    ("3-DOF, position, 10 kept", "sim_3dof", "position", 10, False),
    ("3-DOF, position, 3 anew", "sim_3dof", "position", 3, True),
)
SIMULATION_HEADER = [
    "joint sets",
    "rank",
    *(f"it {iteration}" for iteration in _SHOWN_ITERATIONS),
    "exact fit",
    "true",
]
SIMULATION_REMARKS = (
    "Two joint sets are fitted exactly, but the parameters are wrong. Ten joint sets determine the true "
    "parameters, except alpha3 of the 3-DOF arm, which only rotates the tool about the measured point.",
    "Kept sets are the same in each iteration. With sets that are drawn anew, more sets converge faster.",
    "Ranks are those of the nominal arm, whose axes 2, 3 and 4, and 5 and 6, are parallel, and of the arm "
    "that was found.",
)


@frozen(eq=False)
class Simulation:
    """Runs of the paper's loop on a simulated arm.

    Parameters that no measurement of the actual arm determines do not count in the parameter errors.
    """

    angle: Array  #: Largest angle error of the parameters by run and iteration, shape (seeds, steps+1) [rad].
    length: Array  #: Largest length error of the parameters by run and iteration, shape (seeds, steps+1) [m].
    #: Largest position error over random test poses by run and iteration, shape (seeds, steps+1) [m].
    test: Array
    residual: Array  #: Largest whitened residual after the last iteration, shape (seeds,) [1 mm or 1 mrad].
    rank: int  #: Rank of the stacked error factors at the nominal arm, first run.
    rank_found: int  #: Rank at the arm that the first run ends with.
    null_space: Array  #: Whether no measurement of the actual arm determines a parameter, shape (p,).


def simulate(
    arm: str, kind: str, poses: int, resample_each_iteration: bool, steps: int = 10, seeds: int = SEEDS
) -> Simulation:
    """Run the paper's loop from an arm's nominal table to its actual one, without noise."""
    nominal, actual = paper_arm(arm), paper_arm(f"{arm}_actual")
    errors, actual_errors = select_parameters(nominal, "dh"), select_parameters(actual, "dh")
    truth = _parameter_differences(errors, actual_errors)
    is_angle = np.array([parameter.unit == "rad" for parameter in errors.parameters])
    weights = np.zeros(len(truth))
    probes = _draw(np.random.default_rng(_FIRST_TEST_SEED - 1), _N_PROBES, nominal.n_joints)
    system = linearize_and_factor(
        Problem(actual_errors, (_measure(actual, kind, probes),), weights), 0 * truth, small_angle=False
    )
    is_unobservable = observability.observable_fraction(system) < 1 - _UNOBSERVABLE_TOL
    angle, length, test = np.zeros((3, seeds, steps + 1))
    residual = np.zeros(seeds)
    ranks = (0, 0)
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        data = _measure(actual, kind, _draw(rng, poses, nominal.n_joints))
        test_q = _draw(np.random.default_rng(_FIRST_TEST_SEED + seed), TESTS, nominal.n_joints)
        test_positions = actual.poses(test_q)[:, :3, 3]
        first_problem = Problem(errors, (data,), weights)
        iterates = _iterate(first_problem, steps)
        if resample_each_iteration:
            iterates = iterates[:2]
            while len(iterates) <= steps:
                data = _measure(actual, kind, _draw(rng, poses, nominal.n_joints))
                problem = Problem(errors, (data,), weights)
                iterates = np.concatenate([iterates, _iterate(problem, 1, iterates[-1])[1:]])
        for step in range(steps + 1):
            x = iterates[min(step, len(iterates) - 1)]
            parameter_error = np.where(is_unobservable, 0.0, np.abs(x - truth))
            angle[seed, step] = parameter_error[is_angle].max()
            length[seed, step] = parameter_error[~is_angle].max()
            positions = errors.at(x).poses(test_q)[:, :3, 3]
            test[seed, step] = np.linalg.norm(positions - test_positions, axis=1).max()
        found = errors.at(iterates[-1])
        residual[seed] = np.abs(data.residual(found.forward_kinematics(data.q), np.array([]))).max()
        if seed == 0:
            first, last = (
                linearize_and_factor(first_problem, x, small_angle=False).rank
                for x in (0 * truth, iterates[-1])
            )
            ranks = first, last
    return Simulation(angle, length, test, residual, ranks[0], ranks[1], is_unobservable)


def _iterate(problem: Problem, steps: int, x: Array | None = None) -> Array:
    """Return all iterates of the paper's loop, (steps+1, p) or fewer; twice the start if it diverges."""
    x = np.zeros(len(problem.weights)) if x is None else x
    try:
        return gauss_newton(problem, x, steps, None).iterates
    except DhcalError:
        return np.stack([x, x])


def _draw(rng: np.random.Generator, count: int, n_joints: int) -> Array:
    """Draw joint positions, shape (count, n) [rad]."""
    return rng.uniform(-np.pi, np.pi, (count, n_joints))


def _measure(chain: Chain, kind: str, q: Array) -> Measurement:
    """Measure an arm without noise."""
    return KINDS[kind].simulate(chain, q, Noise(), np.random.default_rng(0))


def _parameter_differences(nominal: ErrorModel, actual: ErrorModel) -> Array:
    """Return actual minus nominal value of each parameter, shape (p,) [rad, m]."""
    pairs = zip(nominal.parameters, actual.parameters, strict=True)
    return np.array([b.nominal - a.nominal for a, b in pairs])


def simulation_rows(seeds: int = SEEDS) -> list[list[str]]:
    """Run all settings and format their results."""
    rows = []
    for title, arm, kind, poses, resample_each_iteration in SETTINGS:
        run = simulate(arm, kind, poses, resample_each_iteration, seeds=seeds)
        n_parameters = 4 * paper_arm(arm).n_joints
        medians = [f"{1e3 * np.median(run.test[:, iteration]):.2g}" for iteration in _SHOWN_ITERATIONS]
        n_exact = int(np.sum(run.residual < _EXACT_FIT_TOL))
        is_true = (run.angle[:, -1] < _TRUE_ANGLE_TOL) & (run.length[:, -1] < _TRUE_LENGTH_TOL)
        n_true = int(np.sum(is_true))
        ranks = f"{run.rank}→{run.rank_found}/{n_parameters}"
        rows.append([title, ranks, *medians, f"{n_exact}/{seeds}", f"{n_true}/{seeds}"])
    return rows
