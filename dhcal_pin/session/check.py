"""Check of a calibrated robot with a few measurements: is it still calibrated, and if not, what changed?

Hypotheses about n rows of whitened residuals r:

- nothing changed;
- one thing changed: the zero of a joint, the pose of the base, the pose of the tool, all of them together
  (the robot), or one sample is wrong.

With the columns A of a change, its coefficients β with the prior N(0, w²·D²), where D moves the tool by about
1 m, the root S of what the calibration leaves uncertain, and the noise σ,

    r = A·β + ε,    cov(ε) = Σ = σ²·I + S·Sᵀ

the likelihood of a hypothesis is that of r under N(0, Σ + w²·A·D²·Aᵀ), averaged over widths w, and over σ if
the noise is not known. The robot has changed if the mean of the ratios of these likelihoods to that without a
change exceeds a limit. Few robots that did not change exceed it: the limit is a quantile of the mean for
residuals that are drawn from N(0, Σ). The change is named if its share of the sum of all ratios is large.

Changes may be large: the model is linearized again at the estimate of each hypothesis.

If the noise is not known, any one change explains the samples with enough noise, and so does no change. What
either leaves of the residuals is therefore compared with the noise of the calibration. If it is larger, a
second change is looked for, or the answer is `cannot say`: the noise of another instrument may be larger.

The base or the instrument may also have moved during the check, see `slip`.

Reference: R. E. Kass and A. E. Raftery, Bayes Factors, J. American Statistical Association 90, 1995.

Shapes: N samples of k rows, c coefficients of a hypothesis, p columns of the linear model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from .. import se3
from .._frozen import frozen
from .._kernels import apply_observation_matrix
from .._kernels.types import FrameBatch
from .._typing import Array
from ..estimation.error_model import ErrorModel
from ..estimation.initialization import initialize_frames, make_problem
from ..estimation.parameters import base
from ..estimation.uncertainty import Uncertainty, link_twists
from ..exceptions import InvalidArgumentError
from ..formatting import format_quantity, join_names
from ..measurements.base import Measurement, Noise, instrument_values, residual_of
from ..robot.chain import Chain
from ..robot.conditions import CONDITIONS, MAX_RISE, Conditions
from ..robot.error_families import COMPLIANCE, THERMAL
from .causes import Block, Cause, Constant
from .facts import cause_size
from .linear_model import Layout, measures_positions, whitened_rows
from .robot_changes import RobotChanges
from .search import can_have_session
from .slip import RANK_TOL, Fit, Slip, find_slip
from .timeline import order_samples

# Largest share of unchanged robots that are called changed.
MAX_FALSE_ALARMS = 0.001
# Number of sets of residuals that are drawn to find the limit of the evidence.
N_DRAWS = 3000
# Smallest share of the evidence with which a change is named.
MIN_SHARE = 0.75
# Largest number of changes that are named where the samples do not show which of them it is.
N_NAMED = 3
# Share of the evidence from which a change that has the same effect is named, too.
MIN_RIVAL_SHARE = 0.02
# Widths of the prior of a change, as displacements of the tool [m]; an instrument may stand anywhere. Width
# with which a change is estimated.
WIDTHS = 10.0 ** np.arange(-4.0, 1.5, 0.5)
ESTIMATE_WIDTH = 10.0**-0.5
# Factors to the assumed standard deviations of the measurements if these are not known.
NOISE_FACTORS = 10.0 ** np.arange(-3.0, 1.25, 0.25)
# Prior probability of a hypothesis relative to that of one joint; samples share that of one hypothesis.
ROBOT_PRIOR = 0.3
# Displacement per unit of a direction that the calibration did not determine [m or rad].
UNDETERMINED_SIZE = 10.0
# Fewest samples; three positions determine the pose of the base.
MIN_SAMPLES = 4
# Largest number of rows; a check needs few, and their covariance is a full matrix.
MAX_ROWS = 600
# A change is revealed if it is this many times its standard deviation.
REVEALED_RATIO = 5.0
# Displacement of the tool that a check must reveal [m].
DEFAULT_SIZE = 1e-3
# Largest share of the effect of a change that others leave if they have the same effect.
MAX_UNEXPLAINED = 1e-6
# Change of a joint that must have this effect, in standard deviations, to count as visible [rad or m].
LARGEST_CHANGE, MIN_EFFECT = 0.1, 5.0
# Smallest part of the effects of two changes that must remain if they cancel each other. It is 0.001 to 0.003
# for displacements along parallel axes, as the errors of an arm leave them, and 0.2 for other changes.
MIN_SEPARABLE = 0.02
MAX_ITERATIONS = 6
# Largest number of iterations of a fit of the base alone.
MAX_FRAME_ITERATIONS = 20
# Turn of base or tool that is stated beside its motion [rad].
LARGE_TURN = 0.01
# Ratio of what remains of the residuals to the noise that is stated, or to that of the calibration, from
# which on something else changed; smallest noise [m, rad].
MAX_NOISE_RATIO, MIN_NOISE = 1.5, 1e-6
# Difference of chi-square up to which two changes explain the samples equally well.
MAX_EQUAL = 12.0
# Number of standard deviations of the mean square of noise that a motion of the tool may be hidden in.
HIDING_RATIO = 3.0
# Standard deviation of a temperature that is not stated, from the reference of the calibration [K].
TEMPERATURE_STD = MAX_RISE
# Error of the yielding of joints to a payload beyond those of the calibration, as a share of the yielding to
# the excess. A centre of mass that is 80 mm from that of the model makes a tenth in a UR10.
EXTRAPOLATION_ERROR = 0.3
# Step below which a linearization is kept, as a displacement of the tool [m].
STEP_TOL = 1e-6


@frozen(eq=False)
class Hypothesis:
    """Something that may have changed, with what the measurements say of it."""

    kind: str  #: "joint", "base", "tool", "robot" or "sample"
    of: str  #: Name of the joint, place of the sample, or place from which on the base moved; else empty
    share: float  #: Share of its evidence in that of all changes
    size: float  #: Size of the change, signed for a joint, in `unit`; 0 for a robot or a sample
    std: float  #: Standard deviation of the size
    unit: str  #: "m" or "rad"
    revealed: float  #: Smallest displacement of the tool by this change that the check reveals [m]
    imitators: tuple[str, ...] = ()  #: Names of other hypotheses that have every effect of this one
    angle: float = 0.0  #: Turn of base or tool [rad]; 0 for other changes
    angle_std: float = 0.0  #: Standard deviation of the turn [rad]

    @property
    def name(self) -> str:
        """What changed, such as "joint elbow_joint"."""
        return f"{self.kind} {self.of}".strip()

    def to_dict(self) -> dict[str, Any]:
        """Return the hypothesis for a JSON document."""
        return {key: getattr(self, key) for key in ("kind", "of", "size", "std", "unit", "share")} | (
            {"angle": self.angle, "angle_std": self.angle_std} if self.kind in ("base", "tool") else {}
        )


@frozen(eq=False)
class Explained:
    """What one or several changes leave of the residuals."""

    values: Array  # Coefficients of the changes, (c,)
    covariance: Array  # Their covariance, (c, c)
    rms: float  # RMS distance of the measured positions from those of the changed robot [m]
    chi_square: float  # Sum of the squared residuals in units of noise and uncertainty
    p_value: float  # Probability of a larger one if nothing else changed


@frozen(eq=False)
class Recheck:
    """Answer to the question whether a robot is still calibrated."""

    verdict: str  # "ok", "changed" or "cannot say"
    reasons: tuple[str, ...]  # Sentences on it
    # What changed; several if the measurements do not distinguish them. Empty unless `changed`.
    changes: tuple[Hypothesis, ...]
    hypotheses: tuple[Hypothesis, ...]  # All hypotheses, the most likely one first
    log_ratio: float  # Logarithm of the ratio of the likelihoods with and without a change, less its limit
    samples: int  # Number of samples
    residual_rms: float  # RMS distance of the measured positions from those of the robot [m]
    # RMS distance that noise and uncertainty of the calibration explain [m]. The noise is that of the
    # calibration if no other is stated; NaN if neither is known.
    expected_rms: float
    has_several: bool = False  # Whether all of the changes happened, not one of them

    @property
    def what(self) -> str:
        """What changed, such as "joint elbow_joint", "joint shoulder_joint or base" or "base and tool"."""
        return (" and " if self.has_several else " or ").join(each.name for each in self.changes)

    def to_dict(self) -> dict[str, Any]:
        """Return the answer for a JSON document."""
        first = self.changes[0] if self.changes else None
        return {
            "verdict": self.verdict,
            "reasons": list(self.reasons),
            "what": self.what,
            "size": first and first.size,
            "std": first and first.std,
            "unit": first and first.unit,
            "changes": [each.to_dict() for each in self.changes],
            "hypotheses": [each.to_dict() for each in self.hypotheses],
            "log_ratio": self.log_ratio,
            "samples": self.samples,
            "residual_rms_m": self.residual_rms,
            "expected_rms_m": None if np.isnan(self.expected_rms) else self.expected_rms,
        }


def recheck(
    chain: Chain,
    data: Sequence[Measurement],
    uncertainty: Uncertainty | None = None,
    *,
    known: Mapping[str, float] | None = None,
    noise: Noise | None = None,
    size: float = DEFAULT_SIZE,
    payloads: tuple[float, float] | None = None,
) -> Recheck:
    """Check whether a robot is still calibrated, by five to ten positions or poses of its tool."""
    # The noise is that of instrument and robot together [m, rad]; without it, unstated noise of the
    # measurements is estimated. The check must be able to reveal a displacement of the tool by `size` [m].
    # `payloads` are the smallest and the largest payload of the calibration [kg].
    if not can_have_session(data) or not measures_positions(data):
        kinds = ", ".join(dict.fromkeys(item.kind for item in data))
        raise InvalidArgumentError(
            f"recheck: the measurements are of the kind {kinds}; expected position or pose"
        )
    n_rows = sum(item.residual_dim * len(item.rows) for item in data)
    if n_rows > MAX_ROWS:
        raise InvalidArgumentError(
            f"recheck: {n_rows} measured values; expected at most {MAX_ROWS}: five to ten poses suffice, and "
            "more are worth a calibration"
        )
    if noise is not None:
        data = [_with_noise(item, noise) for item in data]
    elif (least := _calibration_noise(uncertainty, data)) is not None:
        # The errors that the model of the arm lacks are in these measurements, too.
        data = [_with_least_noise(item, least) if item.has_stated_sigma else item for item in data]
    # A calibration whose noise is not known does not know its uncertainty either.
    is_known = uncertainty is None or bool(np.isfinite(uncertainty.sqrt_covariance).all())
    model = _CheckModel(chain, tuple(data), uncertainty if is_known else None, known or {}, payloads)
    if not is_known or not model.parts or model.position_rms()[1] > LARGEST_CHANGE:
        return _without_answer(model)
    return _answer(model, *model.judged(), size)


def find_excess_error(
    chain: Chain,
    data: Sequence[Measurement],
    uncertainty: Uncertainty,
    *,
    known: Mapping[str, float] | None = None,
    payloads: tuple[float, float] | None = None,
) -> tuple[float, float] | None:
    """Return the RMS error of positions and that of the calibration [m] if the first is clearly larger."""
    if not can_have_session(data) or not measures_positions(data):
        return None
    if (noise := _calibration_noise(uncertainty, data)) is None:
        return None
    step = -(-sum(item.residual_dim * len(item.rows) for item in data) // MAX_ROWS)
    thinned = [_with_least_noise(item.take(np.s_[::step]), noise) for item in data]
    model = _CheckModel(chain, tuple(thinned), uncertainty, known or {}, payloads)
    if model.numbers[-1] + 1 < MIN_SAMPLES or model.unchanged_p_value() >= MAX_FALSE_ALARMS:
        return None
    rms, expected = model.position_rms()
    return (rms, expected) if rms > MAX_NOISE_RATIO * expected else None


def _calibration_noise(uncertainty: Uncertainty | None, data: Sequence[Measurement]) -> Noise | None:
    """Return the noise of a calibration; None if it is not known for all that is measured."""
    stated = uncertainty.fit.residual_std if uncertainty and uncertainty.fit else None
    if stated is None or not stated[0]:
        return None
    if not stated[1] and any(hasattr(item, "rotation_sigma") for item in data):
        return None
    return Noise(*(max(each, MIN_NOISE) for each in stated))


def _with_least_noise(item: Measurement, noise: Noise) -> Measurement:
    """Return a measurement with its stated standard deviations, but no smaller ones than those of a noise."""
    least = _with_noise(item, noise)
    if not item.has_stated_sigma:
        return least
    names = [name for name in ("sigma", "rotation_sigma") if hasattr(item, name)]
    return item.replace(**{name: np.maximum(getattr(item, name), getattr(least, name)) for name in names})


def _with_noise(item: Measurement, noise: Noise) -> Measurement:
    """Return a measurement with other standard deviations."""
    values = {"sigma": np.full_like(item.sigma, noise.position), "has_stated_sigma": True}
    if hasattr(item, "rotation_sigma"):
        values["rotation_sigma"] = np.full_like(item.sigma, noise.rotation)
    return item.replace(**values)


class _CheckModel:
    """Whitened model of a few measurements of a calibrated robot."""

    def __init__(
        self,
        chain: Chain,
        data: tuple[Measurement, ...],
        uncertainty: Uncertainty | None,
        known: Mapping[str, float],
        payloads: tuple[float, float] | None = None,
    ):
        """Linearize the model at the calibrated robot."""
        self.chain, self.data = chain, data
        self.uncertainty, self.known, self.payloads = uncertainty, known, payloads
        self.problem = make_problem(ErrorModel(chain, ()), data, np.zeros(0), known)
        self.layout = Layout.of(self.problem)
        self.x = np.zeros(len(self.problem.instrument_parameters))
        width = max(item.residual_dim for item in data)
        counts = [(len(item.rows), item.residual_dim) for item in data]
        self.is_row = np.concatenate([np.tile(np.arange(width) < dim, (m, 1)) for m, dim in counts]).ravel()
        self.numbers = np.repeat(np.arange(len(self.is_row) // width), width)[self.is_row]
        self.noise_factors = np.ones(1) if all(i.has_stated_sigma for i in data) else NOISE_FACTORS
        root = self._root(uncertainty)
        # Coordinates in which the covariance is diagonal for every noise.
        values, self.axes = np.linalg.eigh(root @ root.T)
        self.variances = np.maximum(values, 0.0)[None] + self.noise_factors[:, None] ** 2

    @cached_property
    def rows(self) -> Array:
        """Whitened rows at the calibrated robot, (n, p)."""
        return self._linearize(np.zeros(self.layout.n_columns))

    def _linearize(self, changes: Array) -> Array:
        """Return the whitened rows with the changes (p,) of some columns, (n, p)."""
        data = [self._changed(item, changes) for item in self.data]
        rates = np.zeros((len(set(self.numbers.tolist())), self.chain.n_joints))
        rows = whitened_rows(self.layout, self.x, data, rates)
        return rows.reshape(-1, rows.shape[-1])[self.is_row]

    def _changed(self, item: Measurement, changes: Array) -> Measurement:
        """Return samples whose conditions contain changes."""
        moved, tool = (se3.exp6(changes[self._block(kind).columns]) for kind in ("base", "tool"))
        moved = self.chain.base @ moved @ se3.inverse(self.chain.base)
        m = len(item.rows)
        known = item.recorded or Conditions(item.q)
        return item.replace(
            recorded=replace(
                known,
                base_motion=np.tile(moved, (m, 1, 1)),
                tool_motion=np.tile(tool, (m, 1, 1)),
                zeros=np.tile(changes[self.layout.joints], (m, 1)),
            )
        )

    def _block(self, kind: str) -> Block:
        """Return the block of base or tool."""
        return next(block for block in self.layout.blocks if block.kind == kind)

    def _root(self, uncertainty: Uncertainty | None) -> Array:
        """Return the root of the whitened covariance of what calibration and samples leave open, (n, ·)."""
        shared, own = [], []
        for item in self.data:
            # Unknown directions, and errors that the model lacks, differ from sample to sample. An unknown
            # temperature or payload may be that of all samples, or differ.
            conditions = self._unknown_conditions(item)
            common, parts = [conditions.reshape(-1, conditions.shape[2])], [conditions]
            parts += [self._unknown_directions(item), self._extrapolated_yielding(item)]
            if uncertainty is not None:
                uncertain, model = self._uncertain_rows(item, uncertainty)
                common.append(uncertain)
                parts.append(model)
            shared.append(np.concatenate(common, 1))
            own += list(np.concatenate(parts, 2))
        from scipy.linalg import block_diag  # lazy import: slow

        return np.concatenate([np.concatenate(shared), np.asarray(block_diag(*own))], 1)

    def _uncertain_rows(self, item: Measurement, uncertainty: Uncertainty) -> tuple[Array, Array]:
        """Return the whitened effects of uncertain parameters, (m·k, ·), and of model errors, (m, k, 6)."""
        directions = np.concatenate(
            [uncertainty.sqrt_covariance, UNDETERMINED_SIZE * uncertainty.unbounded_directions], 1
        )
        frames, m = self.chain.forward_kinematics(item.conditions()), len(item.rows)
        motions = uncertainty.tool_twists(frames, directions).transpose(2, 1, 0)
        model_std = np.tile(np.diag(np.repeat(uncertainty.model_std, 3))[..., None], m)
        parameters, model = (self._observed(item, frames, each) for each in (motions, model_std))
        return parameters.reshape(-1, len(motions)), model

    def _observed(self, item: Measurement, frames: FrameBatch, motions: Array) -> Array:
        """Return the whitened effects (m, k, c) of twists (c, 6, m) of the tool."""
        u = instrument_values(item, self.problem.instruments(self.x))
        observation = item.observation_matrix(frames, u, item.residual(frames, u))
        out = np.zeros((len(motions), item.residual_dim, motions.shape[2]))
        apply_observation_matrix(np.ascontiguousarray(motions), observation, out)
        return out.transpose(2, 1, 0)

    @cached_property
    def origins(self) -> list[Array]:
        """Whitened effects of a motion of the origin of each joint but the first one, (n, 6) each."""
        rows = []
        for item in self.data:
            frames = self.chain.forward_kinematics(item.conditions())
            effects = self._observed(item, frames, link_twists(self.chain, frames))
            rows.append(effects.reshape(-1, effects.shape[2]))
        # The origin of the first joint moves with the base, and the last link with the tool.
        return np.split(np.concatenate(rows), len(self.chain.moving_joints) + 1, axis=1)[1:-1]

    def _unknown_directions(self, item: Measurement) -> Array:
        """Return the whitened effects of the backlash of joints whose direction is unknown, (m, k, n)."""
        if not self.has_backlash:
            return np.zeros((len(item.rows), item.residual_dim, 0))
        known = item.recorded or Conditions(item.q)
        approach = np.zeros(item.q.shape) if known.approach is None else known.approach
        joints = np.eye(self.chain.n_joints)
        moved = [self._residual(item, approach=np.where(approach == 0, joint, approach)) for joint in joints]
        return (np.stack(moved, 2) - self._residual(item, approach=approach)[..., None]).swapaxes(0, 1)

    def _unknown_conditions(self, item: Measurement) -> Array:
        """Return the whitened effects of temperature and payload where they are unknown, (m, k, 2)."""
        out = np.zeros((len(item.rows), item.residual_dim, 2))
        for i, (name, (value, std)) in enumerate(self._condition_spreads.items()):
            if self.is_unknown(item, name):
                moved, at = (
                    self._residual(item, **{name: np.full(len(item.rows), each)})
                    for each in (value + std, value)
                )
                out[..., i] = (moved - at).T
        return out

    def _extrapolated_yielding(self, item: Measurement) -> Array:
        """Return the whitened errors (m, k, 6) of the yielding to what exceeds the calibrated payloads."""
        conditions = item.conditions()
        if (mass := conditions.payload) is None or not self._is_extrapolated(item):
            return np.zeros((len(item.rows), item.residual_dim, 0))
        calibrated = np.clip(mass, *self.calibrated_payloads)
        known = replace(conditions, payload=calibrated)
        moved = se3.inverse(self.chain.poses(known)) @ self.chain.poses(conditions)
        # Of the size that all samples with such a payload have on average: the centre may be another one.
        is_beyond = mass != calibrated
        sizes = [se3.rms_length(part) for part in np.split(se3.log6(moved)[is_beyond], 2, axis=1)]
        errors = np.diag(EXTRAPOLATION_ERROR * np.repeat(sizes, 3))[..., None] * is_beyond
        return self._observed(item, self.chain.forward_kinematics(conditions), errors)

    def _is_extrapolated(self, item: Measurement) -> bool:
        """Return whether a payload, to which the joints yield, is beyond those of the calibration."""
        mass, (low, high) = item.conditions().payload, self.calibrated_payloads
        is_elastic = COMPLIANCE in {family.name for family in self.chain.error_families}
        return is_elastic and mass is not None and bool(np.any((mass < low) | (mass > high)))

    @property
    def has_extrapolated_payloads(self) -> bool:
        """Whether a payload, to which the joints yield, is beyond those of the calibration."""
        return any(self._is_extrapolated(item) for item in self.data)

    @property
    def calibrated_payloads(self) -> tuple[float, float]:
        """Smallest and largest payload of the calibration [kg]."""
        mass = self.chain.payload.mass if self.chain.payload else 0.0
        return self.payloads or (mass, mass)

    def is_unknown(self, item: Measurement, condition: str) -> bool:
        """Return whether a condition of samples, on which the positions of the robot depend, is unknown."""
        known = item.recorded.names if item.recorded else ()
        return self._condition_spreads[condition][1] > 0 and condition not in known

    @cached_property
    def _condition_spreads(self) -> dict[str, tuple[float, float]]:
        """Value of each condition with which the robot is modelled where it is unknown, and its spread."""
        families = {family.name for family in self.chain.error_families}
        mass = self.chain.payload.mass if self.chain.payload else 0.0
        low, high = self.calibrated_payloads
        # A uniform distribution has the standard deviation of its width by √12.
        spread = np.hypot((high - low) / np.sqrt(12), (low + high) / 2 - mass) if high > low else 0.0
        return {
            "temperature": (
                self.chain.reference_temperature,
                TEMPERATURE_STD if THERMAL in families else 0.0,
            ),
            "payload": (mass, float(spread) if COMPLIANCE in families else 0.0),
        }

    def _residual(self, item: Measurement, **conditions: Array) -> Array:
        """Return the whitened residual with other conditions, (k, m)."""
        other = item.replace(recorded=replace(item.recorded or Conditions(item.q), **conditions))
        return residual_of(other, self.chain, self.problem.instruments(self.x))

    @property
    def unknown_columns(self) -> list[str]:
        """Columns of conditions that are not stated, and that the positions of the robot depend on."""
        names = [n for n in self._condition_spreads if any(self.is_unknown(item, n) for item in self.data)]
        return [CONDITIONS[name].header for name in names]

    @property
    def has_backlash(self) -> bool:
        """Whether the positions of the robot depend on the directions in which its joints moved."""
        return any(family.condition == "approach" for family in self.chain.error_families)

    # ------------------------------------------------------------------------------------------- hypotheses
    @cached_property
    def parts(self) -> list[Block]:
        """Blocks of columns of single parts that may change, without those whose changes do not show."""
        found = [b for b in self.layout.blocks if b.kind in ("joint", "base", "tool")]
        effects = np.linalg.norm(self._scaled(self.rows, self.usual_noise), axis=0) * LARGEST_CHANGE
        seen = [replace(b, sizes=np.where(effects[b.columns] > MIN_EFFECT, b.sizes, 0.0)) for b in found]
        return [b for b in seen if b.sizes.any()]

    @cached_property
    def blocks(self) -> list[Block]:
        """Blocks of columns that may change together: those of the parts, and of the whole robot."""
        columns, sizes = (
            np.concatenate([getattr(b, key) for b in self.parts]) for key in ("columns", "sizes")
        )
        return [*self.parts, Block("robot", "", columns, sizes)]

    @property
    def hidden_joints(self) -> list[str]:
        """Joints whose zeros do not move what is measured."""
        seen = {block.of for block in self.parts}
        return [name for name in self.chain.joint_names if name not in seen]

    @property
    def usual_noise(self) -> int:
        """Index of the stated noise, or of the middle of the noises that are possible."""
        return len(self.noise_factors) // 2

    @cached_property
    def likely_noise(self) -> int:
        """Index of the most likely noise without a change."""
        return int(self.null_likelihoods(self.scaled_sets(self.rows[:, -1:]))[:, 0].argmax())

    def _scaled(self, rows: Array, factor: int) -> Array:
        """Return rows in coordinates of unit variance for one of the noises."""
        return (self.axes.T @ rows) / np.sqrt(self.variances[factor])[:, None]

    def scaled_sets(self, residuals: Array) -> list[Array]:
        """Return d residuals (n, d) in coordinates of unit variance for each noise."""
        turned = self.axes.T @ residuals
        return [turned / np.sqrt(each)[:, None] for each in self.variances]

    def log_likelihoods(self, columns: Array, sets: Sequence[Array], nothing: Array) -> Array:
        """Return the log likelihood of d scaled residuals for each noise and width, (σ, w, d)."""
        # `nothing` has those without a change, (σ, d).
        square = WIDTHS[:, None] ** 2
        out = np.empty((len(sets), len(WIDTHS), sets[0].shape[1]))
        for i, (a, r) in enumerate(zip(self.scaled_sets(columns), sets, strict=True)):
            values, vectors = np.linalg.eigh(a.T @ a)
            values = np.maximum(values, 0.0)
            along = (vectors.T @ a.T) @ r
            gain = square / (1 + square * values)
            out[i] = nothing[i] + 0.5 * (gain @ along**2 - np.sum(np.log1p(square * values), 1)[:, None])
        return out

    def null_likelihoods(self, sets: Sequence[Array]) -> Array:
        """Return the logarithm of the likelihood of d scaled residuals without a change, (σ, d)."""
        logs = np.sum(np.log(self.variances), 1)
        return np.array([-0.5 * (np.sum(r**2, 0) + log) for r, log in zip(sets, logs, strict=True)])

    def limit(self, columns: Sequence[Array], log_priors: Array) -> float:
        """Return the ratio for any change that `MAX_FALSE_ALARMS` of unchanged robots exceed."""
        draws = np.random.default_rng(0).standard_normal((len(self.numbers), N_DRAWS))
        sets = [draws * np.sqrt(self.variances[self.likely_noise] / each)[:, None] for each in self.variances]
        nothing = self.null_likelihoods(sets)
        ratios = np.array([_log_means(self.log_likelihoods(each, sets, nothing)) for each in columns])
        ratios -= _log_means(nothing[:, None])
        return float(np.quantile(_log_sums(ratios + log_priors[:, None]), 1 - MAX_FALSE_ALARMS))

    def estimate(self, block: Block, start: Array | None = None) -> tuple[Array, Array, Array]:
        """Estimate a change, from zero or a start (p,); return coefficients, columns and residual there."""
        changes = np.zeros(self.layout.n_columns) if start is None else start
        rows, sizes = self.rows if start is None else self._linearize(start), block.sizes
        for _ in range(MAX_ITERATIONS):
            scaled = self._scaled(rows, self.usual_noise)
            a = scaled[:, block.columns] * sizes
            prior = np.eye(len(sizes)) / ESTIMATE_WIDTH**2
            held = np.divide(changes[block.columns], sizes, out=np.zeros(len(sizes)), where=sizes > 0)
            step = np.linalg.solve(a.T @ a + prior, a.T @ scaled[:, -1] - prior @ held)
            changes = self._advanced(changes, block, step * sizes)
            rows = self._linearize(changes)
            if np.abs(step).max() < STEP_TOL:
                break
        values = changes[block.columns]
        columns = rows[:, block.columns]
        return values, columns * sizes, rows[:, -1] + columns @ values

    def _estimate_part(self, block: Block) -> tuple[Array, Array, Array]:
        """Estimate a change of one part; that of the base from the best one, too, which may turn far."""
        if block.kind != "base":
            return self.estimate(block)
        errors = ErrorModel(self.chain, tuple(base(self.chain)))
        placed = initialize_frames(errors, self.data, self.known, MAX_FRAME_ITERATIONS).chain
        start = np.zeros(self.layout.n_columns)
        start[block.columns] = se3.log6(se3.inverse(self.chain.base) @ placed.base)
        return min(
            (self.estimate(block), self.estimate(block, start)), key=lambda each: self._cost(block, each)
        )

    def _estimate_robot(
        self, robot: Block, parts: Sequence[Block], estimates: Sequence[tuple[Array, Array, Array]]
    ) -> tuple[Array, Array, Array]:
        """Estimate a change of all parts, from nothing and from large changes of base and tool."""
        found = [self.estimate(robot)]
        for block, (values, *_) in zip(parts, estimates, strict=True):
            if block.kind != "joint":
                start = np.zeros(self.layout.n_columns)
                start[block.columns] = values
                found.append(self.estimate(robot, start))
        return min(found, key=lambda each: self._cost(robot, each))

    def _cost(self, block: Block, estimate: tuple[Array, Array, Array]) -> float:
        """Return the squared residuals and prior of an estimate."""
        values, columns, undone = estimate
        scaled = np.divide(values, block.sizes, out=np.zeros_like(values), where=block.sizes > 0)
        left = self._scaled((undone - columns @ scaled)[:, None], self.usual_noise)
        return float(np.sum(left**2) + np.sum((scaled / ESTIMATE_WIDTH) ** 2))

    def _advanced(self, changes: Array, block: Block, step: Array) -> Array:
        """Return the changes after a step (c,) of a block."""
        full = np.zeros_like(changes)
        full[block.columns] = step
        out = changes + full
        for kind in ("base", "tool"):
            own = self._block(kind).columns
            out[own] = se3.log6(se3.exp6(changes[own]) @ se3.exp6(full[own]))
        return out

    def judged(self) -> tuple[list[Hypothesis], float, float]:
        """Return all hypotheses, the most likely one first, the log ratio for any change, and its limit."""
        values, likelihoods, weights, limit = self._evidence
        total = float(_log_sums(weights[:, None])[0])
        if total > limit:
            weights = self._without_right_samples(weights)
        # What excluded samples explained is no evidence for others.
        shares = np.exp(weights - total)
        hypotheses = [
            self._hypothesis(block, *each, share=float(share))
            for block, *each, share in zip(self.blocks, values, likelihoods, shares, strict=False)
        ]
        places = [(item.source, int(row)) for item in self.data for row in item.rows]
        for (file, line), share in zip(places, shares[len(self.blocks) :], strict=True):
            place = f"in line {line} of {file}" if file else f"{line}"
            hypotheses.append(Hypothesis("sample", place, float(share), 0.0, 0.0, "m", 0.0))
        return sorted(hypotheses, key=lambda each: -each.share), total, limit

    @cached_property
    def _evidence(self) -> tuple[list[Array], list[Array], Array, float]:
        """Values and likelihoods of the changes, log evidence of all hypotheses, and the limit of its sum."""
        # Those of the samples follow those of the blocks.
        blocks, count = self.blocks, self.numbers[-1] + 1
        *parts, robot = blocks
        estimates = [self._estimate_part(block) for block in parts]
        estimates.append(self._estimate_robot(robot, parts, estimates))
        samples = [np.eye(len(self.numbers))[:, self.numbers == i] / self._sigma[i] for i in range(count)]
        priors = [ROBOT_PRIOR if block.kind == "robot" else 1.0 for block in blocks] + [1 / count] * count
        log_priors = np.log(np.array(priors) / np.sum(priors))
        pairs = [*((columns, undone[:, None]) for _, columns, undone in estimates)]
        pairs += [(columns, self.rows[:, -1:]) for columns in samples]
        likelihoods = []
        for columns, residual in pairs:
            sets = self.scaled_sets(residual)
            likelihoods.append(self.log_likelihoods(columns, sets, self.null_likelihoods(sets)))
        nothing = _log_means(self.null_likelihoods(self.scaled_sets(self.rows[:, -1:]))[:, None])
        ratios = np.array([_log_means(each) - nothing for each in likelihoods])[:, 0]
        columns = [*(self.rows[:, block.columns] * block.sizes for block in blocks), *samples]
        limit = self.limit(columns, log_priors)
        return [values for values, *_ in estimates], likelihoods, ratios + log_priors, limit

    def _without_right_samples(self, weights: Array) -> Array:
        """Exclude likely samples without which the others agree neither with the robot nor one change."""
        # Measured again, such a sample is as it was, or another one is blamed.
        out, wrong, n_blocks = weights.copy(), set(), len(self.blocks)
        while True:
            shares = np.exp(out - _log_sums(out[:, None])[0])
            likely = [int(i) for i in np.argsort(-out)[:N_NAMED] if shares[i] > MIN_RIVAL_SHARE]
            suspect = next((i for i in likely if i >= n_blocks and i not in wrong), None)
            if suspect is None:
                return out
            if self._agrees_without(suspect - n_blocks):
                wrong.add(suspect)
            else:
                out[suspect] = -np.inf

    def _agrees_without(self, sample: int) -> bool:
        """Return whether all samples but one agree with the calibrated robot, or with one change of it."""
        stops = np.cumsum([len(item.rows) for item in self.data])
        kept = np.split(np.arange(stops[-1]) != sample, stops[:-1])
        data = [
            item.take(np.flatnonzero(mask)) for item, mask in zip(self.data, kept, strict=True) if mask.any()
        ]
        rest = _CheckModel(self.chain, tuple(data), self.uncertainty, self.known, self.payloads)
        judge = rest.with_known_noise()
        if judge is None:
            *_, weights, limit = rest._evidence
            return bool(_log_sums(weights[:, None])[0] <= limit)
        if judge.unchanged_p_value() >= MAX_FALSE_ALARMS:
            return True
        return stops[-1] > MIN_SAMPLES and any(map(judge.is_changed, judge.parts))

    @cached_property
    def _positions(self) -> tuple[Array, Array]:
        """Numbers of the rows of positions, and their standard deviations [m], (3N,) each."""
        width = len(self.is_row) // (self.numbers[-1] + 1)
        is_position = (np.arange(len(self.is_row)) % width < 3)[self.is_row]
        return np.flatnonzero(is_position), np.concatenate([item.sigma.ravel() for item in self.data])

    def position_rms(self) -> tuple[float, float]:
        """Return the RMS distance of the measured positions from the robot's, and what is expected [m]."""
        (rows, sigma), count = self._positions, self.numbers[-1] + 1
        residual, axes = self.rows[rows, -1] * sigma, self.axes[rows]
        variances = np.einsum("ij,j,ij->i", axes, self.variances[0], axes) * sigma**2
        expected = np.sqrt(variances.sum() / count) if len(self.noise_factors) == 1 else np.nan
        return float(np.sqrt(np.sum(residual**2) / count)), float(expected)

    def hidden_motion(self) -> float:
        """Return the RMS motion of the measured point that the residuals leave room for [m]."""
        (rows, sigma), count = self._positions, self.numbers[-1] + 1
        rms, expected = self.position_rms()
        if np.isnan(expected):
            return rms
        axes = self.axes[rows] * sigma[:, None]
        covariance = (axes * self.variances[0]) @ axes.T
        std = np.sqrt(2 * np.sum(covariance**2)) / count
        return min(rms, float(np.sqrt(max(rms**2 - expected**2, 0.0) + HIDING_RATIO * std)))

    def place(self, sample: int) -> str:
        """Return the line of a sample, or its number if it is from no file."""
        file, line = [(item.source, int(row)) for item in self.data for row in item.rows][sample]
        return f"line {line} of {file}" if file else f"sample {line}"

    def is_changed(self, block: Block) -> bool:
        """Return whether a change of one part explains the residuals."""
        start = np.zeros(self.layout.n_columns)
        start[block.columns] = self._estimate_part(block)[0]
        return self.explained([block], start).p_value >= MAX_FALSE_ALARMS

    def slip(self) -> Slip:
        """Find the sample from which on a base that moved explains the residuals best."""
        *parts, robot = self.blocks
        base_block = self._block("base")
        moved = self.rows[:, base_block.columns]
        others = [self.rows[:, each.columns[each.sizes > 0]] for each in (*parts, robot)]
        pairs = [np.concatenate([moved, each], 1) for each in others]
        rivals = [*others, *pairs, *self.origins]
        return find_slip(moved, self.rows[:, -1], self._whitening, self.numbers, rivals)

    def is_origin(self, chi_square: float) -> bool:
        """Return whether a motion of the origin of one joint explains the residuals as well as chi-square."""
        scaled = self._whitening @ self.rows[:, -1]
        fits = [Fit.of(self._whitening @ columns, scaled) for columns in self.origins]
        return any(
            fit.chi_square < chi_square + MAX_EQUAL
            and _p_value(len(scaled) - fit.rank, fit.chi_square) >= MAX_FALSE_ALARMS
            for fit in fits
        )

    @property
    def _whitening(self) -> Array:
        """Matrix (n, n) that gives rows unit covariance at the usual noise."""
        return self.axes.T / np.sqrt(self.variances[self.usual_noise])[:, None]

    @cached_property
    def _sigma(self) -> Array:
        """Standard deviation of the position of each sample, (N,) [m]."""
        return np.concatenate([item.sigma.mean(1) for item in self.data])

    def _hypothesis(self, block: Block, values: Array, likelihoods: Array, *, share: float) -> Hypothesis:
        """Describe a change."""
        best = int(likelihoods.max((1, 2)).argmax())
        a = self._scaled(self.rows[:, block.columns] * block.sizes, best)
        covariance = np.linalg.pinv(a.T @ a, rcond=1e-12, hermitian=True)
        covariance *= np.outer(block.sizes, block.sizes)
        size, std, unit = 0.0, 0.0, "m"
        if block.kind != "robot":
            size, std, unit = self._size(block, values, covariance)
        imitators = [f"{b.kind} {b.of}".strip() for b in self.blocks if self._has_effects_of(b, block)]
        revealed = self._revealed(block, covariance)
        turn = _turn(block, values, covariance)
        return Hypothesis(block.kind, block.of, share, size, std, unit, revealed, tuple(imitators), *turn)

    def _size(self, block: Block, values: Array, covariance: Array) -> tuple[float, float, str]:
        """Return the size of a change of base, tool or joint, its standard deviation and its unit."""
        cause = Cause(block, Constant(), values, covariance)
        size, std, unit = cause_size(cause, RobotChanges(), self.chain, order_samples(self.data, ()))
        if block.kind == "joint":
            size = float(values[0])
        elif unit == "m":
            size = float(np.linalg.norm(se3.exp6(values)[:3, 3]))
        return size, std, unit

    def unchanged_p_value(self) -> float:
        """Return the probability of larger residuals if nothing changed."""
        chi_square = np.sum(self._scaled(self.rows[:, -1:], self.usual_noise) ** 2)
        return _p_value(len(self.rows), float(chi_square))

    def explained(self, blocks: Sequence[Block], start: Array) -> Explained:
        """Fit several changes, from the values (p,) of the first one, and return what they leave.

        Displacements that hardly differ from none together, as along parallel axes, are left out.
        """
        columns, sizes = (np.concatenate([getattr(b, key) for b in blocks]) for key in ("columns", "sizes"))
        values, effects, undone = self.estimate(Block("robot", "", columns, sizes), start)
        scaled_values = np.divide(values, sizes, out=np.zeros_like(values), where=sizes > 0)
        a = self._scaled(effects, self.usual_noise)
        stops = np.cumsum([len(block.columns) for block in blocks])[:-1]
        inverse, rank = _separable_inverse(np.split(a, stops, axis=1))
        scaled_values = inverse @ (a @ scaled_values)
        left = undone - effects @ scaled_values
        r = self._scaled(left[:, None], self.usual_noise)
        values, covariance = scaled_values * sizes, inverse @ inverse.T * np.outer(sizes, sizes)
        freedom, chi_square = len(left) - rank, float(np.sum(r**2))
        p_value = _p_value(freedom, chi_square)
        rows, sigma = self._positions
        rms = float(np.sqrt(np.sum((left[rows] * sigma) ** 2) / (self.numbers[-1] + 1)))
        return Explained(values, covariance, rms, chi_square, p_value)

    def with_known_noise(self) -> _CheckModel | None:
        """Return a model with the noise of the calibration where none is stated; None if it is not known."""
        if all(item.has_stated_sigma for item in self.data):
            return self
        noise = _calibration_noise(self.uncertainty, self.data)
        if noise is None:
            return None
        data = [item if item.has_stated_sigma else _with_noise(item, noise) for item in self.data]
        return _CheckModel(self.chain, tuple(data), self.uncertainty, self.known, self.payloads)

    def _has_effects_of(self, block: Block, other: Block) -> bool:
        """Return whether a change has all effects of another one."""
        if "robot" in (block.kind, other.kind) or block.columns[0] == other.columns[0]:
            return False
        a, b = (self._scaled(self.rows[:, each.columns] * each.sizes, 0) for each in (block, other))
        left = b - a @ np.linalg.lstsq(a, b, rcond=1e-9)[0]
        return bool(np.sum(left**2) < MAX_UNEXPLAINED * np.sum(b**2))

    def _revealed(self, block: Block, covariance: Array) -> float:
        """Return the displacement of the tool by a change in its worst direction that is revealed [m]."""
        rows, sigma = self._positions
        effects = self.rows[rows][:, block.columns] * sigma[:, None] / np.sqrt(self.numbers[-1] + 1)
        r = np.linalg.qr(effects, mode="r")
        return REVEALED_RATIO * float(np.sqrt(max(np.linalg.eigvalsh(r @ covariance @ r.T).max(), 0.0)))


