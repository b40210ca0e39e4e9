"""Compiled kernels agree with NumPy and LAPACK at every size and reject unsuitable arrays."""

import functools
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from robots import ROOT, random_joints, random_table
from slow_cases import some_slow

from dhcal_pin import se3
from dhcal_pin._kernels import kinematics, qr, types
from dhcal_pin.robot import Chain

try:
    from dhcal_pin._kernels import _native, native
except ImportError:
    if os.environ.get("CI"):
        raise
    pytest.skip("the compiled kernels are not installed", allow_module_level=True)

SEEDS = st.integers(0, 2**32 - 1)
# Numbers of samples near the block sizes 64, 192 and 2048, and far from them.
SAMPLES = st.sampled_from([1, 2, 3, 7, 63, 64, 65, 191, 192, 193, 300, 2049])


@given(SEEDS, SAMPLES)
@settings(max_examples=60, deadline=None)
def test_frames_and_jacobians_agree_with_numpy(seed, m):
    """Revolute and prismatic joints, random twists on random bodies, output into a slice of an array."""
    rng = np.random.default_rng(seed)
    table = random_table(rng)
    chain = Chain.from_dh(table)
    motion = chain.joint_state(random_joints(rng, table, m))
    k, p = len(chain.moving_joints), int(rng.integers(1, 30))
    reference, compiled = np.empty((2, k + 2, 7, 3, m))
    reference[0, :4] = compiled[0, :4] = se3.exp6(rng.standard_normal(6))[:3].T[:, :, None]
    links = chain.link_transforms[None]
    kinematics.propagate_frames(links, chain.prismatic, motion, reference)
    native.propagate_frames(links, chain.prismatic, motion, compiled)
    np.testing.assert_allclose(compiled[:, :4], reference[:, :4], atol=1e-14)
    at = np.sort(rng.integers(0, k + 1, p))
    twists = rng.standard_normal((p, 6)) * (rng.random((p, 6)) < 0.4)
    twists[rng.random(p) < 0.3] = np.eye(6)[rng.integers(6)]
    wide = np.full((6, p + 1, m + 5), np.nan)
    out, expected = wide.swapaxes(0, 1)[:p, :, 2 : m + 2], np.empty((p, 6, m))
    kinematics.point_jacobian(reference[:-1], reference[-1, 3], at, twists, expected)
    native.point_jacobian(compiled[:-1], compiled[-1, 3], at, twists, out)
    np.testing.assert_allclose(out, expected, atol=1e-13)
    assert np.isnan(wide[:, p]).all()
    assert np.isnan(wide[..., [0, 1, -3, -2, -1]]).all()


@pytest.mark.parametrize("kernels", [native, kinematics])
@pytest.mark.parametrize("seed", range(4))
def test_frames_of_a_batch_are_those_of_each_chain(kernels, seed):
    rng = np.random.default_rng(seed)
    table = random_table(rng)
    chain = Chain.from_dh(table)
    motion = chain.joint_state(random_joints(rng, table, 15))
    links = chain.link_transforms @ se3.exp6(0.1 * rng.standard_normal((3, 1, 6)))
    frames = np.empty((len(chain.moving_joints) + 2, 7, 3, 15))
    frames[0, :4] = se3.exp6(rng.standard_normal(6))[:3].T[:, :, None]
    alone = frames.copy()
    kernels.propagate_frames(links, chain.prismatic, motion, frames)
    for member, link in enumerate(links):
        kinematics.propagate_frames(link[None], chain.prismatic, motion, alone)
        part = np.s_[:, :4, :, 5 * member : 5 * member + 5]
        np.testing.assert_allclose(frames[part], alone[part], atol=1e-13)


@given(SEEDS, SAMPLES, st.integers(1, 45), st.integers(1, 6))
@settings(max_examples=100, deadline=None)
def test_r_factor_agrees_with_lapack_up_to_signs(seed, m, columns, residuals):
    """Residuals with different zero columns; the input rows are not changed."""
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((residuals, columns, m)).swapaxes(0, 1)
    rows[rng.random((columns, residuals)) < 0.3] = 0.0
    rows *= 10.0 ** rng.uniform(-3, 3, columns)[:, None, None]
    before = rows.copy()
    r = native.r_factor(rows)
    np.testing.assert_array_equal(rows, before)
    np.testing.assert_array_equal(r, np.triu(r))
    whole = before.reshape(columns, -1)
    scale = np.linalg.norm(whole, axis=1)
    scale[scale == 0] = 1.0
    np.testing.assert_allclose(
        (r / scale).T @ (r / scale), whole @ whole.T / np.outer(scale, scale), atol=1e-13
    )


