"""Trials of hypotheses about suspicious measurements: single ones and pairs, see `mixups`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from heapq import nsmallest
from itertools import islice, permutations, product, starmap
from typing import NamedTuple

import numpy as np

from .._typing import Array, Progress
from ..measurements.base import Measurement
from ..robot.chain import Chain
from .diagnosis import MIN_LOG_ADVANTAGE, MIN_LOG_RATIO, Diagnosis, is_fitted, leaves_residuals
from .evidence import HAND_BUILT, MANUFACTURED, Evidence, fit_evidence, fit_evidence_near
from .hypotheses import (
    AxisChange,
    AxisScale,
    Change,
    Hypothesis,
    JointChange,
    OtherNotation,
    RowShift,
    both,
    inner_revolute_joints,
    list_hypotheses,
    ratio_hypothesis,
    revolute_joints,
    zero_hypothesis,
)
from .misfit import MAX_MISFIT, nominal_misfits

# Hypotheses within this difference of the best one are reported beside it.
_MAX_LOG_TIE = 3.0
# Number of pairs of mistakes with the smallest misfits, and of those among them that change the samples
# differently, whose evidence is computed.
_N_NEAR_PAIRS, _N_CLOSEST_PAIRS = 60, 12
# Number of changes whose misfits are computed together.
_N_TOGETHER = 1024
# Samples are equal if no coordinate differs by more than this [m], [rad].
_TOLERANCE = 1e-6
# A hypothesis is left out if the misfit of the nominal robot exceeds the smallest one by this factor and the
# least limit, or if it exceeds the largest limit, which depends on the errors that the robot may have.
_MAX_MISFIT_RATIO, _MIN_MISFIT = 3.0, 0.01
_LARGEST_MISFITS = {MANUFACTURED: 0.2, HAND_BUILT: MAX_MISFIT}
# Number of parts of a file in which a mistake is found if it is in the whole file.
MIN_PARTS = 2
# A shift of the rows is tried if at least this share of the samples has a neighbouring row.
_MIN_SHIFTED_SHARE = 0.25
# Number of random pairings of measured and joint values that a shift of the rows has to exceed.
_N_PAIRINGS = 10
# Smallest angle by which the zero of a joint is called wrong [deg]. Smaller ones are errors of the robot,
# which the calibration corrects; from the second angle on they are named if its correction is implausible.
_MIN_ZERO, _MIN_LIKELY_ZERO = 9.0, 3.0
# Largest angle, steps in which it is searched, then reach and step around that of greatest evidence [deg].
_MAX_ZERO, _ZERO_STEPS, _FINE_ZERO_STEPS = 180.0, (20.0, 4.0, 1.0, 0.2), ((6.0, 2.0), (1.5, 0.5))
# The same of the ratio of true to read joint values, as 100 times its logarithm. Smaller ones are errors of
# the robot, which the calibration corrects.
_MAX_RATIO, _RATIO_STEPS, _FINE_RATIO_STEPS = 110.0, (5.0, 1.0, 0.2), ((1.5, 0.5), (0.3, 0.1))
_MIN_RATIO = 4.0
# Without positions each size needs a fit. Only the mistake is measured that explains measurements best with
# one of these sizes, and zeros only up to a smaller angle, in larger steps [deg].
_PROBED_RATIOS, _PROBED_ZEROS = (-5.0, 5.0), (-40.0, -20.0, -10.0, 10.0, 20.0, 40.0)
_MAX_FITTED_ZERO, _FITTED_ZERO_STEPS = 50.0, (10.0, 3.0)
# A ratio is refined if it brings the nominal robot nearer by this factor.
_MIN_RATIO_GAIN = 1.5
# Smallest difference from a quarter turn [deg]. Quarter turns are hypotheses of their own.
_MIN_TURN_DIFFERENCE = 5.0
# Phases of the progress.
SINGLES, PAIRS = "looking for mistakes in the measurements", "looking for pairs of mistakes"


# Hypothesis, and samples after its change; None if it does not apply to them.
_Change = tuple[Hypothesis, list[Measurement] | None]


class _Candidate(NamedTuple):
    """Hypothesis about samples, with the samples after its change."""

    hypothesis: Hypothesis
    changed: list[Measurement]
    misfit: float  # Misfit of the nominal robot after the change


# Logarithm of the evidence with a hypothesis, the hypothesis, and the evidence.
_Score = tuple[float, Hypothesis, Evidence]


class Trial(NamedTuple):
    """Suspicious samples, and what single hypotheses say about them."""

    chain: Chain
    samples: Sequence[Measurement]
    sets: str
    before: Evidence
    misfit: float  # Misfit of the nominal robot
    candidates: Sequence[_Candidate]
    single: Diagnosis  # Decisive hypotheses, with which the robot needs large errors, if any
    progress: Progress

    @property
    def compares_nominal(self) -> bool:
        """Whether the nominal robot shows sizes: not without positions, nor with zeros that are unknown."""
        return bool(self.misfit) and self.sets == MANUFACTURED

    def find_pair(self) -> Diagnosis:
        """Look for two mistakes in measurements with positions, by which pairs are compared."""
        if not any(item.has_length_scale for item in self.samples):
            # An arm with large errors can touch unknown points after a wrong change, too.
            return Diagnosis(self.before)
        is_plausible = self.misfit <= _LARGEST_MISFITS[self.sets] and not leaves_residuals(self.before)
        if not self.misfit or (is_plausible and not self.single.hypotheses):
            return self.single
        pairs = _candidates(self.chain, self._changes_of_pairs())
        near = nsmallest(_N_NEAR_PAIRS, pairs, key=lambda pair: pair.misfit)
        largest, closest = _largest_misfit(self, near), list[_Candidate]()
        for pair in near:
            is_new = not any(_are_equal(pair, other) for other in closest)
            if pair.misfit <= largest and len(closest) < _N_CLOSEST_PAIRS and is_new:
                closest.append(pair)
        found = _decide(self, _scores(self, closest, PAIRS))
        if found.is_certain:
            return found
        far = [each.hypothesis for each in self.candidates if each.misfit > largest]
        return self.single if set(self.single.hypotheses).isdisjoint(far) else Diagnosis(self.before)

    def is_likely(self, found: Diagnosis) -> bool:
        """Return whether a ratio explains samples without positions, and no other errors do."""
        if found.after is None or found.after.width > self.before.width:
            return False
        if not all(each.key.startswith("ratio:") for each in found.hypotheses):
            # Units of a joint and quarter turns change the values so far that large errors explain anything.
            return False
        # Several errors of a hand-built arm explain much, too.
        return found.log >= fit_evidence(self.chain, self.samples, HAND_BUILT).log + MIN_LOG_RATIO

    def find_common(self, parts: Sequence[Diagnosis]) -> Diagnosis:
        """Look for one mistake that several parts of the samples show, whatever residuals remain in all."""
        counts = Counter(hypothesis.key for part in parts for hypothesis in part.hypotheses)
        common = [each for each in self.candidates if counts[each.hypothesis.key] >= MIN_PARTS]
        found = _decide(self, _scores(self, common, SINGLES), is_partial=True)
        fits = [part.after for part in parts if part.after and found.hypotheses[:1] == part.hypotheses[:1]]
        return replace(found, part=max(fits, key=lambda each: each.log, default=None))

    def _changes_of_pairs(self) -> Iterator[_Change]:
        """Yield pairs of mistakes with the samples after both changes."""
        pairs = list(_pairs(self.candidates))
        for start in range(0, len(pairs), _N_TOGETHER):
            self.progress(PAIRS, start // _N_TOGETHER + 1, -(-len(pairs) // _N_TOGETHER))
            yield from starmap(_then, pairs[start : start + _N_TOGETHER])


def try_hypotheses(
    chain: Chain,
    samples: Sequence[Measurement],
    neighbourhood: Sequence[Measurement],
    sets: str,
    before: Evidence,
    progress: Progress,
) -> tuple[Diagnosis, Trial | None]:
    """Look for one mistake in suspicious samples; return what was tried if it is not certain."""
    listed = list_hypotheses(chain, samples)
    candidates = list(_candidates(chain, ((each, _apply(each, samples, neighbourhood)) for each in listed)))
    misfit = float(nominal_misfits(chain, [samples])[0])
    trial = Trial(chain, samples, sets, before, misfit, candidates, Diagnosis(before), progress)
    scores = _scores(trial, _near(trial, candidates), SINGLES)
    found = _decide(trial, scores)
    if not found.is_certain:
        changed = {j for hypothesis in found.hypotheses for j in hypothesis.offsets}
        # The zeros of a hand-built arm are unknown in any case.
        inner = inner_revolute_joints(chain) if sets == MANUFACTURED else []
        zeros = _measure_zeros(trial, inner, changed)
        large = [zero.candidate for zero in zeros if abs(zero.size) >= _MIN_ZERO]
        large += [ratio.candidate for ratio in _measure_ratios(trial)]
        scores += _scores(trial, _near(trial, large), SINGLES)
        measured = _decide(trial, scores)
        is_refuted = changed and set(measured.hypotheses).isdisjoint(found.hypotheses)
        if measured.is_certain or is_refuted:
            # A size that fits far better refutes other zeros, even if it is not certain itself.
            found = measured if measured.is_certain else Diagnosis(before)
        if not found.is_certain:
            small = [zero.candidate for zero in zeros if abs(zero.size) < _MIN_ZERO]
            likely = _decide(trial, [*scores, *_scores(trial, _near(trial, small), SINGLES)])
            if likely.is_certain:
                return Diagnosis(before, zero=likely), None
        if not misfit and trial.is_likely(measured):
            found = measured
    return (found, None) if found.is_certain else (Diagnosis(before), trial._replace(single=found))


def try_ratios(
    chain: Chain, samples: Sequence[Measurement], sets: str, before: Evidence, progress: Progress
) -> Diagnosis:
    """Look for a wrong gear ratio in samples without positions that a robot fits, with wrong lengths."""
    misfit = float(nominal_misfits(chain, [samples])[0])
    trial = Trial(chain, samples, sets, before, misfit, (), Diagnosis(before), progress)
    ratios = [] if misfit else [each.candidate for each in _measure_ratios(trial)]
    found = _decide(trial, _scores(trial, ratios, SINGLES))
    return found if found.is_certain else Diagnosis(before)


def _near(trial: Trial, candidates: Sequence[_Candidate]) -> list[_Candidate]:
    """Return the hypotheses that do not leave the nominal robot much farther away than others do."""
    largest = _largest_misfit(trial, candidates)
    return [each for each in candidates if each.misfit <= largest]


class _Measured(NamedTuple):
    """Mistake whose size is measured: an angle [deg], or 100 times the logarithm of a ratio."""

    of_size: Callable[[float], Hypothesis]
    size: float
    candidate: _Candidate


def _measured(trial: Trial, of_size: Callable[[float], Hypothesis], size: float) -> Iterator[_Measured]:
    """Yield a mistake with its size if it applies to the samples."""
    hypothesis = of_size(size)
    for candidate in _candidates(trial.chain, [(hypothesis, hypothesis.apply(trial.samples))]):
        yield _Measured(of_size, size, candidate)


def _measure_zeros(trial: Trial, joints: Sequence[int], changed: Collection[int]) -> list[_Measured]:
    """Return the zeros of joints that are wrong, by the angles of greatest evidence."""
    zeros = []
    kinds = {joint: partial(zero_hypothesis, trial.chain, joint) for joint in joints}
    # Zeros that were found to be wrong by a quarter turn may be wrong by any angle.
    wide = [kind for joint, kind in kinds.items() if trial.misfit or joint in changed]
    searches = [(kind, _MAX_ZERO, _ZERO_STEPS) for kind in wide]
    if not trial.misfit:
        probed = _most_explaining(trial, [*kinds.values()], _PROBED_ZEROS)
        searches += [(kind, _MAX_FITTED_ZERO, _FITTED_ZERO_STEPS) for kind in probed if kind not in wide]
    for of_angle, reach, steps in searches:
        best = _closest(trial, of_angle, reach, steps)
        is_quarter_turn = abs(best) > 45.0 and abs((best + 45.0) % 90.0 - 45.0) < _MIN_TURN_DIFFERENCE
        if abs(best) >= _MIN_LIKELY_ZERO and not is_quarter_turn:
            zeros += _measured(trial, of_angle, best)
    refined = _refine(trial, zeros, _FINE_ZERO_STEPS, _MIN_LIKELY_ZERO)
    if refined and not trial.misfit:
        least = fit_evidence(trial.chain, trial.samples, HAND_BUILT).log + MIN_LOG_ADVANTAGE
        logs = [fit_evidence(trial.chain, zero.candidate.changed, trial.sets).log for zero in refined]
        refined = [zero for zero, log in zip(refined, logs, strict=True) if log >= least]
    return refined


def _measure_ratios(trial: Trial) -> list[_Measured]:
    """Return the joint values that need a factor, of one joint or of all revolute ones."""
    groups, revolute = [[j] for j in range(trial.chain.n_joints)], revolute_joints(trial.chain)
    groups = [*groups, revolute] if len(revolute) > 1 else groups
    kinds = [partial(_ratio_of_logarithm, trial.chain, joints) for joints in groups]
    if not trial.compares_nominal:
        kinds = _most_explaining(trial, kinds, _PROBED_RATIOS)
    ratios = []
    for of_logarithm in kinds:
        best = _closest(trial, of_logarithm, _MAX_RATIO, _RATIO_STEPS)
        if abs(best) >= _MIN_RATIO:
            ratios += _measured(trial, of_logarithm, best)
    if trial.compares_nominal:
        ratios = [each for each in ratios if _MIN_RATIO_GAIN * each.candidate.misfit <= trial.misfit]
    return _refine(trial, ratios, _FINE_RATIO_STEPS, _MIN_RATIO)


def _most_explaining(
    trial: Trial, kinds: Sequence[Callable[[float], Hypothesis]], sizes: Sequence[float]
) -> list[Callable[[float], Hypothesis]]:
    """Return the kind of mistake that explains most at one of several sizes, if it explains anything."""
    logs = [_logs_near(trial, trial.before, _with_sizes(trial, kind, sizes)).max() for kind in kinds]
    is_explaining = max(logs, default=-np.inf) > trial.before.log + _MAX_LOG_TIE
    return [kinds[int(np.argmax(logs))]] if is_explaining else []


def _ratio_of_logarithm(chain: Chain, joints: Sequence[int], size: float) -> Hypothesis:
    """Return the hypothesis of a ratio by 100 times its logarithm."""
    return ratio_hypothesis(chain, joints, float(f"{np.exp(size / 100):.4g}"))


def _with_sizes(
    trial: Trial, of_size: Callable[[float], Hypothesis], sizes: Sequence[float]
) -> list[Sequence[Measurement]]:
    """Return the samples after the change of a mistake of each size."""
    return [of_size(size).apply(trial.samples) or trial.samples for size in sizes]


def _closest(
    trial: Trial, of_size: Callable[[float], Hypothesis], reach: float, steps: Sequence[float]
) -> float:
    """Return the size of a mistake, up to a reach, with which the samples fit best."""
    best = 0.0
    for step in steps:
        sizes = np.arange(best - reach, best + reach, step).round(1).tolist()
        costs = _costs(trial, _with_sizes(trial, of_size, sizes))
        best, reach = sizes[int(np.argmin(costs))], step
    return best


def _refine(
    trial: Trial, found: Sequence[_Measured], steps: Sequence[tuple[float, float]], smallest: float
) -> list[_Measured]:
    """Return the mistakes that are near, with the sizes of greatest evidence."""
    # The misfit of the nominal robot is smallest at another size if the robot has errors.
    largest, refined = _largest_misfit(trial, [each.candidate for each in found]), list[_Measured]()
    for of_size, best, candidate in found:
        if candidate.misfit > largest:
            continue
        near = fit_evidence(trial.chain, candidate.changed, trial.sets)
        for reach, step in steps:
            sizes = np.arange(best - reach, best + reach + step / 2, step).round(1).tolist()
            best = sizes[int(np.argmax(_logs_near(trial, near, _with_sizes(trial, of_size, sizes))))]
        if abs(best) >= smallest:
            refined += _measured(trial, of_size, best)
    return refined


def _costs(trial: Trial, variants: Sequence[Sequence[Measurement]]) -> Array:
    """Return the misfits of variants of the samples, or else their negative evidence."""
    if trial.compares_nominal:
        return nominal_misfits(trial.chain, variants)
    return np.array([-fit_evidence(trial.chain, each, trial.sets).log for each in variants])


def _logs_near(trial: Trial, near: Evidence, variants: Sequence[Sequence[Measurement]]) -> Array:
    """Return the logarithms of the evidence of variants of the samples, fitted from near another fit."""
    return np.array([fit_evidence_near(near, trial.chain, each, trial.sets).log for each in variants])


def _pairs(singles: Sequence[_Candidate]) -> Iterator[tuple[_Candidate, _Candidate]]:
    """Yield pairs of mistakes, in one order if the order does not matter."""
    shifts = [each for each in singles if isinstance(each.hypothesis.change, RowShift)]
    joints = [each for each in singles if isinstance(each.hypothesis.change, JointChange)]
    values = [each for each in singles if not isinstance(each.hypothesis.change, RowShift | JointChange)]
    # A turn of the frame beside another mistake is rare.
    values = [each for each in values if not _is_turn(each.hypothesis.change)]
    # Shifts of rows come first, as they need the rows beside the samples.
    yield from product(shifts, [*joints, *values])
    moved = [change.joints for each in joints if isinstance(change := each.hypothesis.change, JointChange)]
    for i, j in permutations(range(len(joints)), 2):
        if i < j or moved[i] & moved[j]:
            yield joints[i], joints[j]
    yield from product(joints, values)
    # Units of one coordinate come first, too: they are listed if the coordinates as they were read suggest
    # them. Rotations have one notation; two changes of axes that are a turn together are one hypothesis.
    for first, second in permutations(values, 2):
        if not isinstance(second.hypothesis.change, AxisScale) and not _are_one(first, second):
            yield first, second


def _is_turn(change: Change) -> bool:
    """Return whether a change turns the frame of the positions."""
    return isinstance(change, AxisChange) and change.is_turn


def _are_one(first: _Candidate, second: _Candidate) -> bool:
    """Return whether two changes of measured values are a single one."""
    one, other = first.hypothesis.change, second.hypothesis.change
    if isinstance(one, AxisChange) and isinstance(other, AxisChange):
        return one.is_right_handed == other.is_right_handed
    return isinstance(one, OtherNotation) and isinstance(other, OtherNotation)


def _then(first: _Candidate, second: _Candidate) -> _Change:
    """Return the hypothesis that two mistakes were made, with the samples after both changes."""
    last, start = second, first
    if isinstance(first.hypothesis.change, JointChange) and not isinstance(
        second.hypothesis.change, JointChange
    ):
        # The order does not matter; the change of joints is the faster one.
        last, start = first, second
    return both(first.hypothesis, second.hypothesis), last.hypothesis.apply(start.changed)


def _candidates(chain: Chain, changes: Iterable[_Change]) -> Iterator[_Candidate]:
    """Compute the misfits of the changes that apply, of some of them at a time."""
    pairs = ((hypothesis, changed) for hypothesis, changed in changes if changed is not None)
    while part := list(islice(pairs, _N_TOGETHER)):
        misfits = nominal_misfits(chain, [changed for _, changed in part])
        yield from (_Candidate(*pair, misfit) for pair, misfit in zip(part, misfits.tolist(), strict=True))


def _largest_misfit(trial: Trial, others: Sequence[_Candidate] = ()) -> float:
    """Return the largest misfit of a hypothesis that is tried."""
    smallest = min([trial.misfit, *(each.misfit for each in (*trial.candidates, *others))])
    return float(np.clip(_MAX_MISFIT_RATIO * smallest, _MIN_MISFIT, _LARGEST_MISFITS[trial.sets]))


def _are_equal(first: _Candidate, second: _Candidate) -> bool:
    """Return whether two hypotheses change the samples alike."""
    one, two = (
        [array for item in each.changed for array in (item.q, item.positions(), item.rotations())]
        for each in (first, second)
    )
    return all(a.shape == b.shape and np.allclose(a, b, 0, _TOLERANCE) for a, b in zip(one, two, strict=True))


def _scores(trial: Trial, candidates: Sequence[_Candidate], phase: str) -> list[_Score]:
    """Compute the evidence of the samples after the change of each hypothesis."""
    scored = []
    for step, (hypothesis, changed, _) in enumerate(candidates, 1):
        trial.progress(phase, step, len(candidates))
        after = fit_evidence(trial.chain, changed, trial.sets)
        log = after.log * _count(trial.samples) / _count(changed)
        log += hypothesis.log_jacobian(trial.chain, trial.samples)
        is_decisive = log >= trial.before.log + MIN_LOG_RATIO
        if is_decisive and hypothesis.row_step and not _exceeds_pairings(trial, changed, after):
            continue
        scored.append((log, hypothesis, after))
    return scored


def _exceeds_pairings(trial: Trial, changed: Sequence[Measurement], after: Evidence) -> bool:
    """Return whether a shift of the rows explains the same measured values better than other pairings do."""
    # A robot with large errors fits a few rows with any joint values. The first pairing is that of the file.
    pairs = zip(trial.samples, changed, strict=True)
    pairings = [[item.take(np.isin(item.rows, each.rows)) for item, each in pairs]]
    rng = np.random.default_rng(0)
    pairings += [[_shuffled(item, rng) for item in changed] for _ in range(_N_PAIRINGS)]
    least = after.log - MIN_LOG_RATIO
    return all(fit_evidence(trial.chain, each, trial.sets).log <= least for each in pairings)


def _shuffled(item: Measurement, rng: np.random.Generator) -> Measurement:
    """Return the measured values with the joint values of other rows."""
    q = item.configurations().reshape(item.configurations_per_row, len(item.rows), -1)
    return item.resample(rng.permutation(q, axis=1).reshape(-1, q.shape[-1]))


def _decide(trial: Trial, scored: Sequence[_Score], is_partial: bool = False) -> Diagnosis:
    """Return the diagnosis with the best hypotheses if a robot fits the samples after their change."""
    best = max((log for log, _, _ in scored), default=-np.inf)
    ties = [each for each in scored if each[0] >= best - _MAX_LOG_TIE]
    # If something else is wrong, too (`is_partial`), no robot needs to fit.
    ties = [each for each in ties if is_partial or is_fitted(each[2])]
    if best - trial.before.log < MIN_LOG_RATIO or not ties:
        return Diagnosis(trial.before)
    log, _, after = ties[0]
    hypotheses = tuple(hypothesis for _, hypothesis, _ in ties)
    return Diagnosis(trial.before, hypotheses, after, gain=log - trial.before.log)


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