def _separable_inverse(effects: Sequence[Array]) -> tuple[Array, int]:
    """Return the inverse (c, n) of effects (n, ·) of changes without what they cancel, and its rank."""
    from scipy.linalg import block_diag  # lazy import: slow

    parts = []
    for each in effects:
        u, s, vt = np.linalg.svd(each, full_matrices=False)
        kept = s > RANK_TOL * s.max(initial=0.0)
        parts.append((u[:, kept], vt[kept].T / s[kept]))
    # Singular values of joined orthonormal bases are small in directions in which one cancels the other.
    u, s, vt = np.linalg.svd(np.concatenate([part[0] for part in parts], 1), full_matrices=False)
    kept = s > MIN_SEPARABLE
    inverse = (np.asarray(block_diag(*(part[1] for part in parts))) @ vt[kept].T / s[kept]) @ u[:, kept].T
    return inverse, int(kept.sum())


def _p_value(freedom: int, chi_square: float) -> float:
    """Return the probability of a larger chi-square if the noise is the largest one that is possible."""
    from scipy.special import chdtrc  # lazy import: slow

    return float(chdtrc(freedom, chi_square / MAX_NOISE_RATIO**2)) if freedom > 0 else 1.0


def _log_sums(values: Array) -> Array:
    """Return the logarithms of the sums of exponentials over the first axis."""
    largest = values.max(0)
    return np.log(np.sum(np.exp(values - largest), 0)) + largest