def test_batched_r_factors_equal_single_ones():
    """Batch members with more rows than columns, and with fewer."""
    rng = np.random.default_rng(0)
    for rows in rng.standard_normal((5, 7, 2, 30)), rng.standard_normal((5, 7, 2, 2)):
        many = native.r_factors(rows)
        for member, r in zip(rows, many, strict=True):
            np.testing.assert_array_equal(r, native.r_factor(member))
        reference = qr.r_factors(rows)
        np.testing.assert_allclose(
            many.swapaxes(1, 2) @ many, reference.swapaxes(1, 2) @ reference, atol=1e-12
        )


@pytest.mark.parametrize("kernels", [native, qr])
@pytest.mark.parametrize("p", [1, 2, 9])
def test_a_diagonal_block_adds_the_products_of_its_rows(kernels, p):
    rng = np.random.default_rng(p)
    for b in (1, 3):
        r = np.triu(rng.standard_normal((b, p + 1, p + 1)))
        diagonal, target = rng.uniform(1, 2, (b, p)), rng.standard_normal((b, p))
        rows = np.concatenate([diagonal[:, :, None] * np.eye(p), target[:, :, None]], 2)
        found = kernels.append_diagonal(r, diagonal, target)
        wanted = r.swapaxes(1, 2) @ r + rows.swapaxes(1, 2) @ rows
        np.testing.assert_allclose(found.swapaxes(1, 2) @ found, wanted, atol=1e-12)
        np.testing.assert_array_equal(np.tril(found, -1), 0)


@pytest.mark.parametrize("kernels", [native, qr])
@pytest.mark.parametrize("sides", [1, 3, 8])
def test_triangular_systems_are_solved(kernels, sides):
    """The factors are a part of larger arrays, as in a triangular system."""
    rng = np.random.default_rng(sides)
    rows = np.triu(rng.standard_normal((4, 8, 8))) + 3 * np.eye(8)
    x = rng.standard_normal((4, 7, sides))
    found = kernels.solve_triangular(rows[:, :-1, :-1], rows[:, :-1, :-1] @ x)
    np.testing.assert_allclose(found, x, atol=1e-12)


@pytest.mark.parametrize("p", [1, 2, 7, 60, 250])
def test_inverse_and_condition_of_triangular_matrices_agree_with_lapack(p):
    """The matrix is a part of a larger one, as in a triangular system; LAPACK's condition is an estimate."""
    rows = np.random.default_rng(p).standard_normal((2 * p, p + 1))
    r = np.asarray(np.linalg.qr(rows, mode="r"))[:p, :p]
    wanted = scipy.linalg.lapack.dtrtri(r)[0]
    for kernels in (native, qr):
        np.testing.assert_allclose(kernels.invert_triangular(r), wanted, atol=1e-14 * abs(wanted).max())
    estimate = qr.reciprocal_condition(r)
    exact = 1 / np.linalg.cond(r, 1)
    assert estimate / 3 <= exact <= estimate * (1 + 1e-9)
    assert native.reciprocal_condition(r) == pytest.approx(exact if p <= native.LARGE else estimate)


@pytest.mark.parametrize("kernels", [native, qr])
@pytest.mark.parametrize("last", [0.0, 1e-20, np.nan])
def test_a_singular_triangular_matrix_has_no_condition(kernels, last):
    """A number that is not finite is not well-conditioned either."""
    r = np.array([[1.0, 2.0, 0.5], [0.0, 3.0, 1.0], [0.0, 0.0, last]])
    assert not kernels.reciprocal_condition(r) > 1e-15


@pytest.mark.parametrize("size", [0.0, 1e-100, 1e-12, 1.0, 1e100])
def test_r_factor_of_any_magnitude(size):
    rows = size * np.random.default_rng(0).standard_normal((5, 2, 200))
    wanted = np.abs(np.linalg.qr(rows.reshape(5, -1).T, mode="r"))
    np.testing.assert_allclose(np.abs(native.r_factor(rows)), wanted, rtol=1e-12, atol=1e-12 * size)


def random_observation_matrix(
    rng: np.random.Generator, residuals: int, ends: int, m: int
) -> types.ObservationMatrix:
    """Build an observation matrix with random terms for some rows and none for others."""
    count = int(rng.integers(0, 12))
    rows = np.sort(rng.integers(0, residuals, count))
    return types.ObservationMatrix(rows, rng.integers(0, 6 * ends, count), rng.standard_normal((count, m)))


