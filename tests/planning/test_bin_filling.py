"""Plans that fill the bins of the joints: evenness, what decides then, and what simulated curves confirm."""

from itertools import combinations

import numpy as np
import pytest
from robots import SCARA, nominal_arm, paper, write

from dhcal_pin.calibration import calibrate
from dhcal_pin.estimation import select_parameters
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io import read_dh
from dhcal_pin.measurements import Noise, Pose
from dhcal_pin.planning import plan
from dhcal_pin.planning.bin_filling import filling_cost, filling_gains
from dhcal_pin.planning.criteria import DOptimality
from dhcal_pin.planning.exchange import (
    CandidateSet,
    compute_sqrt_covariance,
    improve_by_exchange,
    select_greedily,
)
from dhcal_pin.robot import Chain, joint_coverage
from dhcal_pin.robot.coverage import BIN_CENTRES
from dhcal_pin.robot.error_families import CURVE_ORDERS

pytestmark = pytest.mark.usefixtures("unsuspected")

NOISE = Noise(1e-4, np.deg2rad(0.01))
SETS = "minimal,base,tool"


def evenness(values: np.ndarray) -> float:
    """Sum 1 + 1/2 + … + 1/c over the bins of all joints, one configuration after the other."""
    seen: dict[tuple[int, int], int] = {}
    total = 0.0
    for row in np.degrees(values):
        for joint, value in enumerate(row):
            key = (joint, round(value / 5) % 72)
            seen[key] = seen.get(key, 0) + 1
            total += 1 / seen[key]
    return total


def test_gains_are_the_change_of_the_cost():
    rng = np.random.default_rng(0)
    filled, values = rng.uniform(-4, 4, (40, 3)), rng.uniform(-4, 4, (10, 3))
    weight = -filling_cost(np.zeros((1, 1)))
    assert filling_cost(filled) == pytest.approx(-weight * evenness(filled), rel=1e-12)
    for value, gain in zip(values, filling_gains(values, filled), strict=True):
        change = evenness(np.concatenate([filled, value[None]])) - evenness(filled)
        assert gain == pytest.approx(weight * change, rel=1e-9)
    assert filling_cost(filled[:0]) == 0
    assert np.all(filling_gains(values[:, :0], filled[:, :0]) == 0)