def _log_means(values: Array) -> Array:
    """Return the logarithms of the means of exponentials over the first two axes, (d,)."""
    flat = np.concatenate(values)
    return _log_sums(flat) - np.log(len(flat))


def _without_answer(model: _CheckModel) -> Recheck:
    """Say that no change would show."""
    reason = (
        "The noise and the uncertainty of the calibration are so large that no change would show: calibrate "
        "with more poses, or measure more accurately."
    )
    n_samples, rms = int(model.numbers[-1]) + 1, model.position_rms()
    return Recheck("cannot say", (reason,), (), (), 0.0, n_samples, *rms)


def _answer(
    model: _CheckModel, hypotheses: list[Hypothesis], total: float, limit: float, size: float
) -> Recheck:
    """Decide, and say why."""
    changes: tuple[Hypothesis, ...] = ()
    has_several = False
    best, robot = hypotheses[0], next(each for each in hypotheses if each.kind == "robot")
    group = [
        best,
        *(h for h in hypotheses if h.name in best.imitators),
        *(h for h in hypotheses if best.name in h.imitators and h.share > MIN_RIVAL_SHARE),
    ]
    # A change of all parts contains one of the base. Which of both it is, known noise decides (`_verified`).
    nested = [h for h in hypotheses if h.kind in ("base", "robot")]
    if best in nested and sum(h.share for h in group) < MIN_SHARE <= sum(h.share for h in nested):
        group = [h for h in nested if h.kind == "base"]
    share = sum(h.share for h in (nested if group[0] in nested else group))
    n_samples = int(model.numbers[-1]) + 1
    if n_samples < MIN_SAMPLES:
        verdict, reasons = (
            "cannot say",
            [f"Too few samples: {n_samples}; expected at least {MIN_SAMPLES}."],
        )
    elif total <= limit:
        verdict, reasons = _unchanged(model, hypotheses, size)
    elif best.kind == "sample":
        verdict = "cannot say"
        reasons = [f"The sample {best.of} does not fit to the others; measure it again."]
    elif share < MIN_SHARE and (found := _slipped(model) or _several(model, robot)):
        verdict, reasons, changes, has_several = found
    elif share < MIN_SHARE:
        verdict = "cannot say"
        rivals = ", ".join(f"{each.name} ({100 * each.share:.0f} %)" for each in hypotheses[:N_NAMED])
        reasons = [
            f"Something changed. These samples do not show which of these it is: {rivals}. Measure more "
            "poses, as `dhcal plan --recheck` chooses them."
        ]
    else:
        verdict, reasons, changes, has_several = _verified(model, group, robot)
    if verdict == "cannot say" and (columns := model.unknown_columns):
        reasons = [*reasons, f"State the conditions of the samples: {join_names(columns)}."]
    if verdict == "cannot say" and model.has_extrapolated_payloads:
        low, high = model.calibrated_payloads
        masses = f"{low:g} to {high:g} kg" if low < high else f"{high:g} kg"
        reasons = [*reasons, f"The payload is beyond that of the calibration; measure with {masses}."]
    residual, expected = (model.with_known_noise() or model).position_rms()
    return Recheck(
        verdict,
        tuple(reasons),
        changes,
        tuple(hypotheses),
        total - limit,
        n_samples,
        residual,
        expected,
        has_several,
    )