@given(SEEDS, SAMPLES, st.integers(1, 2), st.integers(1, 6), st.integers(1, 20))
@settings(max_examples=60, deadline=None)
def test_observation_matrix_products_are_sums_of_terms(seed, m, ends, residuals, vectors):
    rng = np.random.default_rng(seed)
    jacobian, observation = (
        rng.standard_normal((vectors, 6, ends * m)),
        random_observation_matrix(rng, residuals, ends, m),
    )
    expected = np.zeros((vectors, residuals, m))
    for row, component, share in zip(
        observation.rows, observation.components, observation.coefficients, strict=True
    ):
        end, which = divmod(component, 6)
        expected[:, row] += share * jacobian[:, which, end * m : (end + 1) * m]
    for way in native, kinematics:
        found = way.apply_observation_matrix(jacobian, observation, np.full(expected.shape, np.nan))
        np.testing.assert_allclose(found, expected, atol=1e-13)


@given(SEEDS, SAMPLES, st.integers(1, 2), st.integers(1, 7), st.integers(0, 4), st.sampled_from([1, 1, 3]))
@settings(max_examples=100, deadline=None)
def test_factored_jacobian_agrees_with_explicit_rows(seed, m, ends, residuals, n_given, members):
    """Rotations, translations and zero twists; rows that depend on some of them; given columns."""
    rng = np.random.default_rng(seed)
    table = random_table(rng)
    chain, p = Chain.from_dh(table), int(rng.integers(0, 30))
    frames = chain.forward_kinematics(random_joints(rng, table, ends * members * m))
    at = np.sort(rng.integers(0, len(chain.moving_joints) + 1, p))
    twists = rng.standard_normal((members, p, 6)) * (rng.random((members, p, 6)) < 0.4)
    twists[rng.random((members, p)) < 0.3, 3:] = 0.0
    given_columns = rng.standard_normal((residuals, n_given + 1, members * m)).swapaxes(0, 1)
    given_columns[rng.random((n_given + 1, residuals)) < 0.3] = 0.0
    observation = random_observation_matrix(rng, residuals, ends, members * m)
    terms = frames.columns, frames.tool[3], at, twists, observation, given_columns
    before = given_columns.copy()
    compiled = native.factor_jacobian(*terms)
    np.testing.assert_array_equal(given_columns, before)
    for r, reference in zip(compiled, qr.factor_jacobian(*terms), strict=True):
        np.testing.assert_array_equal(r, np.triu(r))
        wanted = reference.T @ reference
        scale = np.sqrt(np.diag(wanted))
        scale[scale == 0] = 1.0
        np.testing.assert_allclose((r / scale).T @ (r / scale), wanted / np.outer(scale, scale), atol=1e-12)


@given(SEEDS, st.integers(0, 30), st.sampled_from([1, 3]), st.booleans())
@settings(max_examples=60, deadline=None)
def test_perturbed_frames_agree_with_numpy(seed, count, members, is_shared):
    """Random twists, small and large, several per error frame, at base, joints and tool."""
    given = 1 if is_shared else members
    rng = np.random.default_rng(seed)
    chain = Chain.from_dh(random_table(rng))
    error_frames = np.sort(rng.integers(0, chain.tool_frame_index + 1, count))
    twists = rng.standard_normal((given, count, 6)) * (rng.random((given, count, 6)) < 0.4)
    x = rng.standard_normal((members, count)) * 10.0 ** rng.uniform(-9, 0, count)
    tool = se3.exp6(rng.standard_normal((given, 6)))
    origins = np.stack([chain.origins @ se3.exp6(rng.standard_normal(6)) for _ in range(given)])
    terms = chain.body_from_urdf, origins, tool, error_frames, twists, x
    reference, compiled = kinematics.perturb_frames(*terms), native.perturb_frames(*terms)
    for mine, other in zip(compiled, reference, strict=True):
        np.testing.assert_allclose(mine, other, atol=1e-13)
    for member, motions in enumerate(compiled[0]):
        for station, motion in enumerate(motions):
            steps = se3.exp6((x[:, :, None] * twists)[member, error_frames == station])
            np.testing.assert_allclose(motion, functools.reduce(np.matmul, steps, np.eye(4)), atol=1e-13)