def test_criterion_decides_between_equally_even_designs():
    """Against all sets of five: the most even ones, and the best of them."""
    rng = np.random.default_rng(3)
    q = np.deg2rad(10 * rng.integers(0, 4, (14, 2)))
    rows = rng.standard_normal((4, 2, 14)) * rng.lognormal(size=14)
    candidates = CandidateSet(rows, q, bin_columns=[0, 1])
    existing, start = np.deg2rad([[0.0, 30.0]]), np.zeros(0, int)
    selected = select_greedily(candidates, np.eye(4), 5, DOptimality(), start, existing)
    selected = improve_by_exchange(candidates, np.eye(4), selected, DOptimality(), existing)

    def scores(indices) -> tuple[float, float]:
        value = DOptimality().value(compute_sqrt_covariance(np.eye(4), candidates.rows_of(np.array(indices))))
        return evenness(np.concatenate([existing, q[list(indices)]])), value

    every = [scores(indices) for indices in combinations(range(14), 5)]
    most_even = max(even for even, _ in every)
    even, value = scores(selected)
    assert even == pytest.approx(most_even, rel=1e-12)
    best = sorted(value for even, value in every if even > most_even - 1e-9)
    assert value <= best[len(best) // 10]


def check_drawn_poses(count: int, candidates: int) -> None:
    chain = nominal_arm("ur10")
    found = plan(chain, count, noise=NOISE, parameters=SETS, criterion="curves", candidates=candidates)
    other = plan(chain, count, noise=NOISE, parameters=SETS, candidates=candidates)
    visited, others = (
        np.array([one.n_visited for one in joint_coverage(chain, p.q)]) for p in (found, other)
    )
    # One bin per pose is the most that is possible.
    assert visited.min() >= 0.9 * min(count, 72)
    assert np.all(visited > others)
    assert ((found.q > chain.lower) & (found.q < chain.upper)).all()
    # The geometry loses little.
    assert found.error < 1.15 * other.error


def test_drawn_poses_fill_one_bin_of_every_joint_each():
    check_drawn_poses(30, 400)


@pytest.mark.slow
@pytest.mark.parametrize("count", [50, 100])
def test_many_drawn_poses_fill_all_bins(count):
    check_drawn_poses(count, 5000)


def test_poses_complement_existing_ones():
    """Measurements at one half of each joint's range leave the other half to the plan."""
    chain, rng = Chain.from_dh(paper("sim_6dof")), np.random.default_rng(0)
    q = rng.uniform(-np.pi, 0, (120, 6))
    data = Pose.simulate(chain, q, NOISE, rng)
    found = plan(
        chain, 30, parameters=SETS, criterion="curves", data=[data], candidates=rng.uniform(-3, 3, (600, 6))
    )
    assert np.mean(found.q > 0) > 0.8


def test_prismatic_joints_have_no_bins(tmp_path):
    chain = Chain.from_dh(read_dh(write(tmp_path, "scara.dh.toml", SCARA)))
    found = plan(chain, 20, noise=NOISE, parameters=SETS, criterion="curves", candidates=300)
    assert joint_coverage(chain, found.q)[0].n_visited == 20
    assert [one.n_poses for one in found.curves] == [0, 20, 50, 100, 200]


def test_robot_without_revolute_joints_is_an_error(tmp_path):
    gantry = SCARA.replace('name = "shoulder"\n', 'name = "shoulder"\ntype = "prismatic"\n')
    chain = Chain.from_dh(read_dh(write(tmp_path, "gantry.dh.toml", gantry)))
    with pytest.raises(DhcalError, match="no revolute joint"):
        plan(chain, 5, noise=NOISE, criterion="curves", candidates=20)


def test_named_curves_do_not_change_the_choice():
    """The bins stand for the coefficients of the curves, which would be hundreds of unknowns."""
    chain, q = Chain.from_dh(paper("sim_6dof")), np.random.default_rng(0).uniform(-3, 3, (100, 6))
    found = [
        plan(chain, 10, noise=NOISE, parameters=sets, criterion="curves", candidates=q)
        for sets in (SETS, f"{SETS},curves")
    ]
    assert np.array_equal(found[0].q, found[1].q)
    assert found[0].curves == found[1].curves


@pytest.mark.slow
def test_curves_combine_with_another_criterion():
    chain, rng = Chain.from_dh(paper("sim_6dof")), np.random.default_rng(0)
    q, task = rng.uniform(-3, 3, (400, 6)), rng.uniform(-0.3, 0.3, (20, 6))
    names = ("curves,task", "curves", "task,curves")
    errors = [
        plan(chain, 20, noise=NOISE, parameters=SETS, criterion=name, candidates=q, task=task).error
        for name in names
    ]
    assert errors[0] < errors[1]
    assert errors[2] == errors[0]


@pytest.mark.parametrize("name", ["curves,curve", "D,task", "curves,D,task", ""])
def test_other_combinations_are_errors(name):
    with pytest.raises(DhcalError, match="choose from D, A, E, task, robust, curves, or combine"):
        plan(Chain.from_dh(paper("sim_6dof")), 5, noise=NOISE, criterion=name, candidates=20)


def curve_values(chain: Chain, coefficients: dict[str, float]) -> np.ndarray:
    """Return the curves (n, b) of all joints at the centres of the bins."""
    functions = {"sin": np.sin, "cos": np.cos}
    return np.array(
        [
            sum(
                coefficients[f"{joint}.{name}{order}"] * function(order * BIN_CENTRES)
                for name, function in functions.items()
                for order in CURVE_ORDERS
            )
            for joint in chain.joint_names
        ]
    )


def check_predicted_std(seeds: int, tolerance: float) -> None:
    """Compare the predicted with the actual error of curves that are drawn from their prior."""
    chain, sets = nominal_arm("ur10"), f"{SETS},curves"
    candidates = np.random.default_rng(5).uniform(-np.pi, np.pi, (600, 6))
    found = plan(chain, 60, noise=NOISE, parameters=SETS, criterion="curves", candidates=candidates)
    errors = select_parameters(chain, sets)
    names = [parameter.name for parameter in errors.parameters]
    squares = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        # Base and tool are not known before: their values do not matter.
        truth = np.where(errors.is_of_arm, errors.priors, 0.0) * rng.standard_normal(len(names))
        data = Pose.simulate(errors.at(truth), found.q, NOISE, rng)
        fit = calibrate(chain, data, sets, extend="none")
        estimated = {parameter.name: value for parameter, value in zip(fit.parameters, fit.x, strict=False)}
        wrong = {name: estimated[name] - value for name, value in zip(names, truth, strict=True)}
        squares.append(np.mean(curve_values(chain, wrong) ** 2))
    predicted = {one.n_poses: one.curve_std for one in found.curves}
    assert np.sqrt(np.mean(squares)) == pytest.approx(predicted[60], rel=tolerance)
    assert predicted[0] == pytest.approx(1e-4 * np.sqrt(len(CURVE_ORDERS)), rel=1e-9)
    sizes = sorted(predicted)
    assert sizes == [0, 50, 60, 100, 200]
    assert np.all(np.diff([predicted[size] for size in sizes]) < 0)
    shares = [one.filled_share for one in found.curves]
    assert shares[0] == 0
    assert np.all(np.diff(shares) >= 0)
    assert shares[-1] == 1


def test_predicted_standard_deviation_of_curves():
    check_predicted_std(2, 0.15)


@pytest.mark.slow
def test_predicted_standard_deviation_of_many_curves():
    check_predicted_std(20, 0.06)