Finding = tuple[str, list[str], tuple[Hypothesis, ...], bool]


def _verified(model: _CheckModel, group: list[Hypothesis], robot: Hypothesis) -> Finding:
    """Compare what a change leaves of the residuals with the noise; look for a second change if needed."""
    best, judge = group[0], model.with_known_noise()
    unverified = "changed", [_sentence(group)], tuple(group), False
    parts = model.parts
    # Changes of several parts may be those of two: an instrument that was set up anew, and another one.
    first = ("base", "") if best.kind == "robot" else (best.kind, best.of)
    block = next((each for each in parts if (each.kind, each.of) == first), None)
    if judge is None or block is None:
        return unverified
    start = np.zeros(model.layout.n_columns)
    start[block.columns] = model.estimate(block)[0]
    alone = judge.explained([block], start)
    if best.kind != "robot" and alone.p_value >= MAX_FALSE_ALARMS:
        if best.kind == "base":
            unverified[1].append(
                "The arm itself did not change: with the new base the positions differ by "
                f"{_text_of_error(alone.rms)} RMS, as noise and uncertainty explain."
            )
        return unverified
    if slipped := _slipped(judge):
        return slipped
    trials = [(each, judge.explained([block, each], start)) for each in parts if each is not block]
    trials = sorted(
        (pair for pair in trials if pair[1].p_value >= MAX_FALSE_ALARMS), key=lambda pair: pair[1].chi_square
    )
    if judge.is_origin(trials[0][1].chi_square if trials else np.inf):
        return "changed", [_robot_sentence(judge)], (robot,), False
    rivals = [each for each, fit in trials if fit.chi_square < trials[0][1].chi_square + MAX_EQUAL]
    if len(rivals) == 1:
        changes = _both_changes(judge, block, *trials[0])
        return "changed", [_sentence([change]) for change in changes], changes, True
    if best.kind == "robot":
        return "changed", [_robot_sentence(judge)], tuple(group), False
    expected = _text_of_error(judge.position_rms()[1])
    which = [f"These samples do not show which: {_names(rivals)}."] if rivals else []
    reasons = [
        f"{_sentence(group)} Something else changed, too: {_text_of_error(alone.rms)} RMS remain, and noise "
        f"and uncertainty explain {expected}.",
        *which,
        "Measure more poses, as `dhcal plan --recheck` chooses them, or calibrate again.",
    ]
    return "cannot say", reasons, (), False


