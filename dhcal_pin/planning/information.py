"""What measuring would tell: the information of readings not yet taken, and the errors that remain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from .._typing import Array
from ..calibration.procedure import calibrate
from ..estimation import qr
from ..estimation.error_model import ErrorModel
from ..estimation.parameters import PARAMETER_SETS, select_parameters
from ..estimation.priors import Priors, prior_weights
from ..estimation.problem import linearize_and_factor
from ..estimation.uncertainty import Uncertainty
from ..exceptions import DhcalError
from ..measurements import KINDS
from ..measurements.base import Measurement, Noise, whitened_jacobian
from ..robot.chain import Chain
from .exchange import sqrt_covariance

# The unknowns of an instrument are placed as if it were to read so many configurations.
_N_PLACEMENT_SAMPLES = 200


# What no model holds of a joint, from pose to pose: a gear of an arcminute, and as little on a slide.
JOINT_SCATTER = Noise(5e-5, np.deg2rad(1 / 60))


# A share of the largest standard deviation that is none, but rounding.
ZERO_STD_RTOL = 1e-9


@dataclass(frozen=True, eq=False)
class Information:
    """What would be known after measuring at any configurations, to first order about the model at hand.

    The unknowns are the p errors of the robot, then those of instruments, each in units of its prior's sigma.

    Attributes:
        errors: the robot's unknowns.
        x: (p,) their values so far.
        kind: of measurement.
        noise: its sigmas.
        instrument_values: (s,) values of the kind's unknowns.
        instrument_columns: (s,) where those stand among all unknowns; -1 for one that is known.
        prior_sigma: (p+s',) sigmas of the priors, m and rad.
        prior_factor: (p+s', p+s') triangle of priors and data so far.
        data_factor: (p+s', p+s') or (0, p+s') triangle of the data alone.
        fitted: (p+s',) which unknowns a fit will find; it takes the others for zero.
    """

    errors: ErrorModel
    x: Array
    kind: type[Measurement]
    noise: Noise
    instrument_values: Array
    instrument_columns: Array
    prior_sigma: Array
    prior_factor: Array
    data_factor: Array
    fitted: Array

    @cached_property
    def _derivative(self) -> tuple[Chain, Array, Array]:
        return self.errors.derivative(self.x)

    @property
    def chain(self) -> Chain:
        """The robot as far as it is known."""
        return self._derivative[0]

    def rows(self, q: Array) -> Array:
        """Whitened rows (p+s', k, m) of readings at joint values q (m, n)."""
        chain, bodies, twists = self._derivative
        data = self.kind.simulate(chain, q, self.noise, np.random.default_rng(0))
        frames = chain.forward_kinematics(q)
        velocities = chain.tool_jacobian(frames, bodies, twists)
        whitened = whitened_jacobian(
            data, frames, velocities, self.instrument_values, data.residual(frames, self.instrument_values)
        )
        out = np.zeros((len(self.prior_sigma), *whitened.shape[1:]))
        out[: len(whitened)] = whitened
        free = self.instrument_columns >= 0
        out[self.instrument_columns[free]] = data.instrument_jacobian(frames, self.instrument_values)[free]
        return out * self.prior_sigma[:, None, None]

    def task(self, q: Array) -> Array:
        """Combinations (p+s', w) whose variances add up to the mean squared position error at q, m²."""
        chain, bodies, twists = self._derivative
        velocities = chain.tool_jacobian(chain.forward_kinematics(q), bodies, twists)[:, :3]
        out = np.zeros((len(self.prior_sigma), 3 * len(q)))
        out[: len(velocities)] = velocities.reshape(len(velocities), -1)
        return np.asarray(np.linalg.qr((out * self.prior_sigma[:, None]).T / np.sqrt(len(q)), mode="r")).T

    def without_omitted(self) -> Information:
        """The same without what a fit will leave out."""
        kept, robot = self.fitted, len(self.x)
        found = [p for p, fitted in zip(self.errors.parameters, kept[:robot], strict=True) if fitted]
        places = np.where(self.instrument_columns < 0, -1, np.cumsum(kept)[self.instrument_columns] - 1)
        return replace(
            self,
            errors=replace(self.errors, parameters=tuple(found)),
            x=self.x[kept[:robot]],
            instrument_columns=places,
            prior_sigma=self.prior_sigma[kept],
            prior_factor=np.asarray(np.linalg.qr(self.prior_factor[:, kept], mode="r")),
            data_factor=self.data_factor[:, kept],
            fitted=kept[kept],
        )

    def observable_directions(self, rows: Array) -> Array:
        """Orthonormal directions (r, p+s') that data so far and further rows (n, k, p+s') see."""
        every = np.concatenate([self.data_factor, rows.reshape(-1, len(self.prior_sigma))])
        return qr.row_space(np.asarray(np.linalg.qr(every, mode="r")))

    def error(self, rows: Array, task: Array) -> float:
        """Predicted RMS position error in m over a `task`, after readings of rows (n, k, p+s')."""
        return float(np.sqrt(np.sum((task.T @ sqrt_covariance(self.prior_factor, rows)) ** 2)))

    @classmethod
    def from_prior(
        cls,
        chain: Chain,
        q: Array,
        kind: str,
        noise: Noise | None,
        parameters: str | None = None,
        priors: Priors = "default",
        fix: Sequence[str] = (),
        free: Sequence[str] = (),
        data: Sequence[Measurement] = (),
        known: Mapping[str, float] | None = None,
        omitted_sets: Sequence[str] = (),
        prior_uncertainty: Uncertainty | None = None,
    ) -> Information:
        """What is known before measuring: the priors, and what data already taken or a calibration tell.

        Args:
            chain: the nominal robot.
            q: (m, n) joint values of the kind that will be measured.
            kind: of `KINDS`.
            noise: its sigmas; None for those that the data show.
            parameters: what is unknown, as in `calibrate`.
            priors: as in `calibrate`.
            fix: as in `calibrate`.
            free: as in `calibrate`.
            data: readings already taken.
            known: values of instruments' unknowns, as in `calibrate`.
            omitted_sets: sets whose parameters the robot has and a fit will take for zero, as far as it does not
                find them.
            prior_uncertainty: of the calibration that made the chain; it takes the priors' place for what it found.

        Raises:
            DhcalError: the kind's readings hang together, a sigma or a prior is missing.
        """
        maker = _plannable_kind(kind)
        if priors == "none":
            raise DhcalError("a plan needs priors; choose default, or sigmas by name")
        errors = select_parameters(
            chain, parameters if parameters is not None else chain.parameters, fix, free
        )
        sigma, x = 1 / prior_weights(errors, priors), np.zeros(len(errors.parameters))
        fit, values = None, dict(known or {})
        if data:
            fit = calibrate(chain, data, parameters, priors=priors, fix=fix, free=free, known=known)
            errors, x = fit.errors, fit.x[: len(x)]
            sigma, values = 1 / fit.problem.weights, values | fit.instruments
            noise = noise or _sigma_of(fit.problem.data, kind)
        if noise is None:
            raise DhcalError(f"no sigma is known of a {kind}; give one, as 0.1mm,0.01deg")
        errors, x, sigma, fitted = _with_sets(errors, x, sigma, omitted_sets)
        there, triangle = {}, np.zeros((0, len(sigma)))
        if fit is not None:
            there = {unknown.name: len(x) + i for i, unknown in enumerate(fit.problem.instrument_parameters)}
            every = np.concatenate([x, fit.x[len(fit.x) - len(there) :]])
            triangle = linearize_and_factor(replace(fit.problem, errors=errors), every, small_angle=False).r
        model = errors.at(x)
        template = maker.simulate(
            model, q[:_N_PLACEMENT_SAMPLES], noise, np.random.default_rng(0)
        ).initialized(model)
        if not template.has_stated_sigma:
            needs = "0.1mm,0.01deg" if "orientation" in maker.residual_groups else "0.1mm"
            raise DhcalError(f"a {kind} needs sigmas above zero, as {needs}")
        places = []
        for unknown in template.instrument_parameters:
            if unknown.name not in values:
                there[unknown.name] = len(sigma)
                sigma, fitted = np.append(sigma, unknown.prior), np.append(fitted, True)
            places.append(there.get(unknown.name, -1))
        taken = np.zeros((len(triangle), len(sigma)))
        taken[:, : triangle.shape[1]] = triangle * sigma[: triangle.shape[1]]
        start = np.concatenate([taken, np.eye(len(sigma))])
        if prior_uncertainty is not None:
            start[len(taken) :, : len(x)] = 0.0
            told = _rows(*prior_uncertainty.of_parameters(errors, sigma[: len(x)]))
            start[len(taken) : len(taken) + len(x), : len(x)] = told
        return cls(
            errors=errors,
            x=x,
            kind=maker,
            noise=noise,
            instrument_values=np.array(
                [values.get(unknown.name, unknown.nominal) for unknown in template.instrument_parameters]
            ),
            instrument_columns=np.array(places, int),
            prior_sigma=sigma,
            prior_factor=np.asarray(np.linalg.qr(start, mode="r")),
            data_factor=taken,
            fitted=fitted,
        )


def _rows(sqrt_covariance: Array, unbounded_directions: Array) -> Array:
    """Rows (p, p) whose information is that of a covariance's root (p, r), in units of the priors.

    Unknowns and directions that a calibration did not look for have no covariance: they keep their prior.

    Args:
        sqrt_covariance: (p, r).
        unbounded_directions: (p, h) directions that nothing told, whose variance is without bounds.
    """
    ways, size, _ = np.linalg.svd(
        np.pad(sqrt_covariance, ((0, 0), (0, max(0, len(sqrt_covariance) - sqrt_covariance.shape[1]))))
    )
    known = size > ZERO_STD_RTOL * size[0]
    rows = ways.T[known] / size[known, None]
    lost = np.linalg.svd(rows @ unbounded_directions, full_matrices=False)
    away = lost[0][:, lost[1] > ZERO_STD_RTOL * np.linalg.norm(rows)]
    return np.concatenate([rows - away @ (away.T @ rows), ways.T[~known]])


def _with_sets(
    errors: ErrorModel, x: Array, sigma: Array, sets: Sequence[str]
) -> tuple[ErrorModel, Array, Array, Array]:
    """With further sets' parameters among the errors: values and sigmas of all unknowns, and which are old.

    Args:
        errors: p unknowns.
        x: (p,) their values.
        sigma: (p+s,) theirs and instruments'.
        sets: names.
    """
    own = {parameter.name: i for i, parameter in enumerate(errors.parameters)}
    more = [p for name in sets for p in PARAMETER_SETS[name](errors.chain) if p.name not in own]
    wide = errors.with_parameters(more)
    at = np.array([own.get(parameter.name, -1) for parameter in wide.parameters])
    priors = np.where(at < 0, wide.priors, sigma[at])
    fitted = np.concatenate([at >= 0, np.full(len(sigma) - len(x), True)])
    return wide, np.where(at < 0, 0.0, x[at]), np.concatenate([priors, sigma[len(x) :]]), fitted


def with_joint_scatter(chain: Chain, q: Array, noise: Noise) -> Noise:
    """Sigmas of readings at joint values q (m, n) by arms whose joints scatter by `JOINTS`, too."""
    errors = select_parameters(chain, "offset")
    model, bodies, twists = errors.derivative(np.zeros(len(errors.parameters)))
    turns = np.array([parameter.unit == "rad" for parameter in errors.parameters])
    sizes = np.where(turns, JOINT_SCATTER.rotation, JOINT_SCATTER.position)
    moved = model.tool_jacobian(model.forward_kinematics(q), bodies, twists) * sizes[:, None, None]
    place, turn = np.sqrt(np.sum(moved**2, 0).reshape(2, 3, -1).mean((1, 2)))
    return Noise(float(np.hypot(noise.position, place)), float(np.hypot(noise.rotation, turn)))


def _plannable_kind(kind: str) -> type[Measurement]:
    """The kind, if its readings stand alone: one configuration each, and no name that ties rows together."""
    alone = [
        name
        for name, kept in KINDS.items()
        if kept.configurations_per_row == 1 and "text" not in kept.columns.values()
    ]
    if kind not in alone:
        raise DhcalError(f"kind {kind!r}: no plan for it; choose from {', '.join(alone)}")
    return KINDS[kind]


def _sigma_of(data: Sequence[Measurement], kind: str) -> Noise | None:
    """The sigmas of data of that kind, as stated or as the fit found them."""
    for item in data:
        if item.kind == kind:
            sigmas = [getattr(item, name, np.zeros(1)) for name in ("sigma", "rotation_sigma")]
            return Noise(*(float(np.sqrt(np.mean(sigma**2))) for sigma in sigmas))
    return None