@pytest.mark.parametrize("size", [1e-9, 0.5, 1.0, 10.0, 1e3, 9.9e4, 1.1e5, 1e12])
def test_cosines_and_sines_of_any_angle(size):
    """Relative error of at most 5e-16, also near the zeros of the functions."""
    angles = size * np.random.default_rng(2).uniform(-1, 1, (3, 1001))
    angles[0, :200] = np.round(angles[0, :200] / (np.pi / 4)) * (np.pi / 4)
    angles[1, :2] = 0.0, -0.0
    cosines, sines = native.cos_sin(angles)
    np.testing.assert_allclose(cosines, np.cos(angles), rtol=5e-16, atol=0)
    np.testing.assert_allclose(sines, np.sin(angles), rtol=5e-16, atol=0)
    assert np.isnan(native.cos_sin(np.array([[np.nan, np.inf]]))).all()


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-6, 1e-3, 0.02, 0.05, 1.0, 3.0, np.pi - 1e-9])
def test_rotation_vectors_and_jacobians_of_any_angle(size):
    """Compare with `se3`, which is tested against Pinocchio."""
    rng = np.random.default_rng(1)
    axes = rng.standard_normal((130, 3))
    rotvecs = np.ascontiguousarray(size * (axes / np.linalg.norm(axes, axis=1)[:, None]).T)
    rotations = np.ascontiguousarray(se3.exp3(rotvecs.T).transpose(1, 2, 0))
    np.testing.assert_allclose(
        native.log_rotations(rotations), se3.log3(rotations.transpose(2, 0, 1)).T, atol=2e-15
    )
    inverses = native.right_jacobian_inverse_batch(rotvecs).transpose(2, 0, 1)
    np.testing.assert_allclose(inverses, se3.right_jacobian_inverse(rotvecs.T), atol=1e-14)


def test_results_do_not_depend_on_alignment_or_on_other_samples(sim_6dof):
    """Vectorized loops and their remainders round equally; otherwise reports would differ between runs."""
    q = np.random.default_rng(0).uniform(-3, 3, (300, 6))
    bodies, twists = np.arange(7), np.random.default_rng(1).standard_normal((7, 6))
    frames = sim_6dof.forward_kinematics(q)
    jacobian = sim_6dof.tool_jacobian(frames, bodies, twists)
    for first, count in ((0, 1), (3, 1), (5, 2), (66, 3), (1, 67), (100, 64)):
        part = slice(first, first + count)
        alone = sim_6dof.forward_kinematics(q[part])
        np.testing.assert_array_equal(alone.bodies, frames.bodies[..., part])
        own = sim_6dof.tool_jacobian(alone, bodies, twists)
        np.testing.assert_array_equal(own, jacobian[..., part])
        rotations = np.ascontiguousarray(alone.tool[:3])
        whole = native.log_rotations(np.ascontiguousarray(frames.tool[:3]))
        np.testing.assert_array_equal(native.log_rotations(rotations), whole[:, part])
        rotvecs = np.ascontiguousarray(own[0, 3:])
        inverses = native.right_jacobian_inverse_batch(np.ascontiguousarray(jacobian[0, 3:]))
        np.testing.assert_array_equal(native.right_jacobian_inverse_batch(rotvecs), inverses[..., part])
        rows, components = np.repeat(np.arange(3), 3), np.tile([3, 4, 5], 3)
        observation = types.ObservationMatrix(rows, components, inverses.reshape(9, -1))
        out, expected = np.empty((7, 3, count)), np.empty((7, 3, 300))
        native.apply_observation_matrix(jacobian, observation, expected)
        native.apply_observation_matrix(
            own, replace(observation, coefficients=observation.coefficients[:, part]), out
        )
        np.testing.assert_array_equal(out, expected[..., part])
        cosines, sines = native.cos_sin(np.ascontiguousarray(q.T))
        mine = native.cos_sin(np.ascontiguousarray(q[part].T))
        np.testing.assert_array_equal(mine, (cosines[:, part], sines[:, part]))
    rows = np.random.default_rng(2).standard_normal((9, 3, 67))
    wanted = native.r_factor(rows)
    for shift in range(1, 8):
        moved = np.empty(rows.size + 8)[shift : shift + rows.size].reshape(rows.shape)
        moved[...] = rows
        np.testing.assert_array_equal(native.r_factor(moved), wanted)


@pytest.mark.parametrize(
    "rows",
    [
        np.zeros((1, 3, 2, 4), np.float32),
        np.zeros((3, 2, 8)),
        np.zeros((4, 2, 3, 1)).T,
        np.zeros((1, 3, 2, 8))[..., ::2],
        "rows",
    ],
)
def test_unsuitable_arrays_are_rejected(rows):
    with pytest.raises((ValueError, TypeError)):
        _native.r_factors(rows, np.empty(10_000), np.zeros((1, 3, 3)))