def _slipped(model: _CheckModel) -> Finding | None:
    """Return the answer if only a base that moved during the check explains the samples."""
    judge = model.with_known_noise()
    if judge is None:
        return None
    slip = judge.slip()
    if not (slip.is_determined and _is_possible(slip) and slip.lead >= MAX_EQUAL):
        return None
    block = next(each for each in judge.blocks if each.kind == "base")
    size = judge._size(block, slip.values, slip.covariance)
    place = f"from {judge.place(slip.first)} on"
    turn = _turn(block, slip.values, slip.covariance)
    change = Hypothesis("base", place, 1.0, *size, 0.0, (), *turn)
    reason = "Before and after, the samples fit to the calibrated arm. Fasten both, and measure again."
    return "changed", [_sentence([change]), reason], (change,), False


def _several(model: _CheckModel, robot: Hypothesis) -> Finding | None:
    """Return the answer if the origin of a joint explains the samples, and no single part does."""
    judge = model.with_known_noise()
    if judge is None or not judge.is_origin(np.inf) or any(map(judge.is_changed, judge.parts)):
        return None
    return "changed", [_robot_sentence(judge)], (robot,), False


def _is_possible(slip: Slip) -> bool:
    """Return whether a base that moved during the check explains the samples."""
    return _p_value(slip.freedom, slip.chi_square) >= MAX_FALSE_ALARMS


