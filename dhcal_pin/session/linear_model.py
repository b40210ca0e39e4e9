"""Linear model of a session: whitened rows of the samples by all unknowns and by all possible causes.

The columns are those of the parameters of the robot and of the instruments, then of base and tool, of the
joint zeros, of the growth of each link, of scales of the instrument, of a constant error of its distances
from the origin of the measuring frame, of a payload, of a lag and of the zero of each wire, and last the
residual r. A payload turns each joint by its compliance times the gravity torque of the payload. The column
of a joint is its motion per kilogram and unit of compliance.

Shapes: m samples of at most k residuals, c columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .._frozen import frozen
from .._kernels import apply_observation_matrix, invert_triangular, r_factor
from .._typing import Array
from ..estimation.contacts.scale_gauge import normalize_by_scale
from ..estimation.parameters import base, tool
from ..estimation.problem import Problem
from ..measurements.base import Measurement, instrument_values
from ..measurements.groups import POSITION
from ..measurements.length import Wires
from ..robot.error_families import COMPLIANCE, JOINT_TERMS, MIN_TORQUE, growing_links
from .causes import HELD_SIZE, Block, Constant, Drift, FreeDrift, Kind, Shape, Step

# Factor to the prior standard deviations: the errors of an arm may be far larger than expected.
PRIOR_FACTOR = 10.0
# Largest entry of a column, relative to those of others, below which it is rounding.
MIN_OBSERVED = 1e-9
# Largest share of a constant error that the unknowns of the calibration may leave.
MAX_UNEXPLAINED = 1e-3
# Added to the unit diagonal of information for directions that nothing determines.
MIN_INFORMATION = 1e-12
# The same for the singular values of rows with columns of unit length.
MIN_SINGULAR_VALUE = 1e-9
# Smallest distance from the origin of the measuring frame at which its error has a direction [m].
MIN_RANGE = 0.1
# Axes of a scale; empty for all axes.
SCALE_AXES = ("", "x", "y", "z")


def measures_positions(data: Sequence[Measurement]) -> bool:
    """Return whether all samples are positions or poses, so that a scale of their axes can be wrong."""
    return all(len(item.positions()) == len(item.rows) for item in data)


@frozen(eq=False)
class Layout:
    """Columns of the linear model."""

    problem: Problem  # Problem whose errors contain all parameters of base and tool
    model: Array  # Columns of the unknowns of the calibration, (p,)
    weights: Array  # Their prior weights, (p,)
    blocks: tuple[Block, ...]  # Possible causes
    joints: Array  # Columns of the joint zeros, (n,)
    links: Array  # Columns of the growth of each link, (k+1,)
    scale: int  # Column of a scale of all axes about the mean point
    range: int  # Column of a constant error of distances from the origin of the measuring frame
    payload: Array  # Columns of the motions of the joints by a payload, (n,)
    lag: int  # Column of the lag
    wires: Array  # Columns of the zeros of the wires
    n_columns: int  # Number of columns, the residual included

    @classmethod
    def of(cls, problem: Problem) -> Layout:
        """Lay out the columns of a problem."""
        errors = problem.errors
        own = [parameter.name for parameter in errors.parameters]
        frames = [p for p in (*base(errors.chain), *tool(errors.chain)) if p.name not in own]
        extended = errors.with_parameters(frames)
        names = [parameter.name for parameter in extended.parameters]
        p, s = len(names), len(problem.instrument_parameters)
        model = np.array([*(names.index(name) for name in own), *range(p, p + s)], int)
        # A calibration without priors leaves redundant unknowns undetermined; the search does not.
        expected = np.array([*errors.priors, *(u.prior for u in problem.instrument_parameters)])
        chain = errors.chain
        n, n_links = chain.n_joints, len(chain.moving_joints) + 1
        joints = p + s + np.arange(n)
        links = joints[-1] + 1 + np.arange(n_links)
        all_links = int(links[-1]) + 1
        scales = all_links + 1 + np.arange(len(SCALE_AXES) + 1)
        range_error = int(scales[-1]) + 1
        payload = range_error + 1 + np.arange(n)
        lag = int(payload[-1]) + 1
        counts = [item.values.shape[1] for item in problem.data if isinstance(item, Wires)]
        wires = lag + 1 + np.arange(max(counts, default=0))
        grows = growing_links(chain.link_vectors)
        # A robot without lengths only turns.
        size = float(np.linalg.norm(chain.link_vectors, axis=1).sum()) or 1.0
        of_frame = np.array([1.0] * 3 + [1 / size] * 3)
        of_base, of_tool = (
            np.array([names.index(q.name) for q in parameters]) for parameters in (base(chain), tool(chain))
        )
        blocks = [Block("base", "", of_base, of_frame), Block("tool", "", of_tool, of_frame)]
        # Joint values that only reproduce poses of the tip have no zeros, and their links do not grow.
        has_joints = all(item.has_joint_values for item in problem.data)
        for j, name in enumerate(chain.joint_names if has_joints else ()):
            unit = 1.0 if chain.is_prismatic[j] else 1 / size
            blocks.append(Block("joint", name, joints[j : j + 1], np.array([unit]), j))
        # All links by one factor, or each by its own.
        if has_joints and grows.any():
            drifts = Drift, FreeDrift
            blocks.append(Block("links", "", np.array([all_links]), np.array([1 / size]), shapes=drifts))
            blocks.append(Block("links", "", links[grows], np.full(grows.sum(), 1 / size), shapes=drifts))
        # Robots without masses do not bend, and a payload that is stated has been taken into account.
        torque = _largest_torques(problem)
        if has_joints and torque.any():
            unit = 1 / (size * torque.max())
            sizes = np.where(torque > MIN_TORQUE, unit, HELD_SIZE)
            blocks.append(Block("payload", "", payload, sizes, shapes=(Step,)))

        def add_error(
            kind: Kind, of: str, column: int, unit: float, shape: type[Shape] = Constant, index: int = 0
        ) -> None:
            """Add an error of the recording with one coefficient."""
            sizes = np.array([unit])
            blocks.append(Block(kind, of, np.array([column]), sizes, index, (shape,), is_of_recording=True))

        if measures_positions(problem.data):
            # The size of the robot imitates a scale of all axes in all files.
            for i, axis in enumerate(SCALE_AXES[1:], 1):
                add_error("scale", axis, int(scales[i]), 1 / size, index=i)
            if len(problem.data) > 1:
                add_error("scale", "", int(scales[-1]), 1 / size, Step)
            add_error("range", "", range_error, 1.0)
        for i, column in enumerate(wires.tolist()):
            add_error("wire", str(i + 1), column, 1.0, Step, i)
        add_error("lag", "", lag, 1.0)
        return cls(
            replace(problem, errors=extended),
            model,
            np.where(problem.weights > 0, problem.weights, 1 / expected) / PRIOR_FACTOR,
            tuple(blocks),
            joints,
            links,
            int(scales[0]),
            range_error,
            payload,
            lag,
            wires,
            lag + len(wires) + 2,
        )

    def restricted_to(self, rows: Array) -> Layout:
        """Return the layout with the causes that the rows (m, k, c) can show."""
        # Columns without an effect on the rows are held at their values. A change over time is looked for
        # only if the calibration also estimates a constant error of the same kind.
        largest = np.abs(rows).max((0, 1))
        is_observed = largest > MIN_OBSERVED * largest[[b.columns[0] for b in self.blocks]].max()
        # The search itself adds a constant payload beside a step of it.
        can_change = [b.columns for b in self.blocks if not (b.is_of_recording or b.kind == "payload")]
        changing = np.unique(np.concatenate(can_change))
        products = np.tensordot(rows, rows, ((0, 1), (0, 1)))
        of_model = products[np.ix_(self.model, changing)]
        explained = inverse(products[np.ix_(self.model, self.model)]) @ of_model
        squares = np.diag(products)[changing]
        share = 1 - np.sum(of_model * explained, 0) / np.maximum(squares, 1e-300)
        constant_only = set(changing[is_observed[changing] & (share > MAX_UNEXPLAINED)].tolist())
        blocks = [
            replace(block, sizes=np.where(is_observed[block.columns], block.sizes, HELD_SIZE))
            for block in self.blocks
            if block.is_of_recording or not constant_only.intersection(block.columns.tolist())
        ]
        # The rotation of a tool of which only a point is measured would turn with the direction of its steps.
        weights = np.where(is_observed[self.model], self.weights, 1 / HELD_SIZE)
        return replace(self, blocks=tuple(blocks), weights=weights)

    def block_like(self, block: Block) -> Block:
        """Return a block of another layout of the same robot with the columns that it has here."""
        key = block.kind, block.index, len(block.columns)
        own = next(each for each in self.blocks if (each.kind, each.index, len(each.columns)) == key)
        return replace(block, columns=own.columns)

    @property
    def has_payload(self) -> bool:
        """Whether a payload is a possible cause."""
        return any(block.kind == "payload" for block in self.blocks)

    def errors_at(self, x: Array) -> Array:
        """Return the values of all parameters of `problem`, for unknowns x (p,) of the calibration."""
        full = np.zeros(self.joints[0])
        full[self.model] = x
        return full


def whitened_rows(layout: Layout, x: Array, data: Sequence[Measurement], rates: Array) -> Array:
    """Compute the whitened rows of all samples, (m, k, c), for joint rates (m, n)."""
    problem, full = layout.problem, layout.errors_at(x)
    errors = problem.errors
    chain, bodies, twists = errors.derivative(full[: len(errors.parameters)])
    values, gauge = problem.instruments(full), problem.scale_gauge
    size, gauge_rates = 1.0, np.zeros((len(bodies), 4))
    if gauge:
        size, gauge_rates = gauge.size_and_rates(chain, bodies, twists)
    count, width = sum(len(item.rows) for item in data), max(item.residual_dim for item in data)
    out, start = np.zeros((layout.n_columns, width, count)), 0
    instrument_columns = {
        u.name: len(errors.parameters) + i for i, u in enumerate(problem.instrument_parameters)
    }
    for item in data:
        block = out[:, : item.residual_dim, start : start + len(item.rows)]
        start += len(item.rows)
        frames = chain.forward_kinematics(item.conditions())
        u = instrument_values(item, values)
        residual = item.residual(frames, u)
        observation = item.observation_matrix(frames, u, residual)
        block[-1] = residual
        jacobian = chain.tool_jacobian(frames, bodies, twists, body=observation.body)
        growth = chain.growth_motions(frames)
        by_joint = chain.joint_jacobian(frames, observation.body)
        torque = np.zeros((len(by_joint), by_joint.shape[-1]))
        if layout.has_payload:
            torque = errors.chain.loads.torques_per_kilogram(item.configurations().T)
        motions = np.concatenate(
            [
                by_joint,
                growth,
                growth.sum(0, keepdims=True),
                _scale_motions(frames.tool[3]),
                _range_motion(frames.tool[3]),
                by_joint * torque[:, None],
            ]
        )
        apply_observation_matrix(jacobian, observation, block[: len(bodies)])
        apply_observation_matrix(motions, observation, block[layout.joints[0] : layout.lag])
        parts = zip(item.instrument_parameters, item.instrument_jacobian(frames, u), strict=True)
        for parameter, part in parts:
            if parameter.name in instrument_columns:
                block[instrument_columns[parameter.name]] = part
        if isinstance(item, Wires):
            for i, weights in enumerate(1 / item.sigma.T):
                block[layout.wires[i], i] = weights
        if gauge and not item.has_length_scale:
            for group in item.residual_groups.values():
                if group.unit == "m":  # the size of a robot does not change angles
                    normalize_by_scale(block[:, group.rows], size, gauge_rates, group is POSITION)
    out[layout.lag] = np.einsum("nkm,mn->km", out[layout.joints], rates)
    return np.ascontiguousarray(out.transpose(2, 1, 0))


def _largest_torques(problem: Problem) -> Array:
    """Return the largest gravity torque of each joint per kilogram of an unstated payload, (n,) [N·m/kg]."""
    chain = problem.errors.chain
    is_stated = any(item.recorded is not None and item.recorded.payload is not None for item in problem.data)
    if is_stated or not JOINT_TERMS[COMPLIANCE].has_effect(chain.loads).any():
        return np.zeros(chain.n_joints)
    torques = [np.abs(chain.loads.torques_per_kilogram(item.q.T)).max(1) for item in problem.data]
    return np.where(chain.is_prismatic, 0.0, np.max(torques, 0))


def _scale_motions(points: Array) -> Array:
    """Return the twists of the tool point per unit of each scale about the mean point, (5, 6, m).

    The last one is about the origin of the measuring frame.
    """
    centred = points - points.mean(1, keepdims=True)
    out = np.zeros((len(SCALE_AXES) + 1, 6, points.shape[1]))
    out[0, :3], out[-1, :3] = centred, points
    for axis in range(3):
        out[1 + axis, axis] = centred[axis]
    return out


def _range_motion(points: Array) -> Array:
    """Return the twist of the tool point per metre of an error of its distance from the origin, (1, 6, m)."""
    distances = np.linalg.norm(points, axis=0)
    out = np.zeros((1, 6, points.shape[1]))
    out[0, :3] = points / np.maximum(distances, MIN_RANGE)
    return out


def inverse(information: Array) -> Array:
    """Return the inverse of a matrix of information, some directions of which may be undetermined."""
    unit, scale = _with_unit_diagonal(information)
    return np.linalg.inv(unit) / scale / scale[:, None]


def covariance_root(rows: Array, prior: Array) -> Array:
    """Return a square root C (p, p) of a covariance CCᵀ from rows (n, p) and weights of priors (p,).

    The R factor of the rows keeps the digits that a matrix of information loses where the rows hardly show a
    direction: the squares of its singular values are the eigenvalues of that matrix.
    """
    p = len(prior)
    stacked = np.zeros((p, len(rows) + p))
    stacked[:, : len(rows)] = rows.T
    sizes = np.sqrt(np.einsum("pn,pn->p", stacked, stacked) + prior**2)
    sizes[sizes == 0] = 1.0
    # Nothing determines some directions.
    stacked.flat[len(rows) :: stacked.shape[1] + 1] = np.hypot(prior, MIN_SINGULAR_VALUE * sizes)
    return invert_triangular(r_factor(stacked[:, None]))


def solve_information(information: Array, right: Array) -> Array:
    """Return the inverses of matrices of information (..., p, p) times vectors (..., p)."""
    unit, scale = _with_unit_diagonal(information)
    return np.linalg.solve(unit, (right / scale)[..., None])[..., 0] / scale


def _with_unit_diagonal(information: Array) -> tuple[Array, Array]:
    """Scale matrices of information to unit diagonal, and raise the diagonal for undetermined directions."""
    scale = np.sqrt(np.einsum("...ii->...i", information))
    scale[scale == 0] = 1.0
    unit = information / scale[..., None, :] / scale[..., None]
    np.einsum("...ii->...i", unit)[...] += MIN_INFORMATION
    return unit, scale
