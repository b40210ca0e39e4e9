"""Difference of two calibrations of one robot, after the best common base and tool.

Base and tool of the second robot are those that minimize the displacements of its tool from that of the first
one, so that another set-up of the instrument or another reflector makes no difference.

The displacements d of the tool at m configurations have the covariance C = S·Sᵀ, where S joins the roots of
both calibrations. Displacements by base and tool, the columns of G, are removed from both: with an
orthonormal basis Q of G and P = I - Q·Qᵀ,

    χ² = (P·d)ᵀ·(P·C·P)⁺·(P·d)

has a χ² distribution with k = rank(P·S) degrees of freedom if both calibrations are of the same robot, their
models describe it, and their uncertainties are right. Reduced chi-square is χ²/k. It scatters by √(2/k).

With few parameters, that is a wide interval. The residuals of both calibrations add to it: the hypothesis
that the robot is one, that the model describes it, and that the noise is the stated one has the chi-square

    χ²_A + χ²_B + χ²,    with ν_A + ν_B + k degrees of freedom,

with χ²_A of the residuals of one calibration in stated standard deviations of the instrument, and their ν_A
degrees of freedom. If the noise was estimated from the residuals, χ²_A is ν_A, and only χ² scatters.

Residuals that vary with the joint values are evidence of their own. Calibrations state by how much each
family of joint errors that the model lacks would decrease the cost. An F test judges the gains of both.

Configurations for χ² have drawn directions of motion and temperatures, if one of the robots depends on them,
so that backlash and thermal growth count as all other parameters do. See `common_conditions`.

If the difference is too large, the joints and links that explain it are named, see `joint_differences`.

Reference: W. Baarda, S-transformations and criterion matrices, Netherlands Geodetic Commission, 1973.

Shapes: m configurations, n joints, c components of a displacement: 3, or 6 with angles times a length.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, replace
from typing import Any

import numpy as np
from scipy import special

from .. import se3
from .._frozen import frozen
from .._typing import Array
from ..estimation.frame_gauge import frame_effects
from ..estimation.uncertainty import ModelFit, Uncertainty
from ..exceptions import InvalidArgumentError
from ..formatting import Quantity
from ..measurements.measured_region import MeasuredRegion, draw_joint_space
from ..robot.chain import Chain
from ..robot.conditions import Conditions
from ..robot.error_families import FAMILIES
from .common_conditions import at_reference, condition_remarks, varied, with_common_payload
from .joint_differences import PartDifference, find_part_differences, parameters

# Number of configurations at which the robots are compared.
N_COMPARED = 200
# Fewest configurations of a common measured region.
MIN_REGION = 10
# Largest distance of the tools relative to the spread of the tool points: beyond, they are different robots.
MAX_RELATIVE_DISTANCE = 0.1
# Orientations count if their standard deviation, as a motion at the lever, is at most this many times that of
# the positions: else priors limit it.
MAX_STD_RATIO = 2.5
# Standard deviations below this part of their median are those of rounding and of second-order effects.
MIN_STD_RATIO = 0.02
# Singular values below this part of the largest one are zero up to rounding.
RANK_RTOL = 1e-3
# Largest part of the effect of a joint error outside of what the uncertainties contain.
MAX_OUTSIDE = 1e-3
# Smallest part of the effect of a parameter that base and tool do not have.
MIN_OWN_EFFECT = 0.01
# Effects of base and tool below this part of the largest one are none.
EFFECT_RTOL = 1e-6
# Probability below which calibrations are different: of the chi-square of the parameters, and of that of all.
DIFFERENT_P = 0.005
# Probability of the gain of a family of joint errors below which the models lack it.
LACKING_P = 1e-4
# Displacement that no uncertainty explains and that counts as a difference of the models [m], and its
# smallest part of the distance of the tools: the rest is of the linearization.
MIN_UNEXPLAINED, MIN_UNEXPLAINED_PART = 1e-5, 0.05
MAX_ITERATIONS = 10
STEP_TOL = 1e-10


@frozen(eq=False)
class Calibrated:
    """Robot with what its calibration says of it."""

    chain: Chain  #: Robot
    uncertainty: Uncertainty | None = None  #: Uncertainty of its calibration; None if it is not known
    region: MeasuredRegion | None = None  #: Measured region; None if it is not known
    source: str = ""  #: File of the robot


@frozen(eq=False)
class Distances:
    """Distances of two tools in m configurations."""

    position: Array  # Distances of the tool points, (m,) [m]
    # Angles between the tools, (m,) [rad]; None if one calibration does not determine them.
    orientation: Array | None
    expected: float | None  # RMS distance that the uncertainties explain [m]; None if they are not known

    def to_dict(self) -> dict[str, Any]:
        """Return RMS, 95th percentile and maximum for a JSON document."""
        out: dict[str, Any] = {"configurations": len(self.position), "expected_position_rms_m": self.expected}
        for name, unit, values in (
            ("position", "m", self.position),
            ("orientation", "rad", self.orientation),
        ):
            for key, function in STATISTICS.items():
                out[f"{name}_{key}_{unit}"] = None if values is None else float(function(values))
        return out


# Statistics of distances by their keys.
STATISTICS = {
    "rms": lambda values: np.sqrt(np.mean(values**2)),
    "p95": lambda values: np.quantile(values, 0.95),
    "max": np.max,
}


@frozen
class ChiSquare:
    """Chi-square of a hypothesis."""

    value: float  # Chi-square
    freedom: float  # Degrees of freedom
    constant: float = 0.0  # Part of both that does not scatter, as the noise was estimated from it

    @property
    def reduced(self) -> float:
        """Reduced chi-square."""
        return self.value / max(self.freedom, 1)

    @property
    def p_value(self) -> float:
        """Probability of a chi-square at least this large if the hypothesis is true; NaN without freedom."""
        freedom = self.freedom - self.constant
        return float(special.chdtrc(freedom, max(self.value - self.constant, 0.0))) if freedom > 0 else np.nan

    @property
    def limit(self) -> float:
        """Reduced chi-square that `DIFFERENT_P` of cases exceed if the hypothesis is true."""
        end = float(special.chdtri(self.freedom - self.constant, DIFFERENT_P))
        return (self.constant + end) / max(self.freedom, 1)

    @property
    def usual(self) -> tuple[float, float]:
        """Interval that contains the reduced chi-square of 95 % of cases if the hypothesis is true."""
        ends = (special.chdtri(self.freedom - self.constant, 1 - p) for p in (0.025, 0.975))
        low, high = ((self.constant + float(end)) / max(self.freedom, 1) for end in ends)
        return low, high

    def to_dict(self) -> dict[str, Any]:
        """Return the content for a JSON document."""
        return {
            "chi_square": self.value,
            "degrees_of_freedom": self.freedom,
            "reduced_chi_square": self.reduced,
            "reduced_chi_square_95": list(self.usual),
            "reduced_chi_square_limit": self.limit,
            "p_value": self.p_value,
        }


@frozen(eq=False)
class Difference:
    """Difference of two calibrations of one robot."""

    first: Chain  #: First robot
    second: Chain  #: Second robot, with the base and tool that fit those of the first one best
    region: Distances | None  #: Distances in the measured region of both; None without a common one
    everywhere: Distances  #: Distances in configurations drawn from the joint limits
    q: Array  #: These configurations, (m, n) [rad or m]
    #: Chi-square of the difference of the parameters; None if no uncertainty is known.
    of_parameters: ChiSquare | None = None
    #: Chi-square of the residuals of both calibrations and of the difference.
    overall: ChiSquare | None = None
    unexplained: float = 0.0  #: RMS distance that no uncertainty can explain [m]; 0 if it is rounding
    #: Joints and links that differ, that of the largest part of chi-square first.
    joints: dict[str, PartDifference] = field(default_factory=dict)
    #: Families of joint errors that both models lack, and the probability that chance causes it.
    lacking: dict[str, float] = field(default_factory=dict)
    #: Conditions of `q` at which the distances are those of the robots; None for q alone.
    at: Conditions | None = None
    #: Conditions of the comparison that one of the robots does not have, and errors that only one has.
    remarks: Sequence[str] = ()

    @property
    def verdict(self) -> str:
        """Whether the robots are "equal" or "different" within their uncertainties, or "unknown"."""
        if self.of_parameters is None or self.overall is None:
            return "unknown"
        is_other = self.unexplained > (self.everywhere.expected or 0.0)
        least = min(self.of_parameters.p_value, self.overall.p_value)
        return "different" if least < DIFFERENT_P or is_other or self.lacking else "equal"

    @property
    def sentences(self) -> list[str]:
        """What the difference means."""
        if self.of_parameters is None or self.overall is None:
            return [
                "No calibration states the uncertainty of the arm, so that nothing says how large a "
                "difference may be.",
                *self.remarks,
            ]
        texts = [
            f"{_described(self.of_parameters)}; equal robots have less than {self.of_parameters.limit:.2f}."
        ]
        if self.overall.freedom > self.of_parameters.freedom:
            texts.append(
                f"With the residuals of both: {_described(self.overall)}; one robot that the model describes "
                f"has less than {self.overall.limit:.2f}."
            )
        if self.lacking:
            names = ", ".join(f"{name} ({FAMILIES[name].description})" for name in self.lacking)
            texts.append(f"The model does not explain the arm: residuals of both vary with {names}.")
        elif self.overall.p_value < DIFFERENT_P <= self.of_parameters.p_value:
            texts.append("The noise is larger than stated, or the model does not explain the arm.")
        if self.unexplained:
            part = Quantity.error(self.unexplained, "m")
            texts.append(f"{part} RMS is of errors whose uncertainty no calibration states.")
        if self.joints:
            parts = "; ".join(f"{name} ({part.text})" for name, part in self.joints.items())
            texts.append(f"These parts differ: {parts}.")
        return [*texts, *self.remarks]

    def to_dict(self) -> dict[str, Any]:
        """Return the difference for a JSON document."""
        return {
            "verdict": self.verdict,
            "reasons": self.sentences,
            "measured_region": self.region and self.region.to_dict(),
            "joint_space": self.everywhere.to_dict(),
            **(self.overall.to_dict() if self.overall else dict.fromkeys(CHI_SQUARE_KEYS)),
            "parameters": self.of_parameters and self.of_parameters.to_dict(),
            "lacking": [{"name": name, "p_value": value} for name, value in self.lacking.items()],
            "unexplained_rms_m": self.unexplained,
            "joints": [{"name": name, **part.to_dict()} for name, part in self.joints.items()],
        }


# Keys of a chi-square in a JSON document.
CHI_SQUARE_KEYS = tuple(ChiSquare(0.0, 1.0).to_dict())


def _described(found: ChiSquare) -> str:
    """Describe a chi-square."""
    return f"Reduced chi-square {found.reduced:.2f} with {found.freedom:.0f} degrees of freedom"


def compare(first: Calibrated, second: Calibrated) -> Difference:
    """Compare the tools of two calibrations of one robot with the best common base and tool."""
    a, b = first.chain, second.chain
    for what in ("joint_names", "tip"):
        if getattr(a, what) != getattr(b, what):
            values = [x if isinstance(x, str) else ", ".join(x) for x in (getattr(a, what), getattr(b, what))]
            name = "joints" if what == "joint_names" else what
            raise InvalidArgumentError(
                f"{second.source}: another robot: its {name}: {values[1]}; expected those of {first.source}: "
                f"{values[0]}"
            )
    if first.uncertainty is None and second.uncertainty is not None:
        # The measured point, which a nominal robot does not state.
        a = replace(a, tool=b.tool)
    remarks = condition_remarks((a, b), (first.source, second.source))
    a, b = with_common_payload((a, b))
    everywhere = draw_joint_space(a)
    q_all, q_region = everywhere[:N_COMPARED], _common_region(first, second)
    at_all, at_region = (q if q is None else at_reference((a, b), q) for q in (q_all, q_region))
    assert at_all is not None
    lever = se3.rms_radius(a.poses(at_all)[:, :3, 3]) or 1.0
    pair = (first.uncertainty, second.uncertainty)
    roots = [u for u in pair if u is not None]
    is_turned = all(_determines_orientation(u, at_all, lever) for u in roots)
    n_components = 6 if is_turned else 3
    b = _aligned(a, replace(b, base=a.base, tool=a.tool), at_region or at_all, lever, n_components)

    def distances(at: Conditions) -> Distances:
        d = _displacements(a, b, at, 1.0)
        expected = _expected(a, b, pair, at, lever, n_components)
        angles = np.linalg.norm(d[:, 3:], axis=1) if is_turned else None
        return Distances(np.linalg.norm(d[:, :3], axis=1), angles, expected)

    whole = distances(at_all)
    rms = float(STATISTICS["rms"](whole.position))
    if rms > MAX_RELATIVE_DISTANCE * lever:
        raise InvalidArgumentError(
            f"{second.source}: another robot: its tool is {1e3 * rms:.3g} mm RMS from that of {first.source} "
            "after the best base and tool; expected two calibrations of one robot"
        )
    difference = Difference(
        a,
        b,
        None if at_region is None else distances(at_region),
        whole,
        everywhere,
        at=at_reference((a, b), everywhere),
        remarks=remarks,
    )
    if not roots:
        return difference
    return _tested(difference, pair, varied((a, b), q_all, np.random.default_rng(0)), lever, n_components)


def _common_region(first: Calibrated, second: Calibrated) -> Array | None:
    """Return the configurations in the measured regions of both robots, (m, n); None if there are few."""
    regions = [each.region for each in (first, second) if each.region is not None]
    if not regions:
        return None
    q = np.concatenate([region.configurations for region in regions])
    q = q[np.all([region.contains(q) for region in regions], 0)]
    return q[:: -(-len(q) // N_COMPARED)] if len(q) >= MIN_REGION else None


def _displacements(
    a: Chain, b: Chain, at: Conditions, lever: float, of_second: Conditions | None = None
) -> Array:
    """Return the displacements of the tool of b from that of a, (m, 6) [m]."""
    # The conditions of the second robot may be others.
    of_a, of_b = a.poses(at), b.poses(at if of_second is None else of_second)
    turns = [se3.log3(turn) for turn in of_b[:, :3, :3] @ of_a[:, :3, :3].swapaxes(1, 2)]
    return np.hstack([of_b[:, :3, 3] - of_a[:, :3, 3], lever * np.array(turns)])


def _frame_columns(chain: Chain, at: Conditions, lever: float, n_components: int) -> Array:
    """Return the effects of base and tool on displacements, (m·components, 12)."""
    return frame_effects(chain, at, lever).reshape(len(at.q), 6, -1)[:, :n_components].reshape(-1, 12)


def _aligned(
    a: Chain, b: Chain, at: Conditions, lever: float, n_components: int, of_second: Conditions | None = None
) -> Chain:
    """Return b with the base and tool with which its tool is nearest to that of a."""
    for _ in range(MAX_ITERATIONS):
        effects = _frame_columns(b, at, lever, n_components)
        d = _displacements(a, b, at, lever, of_second)[:, :n_components].ravel()
        step = -np.linalg.lstsq(effects, d, rcond=EFFECT_RTOL)[0]
        b = replace(b, base=se3.exp6(step[:6]) @ b.base, tool=b.tool @ se3.exp6(step[6:]))
        if np.abs(effects @ step).max() < STEP_TOL:
            break
    return b


def _effects(chain: Chain, uncertainty: Uncertainty, at: Conditions, lever: float) -> Array:
    """Return the root of the covariance of the tool's displacements with the frames of a chain, (m, 6, r)."""
    moved = replace(uncertainty, chain=chain)
    out = moved.tool_twists(chain.forward_kinematics(at), uncertainty.sqrt_covariance)
    out[:, 3:] *= lever
    return out