def _robot_sentence(judge: _CheckModel | None) -> str:
    """Say that no single part changed, and whether the base may have moved during the check."""
    place = ""
    if judge:
        slip = judge.slip()
        if not (_is_possible(slip) and slip.lead > -MAX_EQUAL):
            return "More than one part of the robot changed, or the origin of a joint: calibrate again."
        place = f", from {judge.place(slip.first)} on"
    return (
        "More than one part of the robot changed, or the origin of a joint, or the base or the instrument "
        f"moved during the check{place}. Fasten both, and measure again; with the same answer, calibrate "
        "again."
    )


def _names(blocks: Sequence[Block]) -> str:
    """List the names of what may have changed."""
    return ", ".join(f"{each.kind} {each.of}".strip() for each in blocks)


def _both_changes(
    model: _CheckModel, block: Block, other: Block, fit: Explained
) -> tuple[Hypothesis, Hypothesis]:
    """Describe two changes that happened together."""
    at, found = 0, []
    for each in (block, other):
        own = slice(at, at + len(each.columns))
        values, covariance = fit.values[own], fit.covariance[own, own]
        size = model._size(each, values, covariance)
        turn = _turn(each, values, covariance)
        found.append(Hypothesis(each.kind, each.of, 1.0, *size, 0.0, (), *turn))
        at = own.stop
    return found[0], found[1]


