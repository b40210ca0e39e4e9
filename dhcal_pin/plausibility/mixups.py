"""Diagnosis of mixed-up data: the hypotheses that explain measurements decisively better than their file.

First, the evidence of the measurements as they were read is computed. If they fit a robot with small errors,
no hypothesis is tried. Otherwise each hypothesis changes the same samples, and its evidence is computed in
the same way. A hypothesis is left out if it leaves the nominal robot much farther from the measured poses
than another one does: undoing a mistake takes its error away and adds none. A hypothesis is decisive if its
evidence exceeds that of the file by the factor exp(15), and if the robot fits the changed samples as it fits
ordinary measurements, with errors of ordinary size.

If none is, all pairs of hypotheses are compared by the misfit of the nominal robot, and the evidence of the
closest ones is computed. Single hypotheses that need large errors of the robot remain only if no pair brings
the nominal robot much nearer: with errors of decimetres, a robot can fit exactly what a wrong hypothesis
makes of the measurements. Several hypotheses can describe the same change of the data, such as the sign of a
joint and the zeros of two others; all of them are reported.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from heapq import nsmallest
from itertools import islice, permutations, product, starmap
from typing import NamedTuple

import numpy as np

from ..formatting import format_quantity
from ..measurements.base import Measurement
from ..robot.chain import Chain
from .evidence import HAND_BUILT, MANUFACTURED, Evidence, fit_evidence
from .hypotheses import AxisScale, Hypothesis, JointChange, OtherNotation, RowShift, both, list_hypotheses
from .misfit import MAX_MISFIT, nominal_misfits

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
# Number of pairs of mistakes with the smallest misfits, and of those among them that change the samples
# differently, whose evidence is computed.
_N_NEAR_PAIRS, _N_CLOSEST_PAIRS = 60, 12
# Number of changes whose misfits are computed together.
_N_TOGETHER = 1024
# Samples are equal if no coordinate differs by more than this [m], [rad].
_TOLERANCE = 1e-6
# Fewer rows for each unknown of frames and instrument fit too many hypotheses. Base and tool have twelve.
_MIN_ROWS_PER_UNKNOWN, _N_FRAME_UNKNOWNS = 2, 12
# Positions this many times farther from the centre than the median are wrong by themselves.
_MAX_DISTANCE_RATIO = 8.0
# A hypothesis is left out if the misfit of the nominal robot exceeds the smallest one by this factor and the
# least limit, or if it exceeds the largest limit, which depends on the errors that the robot may have.
_MAX_MISFIT_RATIO, _MIN_MISFIT = 3.0, 0.01
_LARGEST_MISFITS = {MANUFACTURED: 0.2, HAND_BUILT: MAX_MISFIT}
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
    if trial is None:
        return diagnosis
    if len(items) > 1 and not trial.single.hypotheses:
        separate = [(item, _find_one_or_two(chain, item, sets)) for item in items]
        for item, one in separate:
            if one.hypotheses:
                return replace(one, source=item.source)
        if not any(one.is_suspicious for _, one in separate):
            return replace(diagnosis, fits_separately=True)
    return _find_pair(trial)


def comparable_items(data: Sequence[Measurement]) -> list[Measurement]:
    """Return the measurements, at most `_MAX_ITEMS`, that distinguish hypotheses about joints."""
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


# Hypothesis, and samples after its change; None if it does not apply to them.
_Change = tuple[Hypothesis, list[Measurement] | None]


class _Candidate(NamedTuple):
    """Hypothesis about samples, with the samples after its change."""

    hypothesis: Hypothesis
    changed: list[Measurement]
    misfit: float  # Misfit of the nominal robot after the change


class _Trial(NamedTuple):
    """Suspicious samples, and what single hypotheses say about them."""

    chain: Chain
    samples: Sequence[Measurement]
    sets: str
    before: Evidence
    misfit: float  # Misfit of the nominal robot
    candidates: Sequence[_Candidate]
    single: Diagnosis  # Decisive hypotheses, with which the robot needs large errors, if any


def _find_single(chain: Chain, data: Sequence[Measurement], sets: str) -> tuple[Diagnosis, _Trial | None]:
    """Look for one mistake in all of the measurements; return what was tried if it is not certain."""
    samples, neighbourhood = draw_samples(data)
    if not has_enough_rows(samples):
        return Diagnosis(NO_EVIDENCE), None
    before = fit_evidence(chain, samples, sets)
    if not is_suspicious(before):
        return Diagnosis(before), None
    listed = list_hypotheses(chain, samples)
    candidates = list(_candidates(chain, ((each, _apply(each, samples, neighbourhood)) for each in listed)))
    misfit = float(nominal_misfits(chain, [samples])[0])
    trial = _Trial(chain, samples, sets, before, misfit, candidates, Diagnosis(before))
    largest = _largest_misfit(trial)
    found = _decisive(trial, [each for each in candidates if each.misfit <= largest])
    return (found, None) if _is_certain(found) else (Diagnosis(before), trial._replace(single=found))


def _find_pair(trial: _Trial) -> Diagnosis:
    """Look for two mistakes in measurements with positions, by which pairs are compared."""
    is_plausible = trial.misfit <= _LARGEST_MISFITS[trial.sets] and not leaves_residuals(trial.before)
    if not trial.misfit or (is_plausible and not trial.single.hypotheses):
        return trial.single
    pairs = _candidates(trial.chain, _changes_of_pairs(trial.candidates))
    near = nsmallest(_N_NEAR_PAIRS, pairs, key=lambda pair: pair.misfit)
    largest, closest = _largest_misfit(trial, near), list[_Candidate]()
    for pair in near:
        is_new = not any(_are_equal(pair, other) for other in closest)
        if pair.misfit <= largest and len(closest) < _N_CLOSEST_PAIRS and is_new:
            closest.append(pair)
    found = _decisive(trial, closest)
    if _is_certain(found):
        return found
    far = [each.hypothesis for each in trial.candidates if each.misfit > largest]
    return trial.single if set(trial.single.hypotheses).isdisjoint(far) else Diagnosis(trial.before)


def _find_one_or_two(chain: Chain, item: Measurement, sets: str) -> Diagnosis:
    """Look for one mistake or two in one measurement."""
    diagnosis, trial = _find_single(chain, [item], sets)
    return _find_pair(trial) if trial else diagnosis


def _changes_of_pairs(singles: Sequence[_Candidate]) -> Iterator[_Change]:
    """Yield pairs of mistakes with the samples after both changes, in one order if the order does not matter.

    Shifts of rows, which need the rows beside the samples, come first, as do units of one coordinate, which
    are listed if the coordinates as they were read suggest them. Rotations have one notation.
    """
    shifts = [each for each in singles if isinstance(each.hypothesis.change, RowShift)]
    joints = [each for each in singles if isinstance(each.hypothesis.change, JointChange)]
    values = [each for each in singles if not isinstance(each.hypothesis.change, RowShift | JointChange)]
    yield from starmap(_then, product(shifts, [*joints, *values]))
    moved = [change.joints for each in joints if isinstance(change := each.hypothesis.change, JointChange)]
    for i, j in permutations(range(len(joints)), 2):
        if i < j or moved[i] & moved[j]:
            yield _then(joints[i], joints[j])
    for joint, value in product(joints, values):
        # The change of joints is the faster one.
        yield both(joint.hypothesis, value.hypothesis), joint.hypothesis.apply(value.changed)
    for first, second in permutations(values, 2):
        changes = first.hypothesis.change, second.hypothesis.change
        if not isinstance(changes[1], AxisScale) and not all(isinstance(c, OtherNotation) for c in changes):
            yield _then(first, second)


def _then(first: _Candidate, second: _Candidate) -> _Change:
    """Return the hypothesis that two mistakes were made, with the samples after both changes."""
    return both(first.hypothesis, second.hypothesis), second.hypothesis.apply(first.changed)


def _candidates(chain: Chain, changes: Iterable[_Change]) -> Iterator[_Candidate]:
    """Compute the misfits of the changes that apply, of some of them at a time."""
    pairs = ((hypothesis, changed) for hypothesis, changed in changes if changed is not None)
    while part := list(islice(pairs, _N_TOGETHER)):
        misfits = nominal_misfits(chain, [changed for _, changed in part])
        yield from (_Candidate(*pair, misfit) for pair, misfit in zip(part, misfits.tolist(), strict=True))


def _largest_misfit(trial: _Trial, others: Sequence[_Candidate] = ()) -> float:
    """Return the largest misfit of a hypothesis that is tried."""
    smallest = min(trial.misfit, *(each.misfit for each in (*trial.candidates, *others)))
    return float(np.clip(_MAX_MISFIT_RATIO * smallest, _MIN_MISFIT, _LARGEST_MISFITS[trial.sets]))


def _are_equal(first: _Candidate, second: _Candidate) -> bool:
    """Return whether two hypotheses change the samples alike."""
    one, two = (
        [array for item in each.changed for array in (item.q, item.positions(), item.rotations())]
        for each in (first, second)
    )
    return all(a.shape == b.shape and np.allclose(a, b, 0, _TOLERANCE) for a, b in zip(one, two, strict=True))


def _decisive(trial: _Trial, candidates: Sequence[_Candidate]) -> Diagnosis:
    """Return the diagnosis with the best hypotheses if a robot fits the samples after their change."""
    scored = []
    for hypothesis, changed, _ in candidates:
        after = fit_evidence(trial.chain, changed, trial.sets)
        log = after.log * _count(trial.samples) / _count(changed) + hypothesis.log_jacobian(trial.samples)
        scored.append((log, hypothesis, after))
    best = max((log for log, _, _ in scored), default=-np.inf)
    ties = [(hypothesis, after) for log, hypothesis, after in scored if log >= best - _MAX_LOG_TIE]
    ties = [(hypothesis, after) for hypothesis, after in ties if not leaves_residuals(after)]
    if best - trial.before.log < _MIN_LOG_RATIO or not ties:
        return Diagnosis(trial.before)
    return Diagnosis(trial.before, tuple(hypothesis for hypothesis, _ in ties), ties[0][1])


def _is_certain(diagnosis: Diagnosis) -> bool:
    """Return whether a robot with errors of ordinary size fits the samples after the change."""
    return diagnosis.after is not None and not is_suspicious(diagnosis.after)


def is_suspicious(evidence: Evidence) -> bool:
    """Return whether measurements may be mixed up: they need large errors or leave large residuals."""
    return evidence.width >= _SUSPICIOUS_WIDTH or leaves_residuals(evidence)


def leaves_residuals(evidence: Evidence) -> bool:
    """Return whether no robot fits the measurements, however large its errors are."""
    return evidence.length_scale > _SUSPICIOUS_LENGTH or evidence.angle_scale > _SUSPICIOUS_ANGLE


def _count(data: Sequence[Measurement]) -> int:
    """Return the number of samples."""
    return sum(len(item.rows) for item in data)


def _apply(
    hypothesis: Hypothesis, samples: Sequence[Measurement], neighbourhood: Sequence[Measurement]
) -> list[Measurement] | None:
    """Apply a hypothesis to the samples; None if it does not apply to most of them."""
    if not isinstance(hypothesis.change, RowShift):
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