def _without_frames(chain: Chain, at: Conditions, lever: float, n_components: int, columns: Array) -> Array:
    """Remove what base and tool explain of displacements (m, 6, c), (m·components, c)."""
    u, s, _ = np.linalg.svd(_frame_columns(chain, at, lever, n_components), full_matrices=False)
    u = u[:, s > EFFECT_RTOL * s[0]]
    flat = columns[:, :n_components].reshape(-1, columns.shape[2])
    return flat - u @ (u.T @ flat)


def _determines_orientation(uncertainty: Uncertainty, at: Conditions, lever: float) -> bool:
    """Return whether the measurements determine the orientation of the tool, up to another base and tool."""
    chain = uncertainty.chain
    effects = _effects(chain, uncertainty, at, lever)
    turn = _without_frames(chain, at, lever, 6, effects).reshape(len(at.q), 6, -1)[:, 3:]
    position = _without_frames(chain, at, lever, 3, effects)
    return bool(np.linalg.norm(turn) <= MAX_STD_RATIO * np.linalg.norm(position))


def _root(
    a: Chain,
    b: Chain,
    pair: tuple[Uncertainty | None, Uncertainty | None],
    at: Conditions,
    lever: float,
    n: int,
) -> Array:
    """Return the root of the covariance of the displacements without base and tool, (m·n, r)."""
    # Base and tool of each calibration by themselves: measurements may leave them undetermined.
    parts = [np.empty((len(at.q) * n, 0))]
    for chain, uncertainty in zip((a, b), pair, strict=True):
        if uncertainty is not None:
            effects = _effects(chain, uncertainty, at, lever)
            own = _without_frames(chain, at, lever, n, effects)
            # A calibration of base and tool alone leaves rounding errors.
            if np.linalg.norm(own) > EFFECT_RTOL * np.linalg.norm(effects):
                parts.append(own)
    return np.hstack(parts)