def _turn(block: Block, values: Array, covariance: Array) -> tuple[float, float]:
    """Return the angle of a turn of base or tool and its standard deviation [rad]; 0 for other changes."""
    if block.kind not in ("base", "tool"):
        return 0.0, 0.0
    angle = float(np.linalg.norm(values[3:]))
    along = values[3:] / (angle or 1.0)
    return angle, float(np.sqrt(along @ covariance[3:, 3:] @ along))


def _text_of_error(value: float) -> str:
    """Return the text of a length."""
    return format_quantity(value, "m", value / 10)


def _unchanged(model: _CheckModel, hypotheses: list[Hypothesis], size: float) -> tuple[str, list[str]]:
    """Return the verdict if nothing is known to have changed: `ok` if the check reveals what matters."""
    judge = model.with_known_noise()
    if judge is not None and judge.unchanged_p_value() < MAX_FALSE_ALARMS:
        return "cannot say", _contradiction(judge, judge is model, size)
    known = [each for each in hypotheses if each.kind in ("joint", "base", "tool")]
    hidden = sorted((each for each in known if each.revealed > size), key=lambda each: -each.revealed)
    remedy = "measure more poses, as `dhcal plan --recheck` chooses them, or more accurately."
    if hidden:
        worst = hidden[0]
        return "cannot say", [
            f"A change of {worst.name} would be revealed from {1e3 * worst.revealed:.2g} mm at the tool on; "
            f"expected {1e3 * size:.2g} mm: {remedy}"
        ]
    largest = max([model.hidden_motion(), *(each.revealed for each in known)])
    if largest > size:
        return "cannot say", [
            f"Changes of several parts would be revealed from {1e3 * largest:.2g} mm at the tool on; "
            f"expected {1e3 * size:.2g} mm: {remedy}"
        ]
    moved = format_quantity(largest, "m", largest / 10)
    reasons = [f"Nothing changed that moves the measured point by more than {moved}."]
    if joints := model.hidden_joints:
        names, is_one = ", ".join(joints), len(joints) == 1
        text = f"The zero of {names} does" if is_one else f"Zeros of {names} do"
        axes = "its axis" if is_one else "their axes"
        reasons.append(f"{text} not move it; measure a point off {axes}.")
    return "ok", reasons


