"""Parameter sets: derivatives by finite differences, ranks by theory, exact DH changes, names, messages."""

from dataclasses import replace

import numpy as np
import pytest
from robots import paper, random_table, with_masses
from slow_cases import some_slow

from dhcal_pin import se3
from dhcal_pin.calibration import calibrate
from dhcal_pin.estimation import PARAMETER_SETS, Problem, linearize_and_factor, qr, select_parameters
from dhcal_pin.exceptions import DhcalError, InvalidArgumentError, UnknownNameError
from dhcal_pin.measurements import Noise, Pose, Position
from dhcal_pin.robot import Chain

pytestmark = pytest.mark.usefixtures("unsuspected")


def rank(chain: Chain, sets: str, kind: type = Pose, m: int = 60) -> int:
    """Return the number of observable directions with exact measurements at random configurations."""
    errors = select_parameters(chain, sets)
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (m, chain.n_joints))
    zero = np.zeros(len(errors.parameters))
    data = kind.simulate(chain, q, Noise(), np.random.default_rng(0))
    return qr.rank(linearize_and_factor(Problem(errors, (data,), zero), zero, False).r)


@pytest.mark.parametrize("sets", [*PARAMETER_SETS, "minimal,base,tool,offset", "dh,placement"])
def test_derivatives_agree_with_finite_differences_at_any_value(sets):
    rng = np.random.default_rng(1)
    for _ in range(3):
        # Half of the joints are revolute, so that every set has parameters.
        table = random_table(rng, size=4)
        chain = with_masses(
            Chain.from_dh(replace(table, prismatic=table.prismatic & (rng.random(4) < 0.5))), rng
        )
        errors = select_parameters(chain, sets)
        x = 0.1 * rng.normal(size=len(errors.parameters))
        q, h = rng.uniform(-1, 1, (4, 4)), 1e-6
        chain, bodies, twists = errors.derivative(x)
        assert np.all(np.diff(bodies) >= 0)
        jacobian = chain.tool_jacobian(chain.forward_kinematics(q), bodies, twists)
        np.testing.assert_allclose(chain.poses(q), errors.at(x).poses(q), atol=1e-15)
        for k in range(len(x)):
            step = h * np.eye(len(x))[k]
            up, down = errors.at(x + step).poses(q), errors.at(x - step).poses(q)
            linear = (up - down)[:, :3, 3] / (2 * h)
            angular = se3.log3(up[:, :3, :3] @ np.swapaxes(down[:, :3, :3], 1, 2)) / (2 * h)
            np.testing.assert_allclose(jacobian[k].T, np.concatenate([linear, angular], 1), atol=2e-9)


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_dh_changes_are_exact(convention):
    """Large errors of all table entries give the poses of the changed table."""
    rng = np.random.default_rng(2)
    for _ in range(20):
        table = random_table(rng, convention, 5)
        chain = Chain.from_dh(table)
        errors = select_parameters(chain, "dh" if convention == "standard" else "modified-dh")
        change = {key: rng.uniform(-0.3, 0.3, 5) for key in ("theta", "d", "a", "alpha")}
        x = np.array([change[p.name.rstrip("12345")][int(p.name[-1]) - 1] for p in errors.parameters])
        other = replace(table, **{key: getattr(table, key) + value for key, value in change.items()})
        q = rng.uniform(-1, 1, (5, 5))
        np.testing.assert_allclose(errors.at(x).poses(q), other.poses(q), atol=1e-13)
        for p in errors.parameters:
            nominal = getattr(table, p.name.rstrip("12345"))[int(p.name[-1]) - 1]
            difference = p.nominal - nominal
            if p.unit == "rad":
                difference = (difference + np.pi) % (2 * np.pi) - np.pi
            assert abs(difference) < 1e-12, p.name


def test_ranks_of_the_robots_of_the_paper():
    assert rank(Chain.from_dh(paper("sim_6dof")), "dh") == 21
    assert rank(Chain.from_dh(paper("sim_6dof_actual")), "dh") == 24
    assert rank(Chain.from_dh(paper("sim_3dof")), "dh", Position) == 10
    assert rank(Chain.from_dh(paper("sim_3dof_actual")), "dh", Position) == 11


@pytest.mark.parametrize("seed", range(8))
def test_minimal_with_base_and_tool_is_complete(seed):
    """4R + 2P + 6 directions, also together with redundant sets."""
    table = random_table(np.random.default_rng(seed), size=5)
    chain = Chain.from_dh(table)
    n_prismatic = int(table.prismatic.sum())
    theory = 4 * (5 - n_prismatic) + 2 * n_prismatic + 6
    assert rank(chain, "minimal,base,tool") == theory
    assert rank(chain, "minimal,placement,base,tool,offset") == theory


@pytest.mark.parametrize(
    "sets", ["dh,base,tool", "modified-dh,base,tool", "hayati,base,tool", "minimal,base,tool"]
)
def test_a_mimic_joint_has_errors_of_its_own(sets, mimicking):
    """Six moving and five independent joints: 4R + 6 directions, and the true robot is identified."""
    assert rank(mimicking, sets) == 4 * 6 + 6
    rng = np.random.default_rng(3)
    errors = select_parameters(mimicking, sets)
    truth = errors.at(5e-3 * rng.normal(size=len(errors.parameters)))
    q = rng.uniform(-np.pi, np.pi, (60, mimicking.n_joints))
    fit = calibrate(mimicking, Pose(q[:30], truth.poses(q[:30])), sets, priors="none")
    assert np.abs(fit.chain.poses(q[30:]) - truth.poses(q[30:])).max() < 1e-9