def _expected(a, b, pair, at: Conditions, lever: float, n: int) -> float | None:
    """Return the RMS distance that the uncertainties explain [m]; None if no arm was estimated."""
    root = _root(a, b, pair, at, lever, n)
    if not root.shape[1]:
        return None
    root = root.reshape(len(at.q), n, -1)[:, :3]
    return float(np.sqrt(np.sum(root**2) / len(at.q)))


def _tested(difference: Difference, pair, at: Conditions, lever: float, n: int) -> Difference:
    """Return a difference with its chi-square, and the parts that differ, if the arm was estimated."""
    a, b = difference.first, difference.second
    u, s, _ = np.linalg.svd(_root(a, b, pair, at, lever, n), full_matrices=False)
    if not s.size:
        return difference
    usual = np.median(s[s > RANK_RTOL * s[0]])
    rank = int(np.sum(s > MIN_STD_RATIO * usual))
    u, whiten = u[:, :rank], (u[:, :rank] / s[:rank]).T

    def remaining(zeros: Array) -> Array:
        """Return the displacements (m·n,) after zeros of the second robot are undone."""
        undone = replace(at, zeros=np.tile(-zeros, (len(at.q), 1))) if zeros.any() else at
        moved = _aligned(a, b, at, lever, n, undone) if zeros.any() else b
        d = _displacements(a, moved, at, lever, undone)
        return _without_frames(a, at, lever, n, d[..., None])[:, 0]

    first = remaining(np.zeros(a.n_joints))
    z = whiten @ first
    of_parameters = ChiSquare(float(z @ z), rank)
    fits = [each.fit for each in pair if each is not None and each.fit is not None]
    difference = replace(
        difference,
        of_parameters=of_parameters,
        overall=_with_residuals(of_parameters, fits),
        lacking=_lacking(fits),
        unexplained=_unexplained(first, first, u, len(at.q)),
    )
    if difference.verdict != "different":
        return difference
    candidates = []
    for each in parameters(a, at):
        effects = each.effects * np.repeat([1.0, lever], 3)
        own = _without_frames(a, at, lever, n, effects[..., None])[:, 0]
        is_own = np.linalg.norm(own) > MIN_OWN_EFFECT * np.linalg.norm(effects)
        if is_own and np.sum((own - u @ (u.T @ own)) ** 2) < MAX_OUTSIDE * np.sum(own**2):
            candidates.append(replace(each, effects=whiten @ own))
    joints, zeros = find_part_differences(candidates, lambda zeros: whiten @ remaining(zeros), a.n_joints)
    unexplained = _unexplained(first, remaining(zeros), u, len(at.q))
    return replace(difference, joints=joints, unexplained=unexplained)