def _contradiction(judge: _CheckModel, is_stated: bool, size: float) -> list[str]:
    """Say that the residuals are larger than noise and uncertainty, though no change is evident."""
    rms, expected = (_text_of_error(each) for each in judge.position_rms())
    if is_stated:
        return [
            f"The positions differ by {rms} RMS, and the stated noise and the uncertainty of the calibration "
            f"explain {expected}. Either the noise is larger, or something changed that is none of the "
            "changes that are compared."
        ]
    answer = _answer(judge, *judge.judged(), size)
    return [
        f"The positions differ by {rms} RMS, and noise and uncertainty of the calibration explain "
        f"{expected}. Either these measurements have more noise, or the robot changed: state their noise by "
        "`--sigma`.",
        f"With the noise of the calibration, the answer is `{answer.verdict}`: {answer.reasons[0]}",
    ]


def _sentence(group: list[Hypothesis]) -> str:
    """Say what changed."""
    best, *others = group
    if best.kind == "robot":
        return _robot_sentence(None)
    size = format_quantity(abs(best.size), best.unit, best.std, small=best.unit == "m")
    verb = "turned" if best.unit == "rad" else "moved"
    part = "base or the instrument" if best.kind == "base" else best.kind
    what = f"The zero of {best.name} changed" if best.kind == "joint" else f"The {part} {verb}"
    if best.unit == "m" and best.angle > max(LARGE_TURN, 5 * best.angle_std):
        size += f" and turned by {format_quantity(best.angle, 'rad', best.angle_std)}"
    like = ""
    if best.kind == "base":
        like = f" {best.of}" if best.of else ", as after a new set-up of the instrument"
    rivals = " or ".join(each.name for each in others)
    return f"{what} by {size}{like}." + (f" A change of {rivals} has the same effect." if rivals else "")