def test_shapes_indices_and_read_only_arrays_are_checked(sim_6dof):
    rows, frozen = np.zeros((1, 3, 2, 4)), np.zeros((1, 3, 3))
    frozen.flags.writeable = False
    for out in (
        np.zeros((1, 3, 4)),
        np.zeros((2, 3, 3)),
        np.zeros((1, 6, 6))[:, ::2, ::2],
        np.zeros((1, 3, 6))[..., :3],
        frozen,
    ):
        with pytest.raises((ValueError, BufferError)):
            _native.r_factors(rows, np.empty(10_000), out)
    with pytest.raises(ValueError, match="shapes"):
        _native.r_factors(rows, np.empty(_native.work_size(3, 2, 0) - 1), np.zeros((1, 3, 3)))
    with pytest.raises(TypeError):
        _native.r_factors(rows)  # pyright: ignore[reportCallIssue]
    frames, out = sim_6dof.forward_kinematics(np.zeros((5, 6))), np.empty((1, 6, 5))
    for body in (-1, len(frames.columns)):
        with pytest.raises(ValueError, match="shapes"):
            native.point_jacobian(frames.columns, frames.tool[3], np.array([body]), np.zeros((1, 6)), out)
    errors = frames.columns, frames.tool[3], np.zeros(1, int), np.ones((1, 1, 6))
    for rows, components in (([0], [6]), ([2], [0]), ([1, 0], [0, 0]), ([0], [-1])):
        observation = types.ObservationMatrix(np.array(rows), np.array(components), np.ones((len(rows), 5)))
        with pytest.raises(ValueError, match="shapes"):
            native.apply_observation_matrix(out, observation, np.empty((1, 2, 5)))
        with pytest.raises(ValueError, match="shapes"):
            native.factor_jacobian(*errors, observation, np.zeros((1, 2, 5)))
    for error_frames in ([sim_6dof.tool_frame_index + 1], [-1], [2, 1]):
        terms = sim_6dof.body_from_urdf, sim_6dof.origins[None], np.eye(4)[None], np.array(error_frames)
        with pytest.raises(ValueError, match="shapes"):
            native.perturb_frames(
                *terms, np.zeros((1, len(error_frames), 6)), np.zeros((1, len(error_frames)))
            )
    with pytest.raises(ValueError, match="shapes"):
        native.propagate_frames(
            sim_6dof.link_transforms[None, 1:],
            sim_6dof.prismatic,
            sim_6dof.joint_state(np.zeros((5, 6))),
            np.empty((8, 7, 3, 5)),
        )


CALIBRATION = """
import json, sys
if sys.argv[1] == "numpy":
    sys.modules["dhcal_pin._kernels._native"] = None
import numpy as np
from robots import paper
from dhcal_pin import _kernels
from dhcal_pin import Chain, Noise, Pose, calibrate
assert (_kernels.propagate_frames.__module__ == "dhcal_pin._kernels.native") == (sys.argv[1] == "compiled")
nominal, actual = Chain.from_dh(paper("sim_6dof")), Chain.from_dh(paper("sim_6dof_actual"))
rng = np.random.default_rng(0)
data = Pose.simulate(actual, rng.uniform(-3, 3, (90, 6)), Noise(1e-4, 1e-4), rng)
fit = calibrate(nominal, data, sys.argv[2], extend=sys.argv[3])
print(json.dumps([fit.converged, fit.x.tolist(), fit.std.tolist()]))
"""


@pytest.mark.parametrize(
    ("sets", "extend"),
    some_slow(
        [("dh", "auto"), ("dh,harmonics", "none"), ("dh,harmonics", "auto"), ("dh,harmonics,curves", "auto")],
        {1},
    ),
)
def test_calibration_without_compiled_kernels_gives_the_same_values(sets, extend):
    places = Path(native.__file__).parents[2], ROOT / "tests"
    environ = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, map(Path.resolve, places)))}
    ends = [
        json.loads(
            subprocess.run(
                [sys.executable, "-c", CALIBRATION, way, sets, extend],
                env=environ,
                capture_output=True,
                text=True,
                check=True,
            ).stdout
        )
        for way in ("compiled", "numpy")
    ]
    assert all(converged for converged, _, _ in ends)
    np.testing.assert_allclose(ends[0][1], ends[1][1], atol=1e-9)
    np.testing.assert_allclose(ends[0][2], ends[1][2], rtol=1e-6)
