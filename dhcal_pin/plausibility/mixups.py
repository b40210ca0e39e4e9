"""Diagnosis of mixed-up data: the hypotheses that explain measurements decisively better than their file.

First, the evidence of the measurements as they were read is computed. If they fit a robot with small errors,
no hypothesis is tried. Otherwise each hypothesis changes the same samples, and its evidence is computed in
the same way. A hypothesis is left out if it leaves the nominal robot much farther from the measured positions
than another one does: undoing a mistake takes its error away and adds none. A hypothesis is decisive if its
evidence exceeds that of the file by the factor exp(15), and if the robot fits the changed samples as it fits
ordinary measurements. If none does, and no robot fits the file, each of the best ones is combined with a
second one. Several hypotheses can describe the same change of the data, such as the sign of a joint and the
zeros of two others; all of them are reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product, starmap
from typing import NamedTuple

import numpy as np

from ..estimation.initialization import positions_at_end
from ..formatting import format_quantity
from ..measurements.base import Measurement
from ..robot.chain import Chain
from .evidence import MANUFACTURED, Evidence, fit_evidence
from .hypotheses import (
    AxisChange,
    AxisScale,
    BothChanges,
    Hypothesis,
    JointChange,
    LengthChange,
    RowShift,
    both,
    list_hypotheses,
)

# Evidence of too few measurements: nothing is known about them.
NO_EVIDENCE = Evidence(log=0.0, width=0.0, length_scale=np.nan, angle_scale=np.nan)
# Measurements are suspicious if they need errors of this width, in default standard deviations, or leave
# residuals of this size [m], [rad].
_SUSPICIOUS_WIDTH, _SUSPICIOUS_LENGTH, _SUSPICIOUS_ANGLE = 4.0, 2e-3, 1e-2
# Logarithm of the ratio of evidence above which a hypothesis is decisive. Honest data reach 4.
_MIN_LOG_RATIO = 15.0
# Residuals that fall by this factor are named in the sentence.
_MIN_NAMED_RATIO = 2.0
# Hypotheses within this difference of the best one are reported beside it.
_MAX_LOG_TIE = 3.0
# Largest fall of the log evidence by undoing one of two mistakes, while the other one spoils all samples.
_MAX_LOG_LOSS = 100.0
# Number of hypotheses that are tried as the first of two mistakes, and of pairs by their misfit.
_N_FIRST_OF_PAIR, _N_CLOSEST_PAIRS = 4, 12
# Fewer rows for each unknown of frames and instrument fit too many hypotheses. Base and tool have twelve.
_MIN_ROWS_PER_UNKNOWN, _N_FRAME_UNKNOWNS = 2, 12
# Positions this many times farther from the centre than the median are wrong by themselves.
_MAX_DISTANCE_RATIO = 8.0
# A hypothesis is left out if the misfit of the nominal robot exceeds the smallest one by this factor, but not
# below the least limit, or if it exceeds the largest limit: no robot is so wrong. The misfit is computed from
# at least this many rows per unknown of the frames.
_MAX_MISFIT_RATIO, _MISFIT_LIMITS, _MIN_ROWS_PER_FRAME_UNKNOWN = 3.0, (0.01, 0.7), 2
# A shift of the rows is tried if at least this share of the samples has a neighbouring row.
_MIN_SHIFTED_SHARE = 0.25
# Largest number of measurements that are examined, those with the most samples.
_MAX_ITEMS = 6
# Smallest numbers of samples and rows that the evidence is computed from, and of samples of each measurement.
_N_SAMPLES, _N_ROWS, _MIN_SAMPLES_PER_ITEM = 50, 200, 8


@dataclass(frozen=True)
class Diagnosis:
    """Hypotheses that explain measurements decisively better than the measurements as they were read."""

    before: Evidence  #: Evidence of the measurements as they were read.
    #: Equivalent hypotheses, the simplest first; empty if none is decisive.
    hypotheses: tuple[Hypothesis, ...] = ()
    after: Evidence | None = None  #: Evidence with the first hypothesis.
    source: str = ""  #: File that the hypotheses are about; empty for all measurements together.
    #: Whether each of several measurements fits the robot, but not all of them together.
    fits_separately: bool = False

    @property
    def is_suspicious(self) -> bool:
        """Whether the measurements, as they were read, need large errors or leave large residuals."""
        return is_suspicious(self.before)

    @property
    def is_explained(self) -> bool:
        """Whether a robot with errors of any size fits the measurements, if base and tool are free."""
        return not leaves_residuals(self.before)

    @property
    def sentence(self) -> str:
        """What was mixed up and what undoing it would change; only with a hypothesis."""
        first, *others = (hypothesis.description for hypothesis in self.hypotheses)
        assert self.after is not None
        text = f"In {self.source}, {first}" if self.source else f"{first[0].upper()}{first[1:]}"
        if others:
            text += f" (or {' or '.join(others)})"
        for before, after, unit in (
            (self.before.length_scale, self.after.length_scale, "m"),
            (self.before.angle_scale, self.after.angle_scale, "rad"),
        ):
            if before > _MIN_NAMED_RATIO * after:
                sizes = [format_quantity(v, unit, 0.1 * v, small=True) for v in (before, after)]
                return f"{text}: undoing this reduces the residuals from {sizes[0]} to {sizes[1]}."
        return f"{text}: undoing this makes the measurements fit a robot with ordinary errors."

    @property
    def remedy(self) -> str:
        """What to do about it; only with a hypothesis."""
        where = f"@{self.source}" if self.source else ""
        keys = [f"--mend {hypothesis.key}{where}" for hypothesis in self.hypotheses]
        return f"Correct the measurements, or add {' or '.join(keys)}."


def diagnose_mixups(chain: Chain, data: Sequence[Measurement], sets: str = MANUFACTURED) -> Diagnosis:
    """Look for a mistake in measurements that explains why they do not fit the robot.

    The robot may have errors of one of the parameter sets of `evidence`.

    A mistake may be in all measurements or in one of several. Contacts with planes and spheres are left out:
    a robot with other errors can touch an unknown surface exactly, whatever the mistake is. So are image
    coordinates, which the mistakes listed here do not concern.
    """
    items = comparable_items(data)
    if not items:
        return Diagnosis(NO_EVIDENCE)
    diagnosis, trial = _find_single(chain, items, sets)
    if diagnosis.hypotheses or trial is None:
        return diagnosis
    if len(items) > 1:
        separate = [(item, _find_one_or_two(chain, item, sets)) for item in items]
        for item, one in separate:
            if one.hypotheses:
                return replace(one, source=item.source)
        if not any(one.is_suspicious for _, one in separate):
            return replace(diagnosis, fits_separately=True)
    return _find_pair(trial)


def comparable_items(data: Sequence[Measurement]) -> list[Measurement]:
    """Return the measurements, at most `_MAX_ITEMS`, that tell hypotheses about joints apart."""
    items = [item for item in data if item.configurations_per_row and not _is_surface_contact(item)]
    items = [item for item in items if item.rig is None]
    return sorted(items, key=lambda item: -len(item.rows))[:_MAX_ITEMS]


def _is_surface_contact(item: Measurement) -> bool:
    """Return whether the samples touch a surface, which gives one equation each."""
    return item.is_contact and item.residual_dim == 1


def has_enough_rows(samples: Sequence[Measurement]) -> bool:
    """Return whether samples have enough rows for the unknowns of frames and instrument."""
    n_rows = sum(item.residual_dim * len(item.rows) for item in samples)
    n_instrument = len({parameter.name for item in samples for parameter in item.instrument_parameters})
    return n_rows >= _MIN_ROWS_PER_UNKNOWN * (_N_FRAME_UNKNOWNS + n_instrument)


class _Trial(NamedTuple):
    """Suspicious samples, and the evidence of all single hypotheses."""

    chain: Chain
    samples: Sequence[Measurement]
    neighbourhood: Sequence[Measurement]
    sets: str
    before: Evidence
    hypotheses: Sequence[Hypothesis]
    scored: Sequence[_Scored]


def _find_single(chain: Chain, data: Sequence[Measurement], sets: str) -> tuple[Diagnosis, _Trial | None]:
    """Look for one mistake in all of the measurements; return what was tried if they remain suspicious."""
    samples, neighbourhood = draw_samples(data)
    if not has_enough_rows(samples):
        return Diagnosis(NO_EVIDENCE), None
    before = fit_evidence(chain, samples, sets)
    if not is_suspicious(before):
        return Diagnosis(before), None
    listed = list(list_hypotheses(chain, samples))
    scored = _score(chain, samples, neighbourhood, listed, sets)
    trial = _Trial(chain, samples, neighbourhood, sets, before, listed, scored)
    return _decisive(before, scored) or Diagnosis(before), trial


def _find_pair(trial: _Trial) -> Diagnosis:
    """Look for two mistakes in measurements with positions, by which pairs are compared."""
    chain, samples, neighbourhood, sets, before, listed, scored = trial
    if leaves_residuals(before) and nominal_misfit(chain, samples):
        first = [each for each in scored if each.log > before.log - _MAX_LOG_LOSS]
        first.sort(key=lambda each: -each.log)
        trials = [_closest_pairs(chain, samples, neighbourhood, listed)]
        for each in first[:_N_FIRST_OF_PAIR]:
            trials.append([both(each.hypothesis, second) for second in listed if second != each.hypothesis])
        for pairs in trials:
            if found := _decisive(before, _score(chain, samples, neighbourhood, pairs, sets)):
                return found
    return Diagnosis(before)


def _find_one_or_two(chain: Chain, item: Measurement, sets: str) -> Diagnosis:
    """Look for one mistake or two in one measurement."""
    diagnosis, trial = _find_single(chain, [item], sets)
    return diagnosis if diagnosis.hypotheses or trial is None else _find_pair(trial)


def _closest_pairs(
    chain: Chain,
    samples: Sequence[Measurement],
    neighbourhood: Sequence[Measurement],
    hypotheses: Sequence[Hypothesis],
) -> list[Hypothesis]:
    """Return the pairs of mistakes whose changes bring the nominal robot nearest to the measured poses.

    Units and axes of positions do not change this misfit; changes of joints may follow all others.
    """
    of_joints = [each for each in hypotheses if isinstance(each.change, JointChange | RowShift)]
    others = [
        each
        for each in hypotheses
        if not isinstance(each.change, JointChange | RowShift | LengthChange | AxisChange | AxisScale)
    ]
    pairs = [*permutations(of_joints, 2), *product(others, of_joints), *permutations(others, 2)]
    found = []
    for pair in starmap(both, pairs):
        changed = _apply(pair, samples, neighbourhood)
        if changed is not None:
            found.append((nominal_misfit(chain, changed), pair))
    return [pair for _, pair in sorted(found, key=lambda each: each[0])[:_N_CLOSEST_PAIRS]]


class _Scored(NamedTuple):
    """Evidence of samples after the change of a hypothesis."""

    hypothesis: Hypothesis
    after: Evidence
    log: float  # Logarithm of the evidence, comparable with that of the samples as they were read


def _score(
    chain: Chain,
    samples: Sequence[Measurement],
    neighbourhood: Sequence[Measurement],
    hypotheses: Sequence[Hypothesis],
    sets: str,
) -> list[_Scored]:
    """Compute the evidence of the hypotheses that apply and bring the nominal robot near the positions."""
    changes = [(each, _apply(each, samples, neighbourhood)) for each in hypotheses]
    candidates = [
        (nominal_misfit(chain, changed), hypothesis, changed)
        for hypothesis, changed in changes
        if changed is not None
    ]
    smallest = min([nominal_misfit(chain, samples), *(misfit for misfit, _, _ in candidates)])
    largest, scored = np.clip(_MAX_MISFIT_RATIO * smallest, *_MISFIT_LIMITS), []
    for misfit, hypothesis, changed in candidates:
        if misfit <= largest:
            after = fit_evidence(chain, changed, sets)
            log = after.log * _count(samples) / _count(changed) + hypothesis.log_jacobian(samples)
            scored.append(_Scored(hypothesis, after, log))
    return scored


def _decisive(before: Evidence, scored: Sequence[_Scored]) -> Diagnosis | None:
    """Return the diagnosis of the best hypotheses if a robot fits the samples after their change."""
    best = max((each.log for each in scored), default=-np.inf)
    ties = [each for each in scored if each.log >= best - _MAX_LOG_TIE]
    ties = [each for each in ties if not leaves_residuals(each.after)]
    if best - before.log < _MIN_LOG_RATIO or not ties:
        return None
    return Diagnosis(before, tuple(each.hypothesis for each in ties), ties[0].after)


def is_suspicious(evidence: Evidence) -> bool:
    """Return whether measurements may be mixed up: they need large errors or leave large residuals."""
    return evidence.width >= _SUSPICIOUS_WIDTH or leaves_residuals(evidence)


def leaves_residuals(evidence: Evidence) -> bool:
    """Return whether no robot fits the measurements, however large its errors are."""
    return evidence.length_scale > _SUSPICIOUS_LENGTH or evidence.angle_scale > _SUSPICIOUS_ANGLE


def nominal_misfit(chain: Chain, data: Sequence[Measurement]) -> float:
    """Compute how far the nominal robot is from measured poses, with any base, tool and unit of length.

    A position p of a target at t in the tip frame, which has the rotation R and the position p_tip, fulfils

        A·p + b - R·t = p_tip

    with A = Q/f for the orientation Q of the instrument and a unit of length f. All elements of A, b and t
    are free here, which makes the equation linear and the error too small rather than too large. Its mean
    square per degree of freedom counts relative to that of p_tip about its mean. A measured rotation M
    fulfils Q·M = R·B with the rotation B of the tool. With free matrices of unit norm, both sides differ by
    the mean square 1 - σ for the largest singular value σ of the mean of M⊗R, a third of that of the angles.
    The two mean squares are added.
    """
    arm = chain.with_base_and_tool(np.eye(4), np.eye(4))
    squares = spreads = turns = 0.0
    count = 0
    for item in data:
        p, measured = positions_at_end(item), item.rotations()
        if item.configurations_per_row != 1 or len(p) != len(item.rows):
            continue
        tip = arm.poses(item.conditions().of_arm)
        directions = np.broadcast_to(np.eye(3), (len(p), 3, 3))
        rows = np.concatenate(
            [*(p[:, [i], None] * directions for i in range(3)), directions, -tip[:, :3, :3]], 2
        ).reshape(3 * len(p), -1)
        if len(rows) < _MIN_ROWS_PER_FRAME_UNKNOWN * rows.shape[1]:
            continue
        target = tip[:, :3, 3].ravel()
        error = target - rows @ np.linalg.lstsq(rows, target, rcond=None)[0]
        squares += float(error @ error) * len(rows) / (len(rows) - rows.shape[1])
        spreads += float(np.sum((tip[:, :3, 3] - tip[:, :3, 3].mean(0)) ** 2))
        if len(measured) and item.conditions().base_motion is None:
            products = np.einsum("mij,mkl->ikjl", measured, tip[:, :3, :3]).reshape(9, 9)
            turns += max(0.0, len(p) - float(np.linalg.norm(products, 2)))
        count += len(p)
    return float(np.sqrt(squares / spreads + turns / count)) if spreads else 0.0


def _count(data: Sequence[Measurement]) -> int:
    """Return the number of samples."""
    return sum(len(item.rows) for item in data)


def _apply(
    hypothesis: Hypothesis, samples: Sequence[Measurement], neighbourhood: Sequence[Measurement]
) -> list[Measurement] | None:
    """Apply a hypothesis to the samples; None if it does not apply to most of them."""
    changes = hypothesis.change
    steps = (changes.first, changes.second) if isinstance(changes, BothChanges) else (hypothesis,)
    if not any(isinstance(step.change, RowShift) for step in steps):
        return hypothesis.apply(samples)
    shifted = hypothesis.apply(neighbourhood)
    if shifted is None:
        return None
    kept = [item.take(np.isin(item.rows, drawn.rows)) for item, drawn in zip(shifted, samples, strict=True)]
    return kept if _count(kept) >= _MIN_SHIFTED_SHARE * _count(samples) else None


def draw_samples(data: Sequence[Measurement]) -> tuple[list[Measurement], list[Measurement]]:
    """Draw samples of each measurement; return them, and the same with the rows above and below each."""
    samples, neighbourhood = [], []
    for measured in data:
        needed = max(_N_SAMPLES, _N_ROWS // measured.residual_dim)
        count = max(_MIN_SAMPLES_PER_ITEM, -(-needed // len(data)))
        item = _without_far_positions(measured)
        item = item.take(np.argsort(item.rows, kind="stable"))
        m = len(item.rows)
        index = np.sort(np.random.default_rng(0).permutation(m)[:count])
        nearby = np.unique(np.clip(np.concatenate([index - 1, index, index + 1]), 0, m - 1))
        samples.append(item.take(index))
        neighbourhood.append(item.take(nearby))
    return samples, neighbourhood


def _without_far_positions(item: Measurement) -> Measurement:
    """Leave out positions far from all others, which would spoil the initial frames."""
    positions = item.positions()
    if not len(positions):
        return item
    distances = np.linalg.norm(positions - np.median(positions, 0), axis=1)
    return item.take(distances <= _MAX_DISTANCE_RATIO * np.median(distances))