def _unexplained(whole: Array, remaining: Array, u: Array, count: int) -> float:
    """Return the RMS of displacements outside of the span of u [m]; 0 if it is of the linearization."""
    left = float(np.linalg.norm(remaining - u @ (u.T @ remaining)))
    is_small = left < MIN_UNEXPLAINED_PART * np.linalg.norm(whole)
    return 0.0 if is_small or left < MIN_UNEXPLAINED * np.sqrt(count) else left / float(np.sqrt(count))


def _with_residuals(of_parameters: ChiSquare, fits: Sequence[ModelFit]) -> ChiSquare:
    """Add the chi-squares of the residuals of calibrations."""
    value, freedom, constant = of_parameters.value, of_parameters.freedom, 0.0
    for fit in fits:
        freedom += fit.freedom
        value += fit.freedom if fit.chi_square is None else fit.chi_square
        constant += fit.freedom if fit.chi_square is None else 0.0
    return ChiSquare(value, freedom, constant)


def _lacking(fits: Sequence[ModelFit]) -> dict[str, float]:
    """Return the families of joint errors that all models lack, with the probabilities of their gains."""
    found = {}
    for name in set.intersection(*(set(fit.gains) for fit in fits)) if fits else ():
        gains = [fit.gains[name] for fit in fits]
        gain, added, remaining = (
            sum(getattr(each, key) for each in gains) for key in ("gain", "added", "remaining")
        )
        p_value = float(special.fdtrc(added, remaining, gain / added))
        if p_value < LACKING_P / len(fits[0].gains):
            found[name] = p_value
    return dict(sorted(found.items(), key=lambda item: (item[1], item[0])))