def hold_out_error(robot: str, sets: str, seed: int, priors) -> float:
    """Return the largest hold-out error after a fit of exact poses; errors are up to 2° and 10 mm."""
    chain, rng = Chain.from_dh(paper(robot)), np.random.default_rng(seed)
    errors = select_parameters(chain, sets)
    size = np.array([np.deg2rad(2) if p.unit == "rad" else 0.01 for p in errors.parameters])
    truth = errors.at(size * rng.uniform(-1, 1, len(size)))
    q = rng.uniform(-np.pi, np.pi, (80, chain.n_joints))
    fit = calibrate(chain, Pose(q[:40], truth.poses(q[:40])), sets, priors=priors)
    return float(np.abs(fit.chain.poses(q[40:]) - truth.poses(q[40:])).max())


PAIRS = [
    (robot, priors)
    for priors in ("none", "default")
    for robot in ("sim_3dof", "experiment", "sim_6dof", "sim_6dof_actual")
]
IDENTIFIED = ["dh", "modified-dh", "hayati", "minimal", "placement"]
PRIORS = pytest.mark.parametrize("priors", ["none", "default"])
ROBOTS = pytest.mark.parametrize("robot", ["sim_3dof", "sim_6dof", "sim_6dof_actual", "experiment"])


@pytest.mark.parametrize(("robot", "priors"), some_slow(PAIRS, {0, 1, 2, 3, 4, 6}))
def test_robots_of_the_paper_are_identified_with_and_without_priors(robot, priors):
    """Default priors lose their influence as the estimated noise falls to zero."""
    assert max(hold_out_error(robot, f"{sets},base,tool", 0, priors) for sets in IDENTIFIED) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("frames", ["", ",base,tool"])
@pytest.mark.parametrize("sets", IDENTIFIED)
@PRIORS
@ROBOTS
def test_robots_of_the_paper_are_identified_in_every_seed(robot, priors, sets, frames):
    assert max(hold_out_error(robot, sets + frames, seed, priors) for seed in range(100)) < 1e-9


def test_minimal_has_four_parameters_per_revolute_and_two_per_prismatic_joint():
    table = replace(random_table(np.random.default_rng(0), size=3), prismatic=np.array([False, True, False]))
    names = [p.name for p in select_parameters(Chain.from_dh(table), "minimal").parameters]
    assert names == [
        "j1.x", "j1.y", "j1.rx", "j1.ry", "j2.rx", "j2.ry", "j3.x", "j3.y", "j3.rx", "j3.ry",
    ]  # fmt: skip


def test_hayati_has_beta_between_parallel_axes_only(sim_6dof):
    names = {p.name for p in select_parameters(sim_6dof, "hayati").parameters}
    assert {"beta2", "beta3", "beta5"} <= names
    assert not names & {"d2", "d3", "d5", "beta1", "beta4", "beta6"}
    assert len(names) == 24


def test_fix_and_free(sim_6dof):
    errors = select_parameters(sim_6dof, "dh", fix=["d3", "alpha3"])
    assert {p.name for p in errors.fixed} == {"d3", "alpha3"}
    assert len(errors.parameters) == 22
    freed = select_parameters(sim_6dof, "base", free=["d3"])
    assert [p.name for p in freed.parameters if p.name.startswith("d")] == ["d3"]
    assert len(select_parameters(sim_6dof, "dh,base", fix=["base"]).parameters) == 24


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"sets": "dhh"}, "choose from dh, modified-dh"),
        ({"sets": "dh", "fix": ["d9"]}, "cannot fix 'd9'.*theta1"),
        ({"sets": "dh", "fix": ["tool"]}, "cannot fix 'tool': none of its parameters is unknown.*theta1"),
        ({"sets": "dh", "free": ["q1"]}, "cannot free 'q1'"),
        ({"sets": "dh", "free": ["offset"]}, "'offset'.* whole set; add it to the parameters"),
        ({"sets": "dh", "fix": ["d2", "d3"], "free": ["d3"]}, "'d3' is both fixed and freed"),
        ({"sets": "base", "fix": ["base"]}, "no parameter is left"),
    ],
)
def test_wrong_names_list_the_choices(sim_6dof, kwargs, message):
    with pytest.raises((UnknownNameError, InvalidArgumentError), match=message):
        select_parameters(sim_6dof, **kwargs)


def test_a_set_without_parameters_names_what_it_needs(sim_6dof):
    with pytest.raises(DhcalError, match=r"'compliance'; the set needs .* masses"):
        select_parameters(sim_6dof, "compliance")


def test_every_set_has_a_help_text_of_one_line():
    texts = [parameter_set.help for parameter_set in PARAMETER_SETS.values()]
    assert all(0 < len(text) < 80 and "\n" not in text for text in texts)
    assert len(set(texts)) == len(texts)
