"""Uncertainty of a calibrated robot: the predicted covariance of its tool poses.

Every identified error moves one body of the chain by a twist, or changes one transmission coefficient. The
covariance of the parameters is therefore stored as a covariance of body twists and coefficients, which
depends neither on the parameter set nor on the data, and can be kept in a file. With the parameters'
covariance S·Sᵀ and the matrix A from parameters to body twists and coefficients, the stored square root is
A·S.

At joint positions q with the tool Jacobian J(q) of those twists and coefficients, the covariance of the tool
twist [v, ω] is, to first order,

    C(q) = (J·A·S)·(J·A·S)ᵀ

Where the residuals are errors of the model, which other configurations have as well, their variance per axis
is added, σ_v² for positions and σ_ω² for orientations:

    C(q) = (J·A·S)·(J·A·S)ᵀ + diag(σ_v², σ_v², σ_v², σ_ω², σ_ω², σ_ω²)

Noise of future measurements is not included. Directions that neither data nor priors determine are stored
separately; a tool component that depends on them has infinite variance.

The compact form of a large uncertainty, for files, is the information that it follows from (`information`).
Its corrections A and B are the eigenvectors of the difference of both, in units of the standard deviations,
whose eigenvalues are above `MAX_ERROR`. No variance of anything that is predicted can therefore differ by
more than this part.

Shapes: m samples, k moving joints, e uncertain transmission coefficients, r columns of the square root.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from .. import se3
from .._frozen import frozen
from .._kernels import lapack
from .._kernels.types import FrameBatch
from .._typing import Array
from ..robot.chain import Chain, link_frame, twists_in_bodies
from .error_model import ErrorModel
from .information import Information
from .problem import StructuredRows
from .qr import RANK_RTOL

# Largest squared component in undetermined directions for which a variance counts as determined: of a
# parameter, or of the tool [m² or rad²] per unit of those directions.
UNBOUNDED_TOL = 1e-6

# Number of configurations at which the effects of two parameter sets are compared.
N_MATCHING_SAMPLES = 200

# An uncertainty of at most this many columns has no compact form.
MAX_COLUMNS = 120
# Largest relative error of a variance by the compact form.
MAX_ERROR = 2e-3
# Singular values of free frames below this part of the largest one are rounding errors.
FRAME_RTOL = 1e-12


@frozen(eq=False)
class Prediction:
    """Tool poses of a calibrated robot and their covariance.

    Attributes:
        poses: Tool poses in the measuring frame, shape (m, 4, 4).
        covariance: Covariance of the displacement [v, ω] of the tool point in axes of the measuring frame,
            shape (m, 6, 6) [m and rad]; infinite on the diagonal where neither data nor priors determine it.
    """

    poses: Array
    covariance: Array

    @property
    def position_std(self) -> Array:
        """Expected RMS distance from the true position, shape (m,) [m]."""
        return _root_trace(self.covariance[:, :3, :3])

    @property
    def orientation_std(self) -> Array:
        """Expected RMS angle from the true orientation, shape (m,) [rad]."""
        return _root_trace(self.covariance[:, 3:, 3:])


def _root_trace(covariances: Array) -> Array:
    """Compute the roots of the traces of matrices (m, n, n), which are not negative but for rounding."""
    return np.sqrt(np.maximum(np.trace(covariances, axis1=1, axis2=2), 0.0))


class Predictor(Protocol):
    """Calibrated robot with uncertainty: a `Result`, or an `Uncertainty` from a file."""

    @property
    def chain(self) -> Chain:
        """Calibrated chain."""
        ...

    @property
    def has_free_frames(self) -> bool:
        """Whether the measurements leave the pose of base or tool free, at least in part."""
        ...

    @property
    def relative(self) -> Uncertainty:
        """Uncertainty relative to the base and tool poses that fit the measured configurations best."""
        ...

    def predict(self, q: Array) -> Prediction:
        """Predict tool poses and their covariance."""
        ...


# Negative logarithm of the probability of a change that is no chance.
MAX_LOG_P = 14


@frozen
class FamilyGain:
    """What a family of joint errors that a model lacks would explain of the residuals."""

    gain: float  #: Decrease of the cost, relative to the variance of what remains; like χ² with `added`
    added: int  #: Number of its parameters
    remaining: int  #: Number of rows less the number of all parameters

    @property
    def ratio(self) -> float:
        """Ratio of the residuals with the family to those without it."""
        return float(np.sqrt((self.remaining + self.added) / (self.remaining + self.gain)))

    @property
    def is_significant(self) -> bool:
        """Whether chance causes such a change of the cost less than once in a million fits."""
        # P(χ²_q > q + 2·sqrt(q·t) + 2·t) <= exp(-t) (Laurent and Massart 2000).
        return self.gain > self.added + 2 * np.sqrt(MAX_LOG_P * self.added) + 2 * MAX_LOG_P


@frozen
class ModelFit:
    """How well a model explains the measurements that it was fitted to."""

    # Sum of the squared residuals in stated standard deviations of the instrument; None if they are not
    # stated.
    chi_square: float | None
    freedom: float  # Degrees of freedom of the residuals
    # Families of joint errors that the model lacks, by name, and what they would explain.
    gains: Mapping[str, FamilyGain]
    # Standard deviation of the residuals per axis, of lengths [m] and of angles [rad]; None if not known.
    residual_std: tuple[float, float] | None = None


def link_twists(chain: Chain, frames: FrameBatch) -> Array:
    """Compute the tool twist per unit of each body twist of base link and links, (6(k+1), 6, m)."""
    n_bodies = len(chain.moving_joints) + 1
    carry = np.tile(np.eye(4), (n_bodies, 1, 1))
    carry[0] = se3.inverse(chain.base)
    error_frames = np.repeat([link_frame(j) for j in range(n_bodies)], 6)
    unit_twists = np.tile(np.eye(6), (n_bodies, 1))
    bodies, twists = twists_in_bodies(chain, error_frames, unit_twists, carry.repeat(6, 0))
    return chain.tool_jacobian(frames, bodies, twists)


@frozen(eq=False)
class Uncertainty:
    """Calibrated chain and the covariance of its errors.

    The rows of the square root are the twists [v, ω] of bodies 0 to k, then the e uncertain transmission
    coefficients. Body 0, the base link, counts in axes of the measuring frame; the other bodies count in
    their own link frames.
    """

    chain: Chain  #: Calibrated chain
    entries: Array  #: Indices of the uncertain coefficients in the flattened transmission, shape (e,)
    sqrt_covariance: Array  #: Square root of the covariance, shape (6(k+1)+e, r)
    unbounded_directions: Array  #: Directions that neither data nor priors determine, shape (6(k+1)+e, h)
    temperature: float = 1.0  #: Factor on the variance of correlated residuals that the covariance contains
    #: Standard deviation of the errors that the model lacks, per axis, of the position [m] and of the
    #: orientation [rad] of the tool.
    model_std: tuple[float, float] = (0.0, 0.0)
    #: Part of the square root and of the unbounded directions, shape (6(k+1)+e, r+h), that is only another
    #: pose of a base or tool that the measurements leave free, see `frame_gauge`; shape (0, 0) if they leave
    #: none free.
    frame_part: Array = field(default_factory=lambda: np.empty((0, 0)))
    #: Information that the covariance follows from; None if it is not known.
    information: Information | None = None
    #: How well the calibrated model explains its measurements; None if it is not known.
    fit: ModelFit | None = None

    @property
    def has_free_frames(self) -> bool:
        """Whether the measurements leave the pose of base or tool free, at least in part."""
        return bool(self.frame_part.size)

    @property
    def relative(self) -> Uncertainty:
        """Uncertainty relative to the base and tool poses that fit the measured configurations best."""
        if not self.has_free_frames:
            return self
        parts = np.split(self.frame_part, [self.sqrt_covariance.shape[1]], axis=1)
        return replace(
            self,
            sqrt_covariance=self.sqrt_covariance - parts[0],
            unbounded_directions=self.unbounded_directions - parts[1],
            frame_part=np.empty((0, 0)),
            information=None,
        )

    @classmethod
    def from_errors(
        cls,
        errors: ErrorModel,
        x: Array,
        chain: Chain,
        sqrt_covariance: Array,
        unbounded_directions: Array,
        temperature: float = 1.0,
        model_std: tuple[float, float] = (0.0, 0.0),
    ) -> Uncertainty:
        """Transform the covariance of identified parameters x to that of the calibrated chain."""
        _, bodies, twists = errors.derivative(x)
        n_bodies = len(chain.moving_joints) + 1
        entries = bodies[bodies >= n_bodies] - n_bodies
        n_geometric = len(bodies) - len(entries)
        # From body frames, whose z axes are the joint axes, to link frames and the measuring frame.
        link_from_body = se3.adjoint(np.concatenate([chain.base[None], chain.axis_frames[1:]]))
        body_twists = np.zeros((n_bodies, 6, len(bodies)))
        body_twists[bodies[:n_geometric], :, np.arange(n_geometric)] = np.einsum(
            "pij,pj->pi", link_from_body[bodies[:n_geometric]], twists[:n_geometric]
        )
        rows = np.concatenate([body_twists.reshape(6 * n_bodies, -1), np.eye(len(bodies))[n_geometric:]])
        return cls(
            chain, entries, rows @ sqrt_covariance, rows @ unbounded_directions, temperature, model_std
        )

    def of_parameters(self, errors: ErrorModel, scale: Array) -> tuple[Array, Array]:
        """Compute the covariance of further parameters of the calibrated chain, matched by their effects."""
        # Effects shared by several parameters are distributed in proportion to `scale`; effects outside the
        # parameters' span are projected onto it.
        q = np.random.default_rng(0).uniform(-np.pi, np.pi, (N_MATCHING_SAMPLES, self.chain.n_joints))
        chain, bodies, twists = errors.derivative(np.zeros(len(scale)))
        effects = chain.tool_jacobian(chain.forward_kinematics(q), bodies, twists) * scale[:, None, None]
        inverse = np.linalg.pinv(effects.reshape(len(scale), -1).T, rcond=RANK_RTOL)
        frames = self.chain.forward_kinematics(q)
        root, undetermined = (
            inverse @ self.tool_twists(frames, part).transpose(1, 0, 2).reshape(inverse.shape[1], -1)
            for part in (self.sqrt_covariance, self.unbounded_directions)
        )
        return root, undetermined

    def tool_twists(self, frames: FrameBatch, directions: Array) -> Array:
        """Compute the tool twists of directions in body twists and coefficients."""
        chain, twists = self.chain, link_twists(self.chain, frames)
        out = np.tensordot(twists, directions[: len(twists)], (0, 0))
        out = out.swapaxes(0, 1)
        if not len(self.entries):
            return out
        # All coefficients of a motion share its twist.
        joints, terms = chain.transmission_terms(frames, self.entries)
        by_joint = chain.motions(frames, joints)
        angles = np.zeros((len(out), len(by_joint), directions.shape[1]))
        for joint in set(joints):
            moving = np.flatnonzero(np.array(joints) == joint)
            angles[:, joint] = np.stack([terms[i] for i in moving], 1) @ directions[len(twists) + moving]
        out += by_joint.transpose(2, 1, 0) @ angles
        return out

    @cached_property
    def _shared_and_own(self) -> tuple[Array, Array]:
        """Directions (6(k+1)+e, s) that move bodies, and the covariance (e, e) of the coefficients alone."""
        # An orthogonal transformation of the columns of the square root separates the columns that all bodies
        # have in common, of which there are at most 6(k+1), from those of the coefficients alone.
        bodies, coefficients = np.split(self.sqrt_covariance, [len(self.sqrt_covariance) - len(self.entries)])
        basis, factor = np.linalg.qr(bodies.T)
        shared = coefficients @ basis
        own = coefficients - shared @ basis.T
        return np.concatenate([factor.T, shared]), own @ own.T

    def predict(self, q: Array) -> Prediction:
        """Predict tool poses and their covariance."""
        frames = self.chain.forward_kinematics(q)
        shared, own = self._shared_and_own
        root, undetermined = (self.tool_twists(frames, part) for part in (shared, self.unbounded_directions))
        covariance = root @ np.swapaxes(root, 1, 2) + np.diag(np.repeat(np.square(self.model_std), 3))
        if len(self.entries):
            joints, terms = self.chain.transmission_terms(frames, self.entries)
            motions = self.chain.motions(frames, joints)
            no_columns = np.zeros((1, *motions.shape[1:]))
            covariance += StructuredRows.of(no_columns, motions, joints, terms, 0).covariances(own)
        samples, components = np.nonzero(np.sum(undetermined**2, -1) > UNBOUNDED_TOL)
        covariance[samples, components, components] = np.inf
        return Prediction(frames.poses(), covariance)


# --- compact form for files -----------------------------------------------------------------------


def compact(known: Uncertainty) -> Information | None:
    """Return the compact form of an uncertainty; None if it is small or there is no shorter form."""
    exact = known.information
    if exact is None or known.sqrt_covariance.shape[1] <= MAX_COLUMNS or known.unbounded_directions.shape[1]:
        return None
    if not exact.root.size:
        return exact
    root = np.linalg.qr(exact.root.T, mode="r").T
    right = lapack.dtrmm(1.0, root, _information_matrix(exact, known), side=1, lower=1)
    difference = lapack.dtrmm(1.0, root, right, trans_a=1, lower=1)
    difference.flat[:: len(root) + 1] -= 1.0
    parts = [np.empty((len(root), 0))] * 2
    if np.linalg.norm(difference) > MAX_ERROR:
        values, axes = np.linalg.eigh(difference)
        directions = lapack.dtrtrs(root, axes * np.sqrt(np.abs(values)), trans=1, lower=1)[0]
        parts = [directions[:, sign * values > MAX_ERROR].astype(np.float32) for sign in (-1, 1)]
    if 2 * sum(part.shape[1] for part in parts) > len(root):
        return None
    found = replace(exact, added=parts[0], removed=parts[1])
    if not known.has_free_frames:
        return found
    u, s, vt = np.linalg.svd(known.frame_part, full_matrices=False)
    count = int(np.sum(s > FRAME_RTOL * s[0]))
    coordinates = np.linalg.lstsq(exact.root.T, vt[:count].T * s[:count], rcond=None)[0]
    return replace(found, gauge=u[:, :count], coordinates=coordinates)


def expand(found: Information, known: Uncertainty) -> Uncertainty | None:
    """Return an uncertainty without columns with those of its compact form; None if they are not finite."""
    matrix = _information_matrix(found, known)
    matrix += found.added @ found.added.T - found.removed @ found.removed.T
    scale = np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
    upper, info = lapack.dpotrf((matrix / scale / scale[:, None]).T)
    if info:
        return None
    root = lapack.dtrtri(upper)[0] / scale[:, None]
    n_geometric = found.geometry.shape[1]
    columns = np.concatenate([found.geometry @ root[:n_geometric], root[n_geometric:]])
    if not np.isfinite(columns).all():
        return None
    known = replace(known, sqrt_covariance=columns, information=found)
    return (
        replace(known, frame_part=found.gauge @ (found.coordinates.T @ root)) if found.gauge.size else known
    )


def _information_matrix(information: Information, known: Uncertainty) -> Array:
    """Compute the information of samples and priors about the parameters, (p, p)."""
    chain, samples, n_geometric = known.chain, information.samples, information.geometry.shape[1]
    frames = chain.forward_kinematics(samples.conditions)
    # A column of zeros takes the place of the residuals.
    directions = np.zeros((len(information.geometry) + len(known.entries), n_geometric + 1))
    directions[: len(information.geometry), :-1] = information.geometry
    dense = samples.rows(known.tool_twists(frames, directions).transpose(2, 1, 0))
    numbers, terms = chain.transmission_terms(frames, known.entries) if len(known.entries) else ([], [])
    motions = samples.rows(chain.motions(frames, numbers))
    rows = StructuredRows.of(dense, motions, numbers, terms, n_geometric)
    products = information.factor * rows.products()[:-1, :-1]
    products.flat[:: len(products) + 1] += information.prior**2
    return products
