"""Diagnosis of mixed-up data: the hypotheses that explain measurements decisively better than their file.

First, the evidence of the measurements as they were read is computed. If they fit a robot with small errors,
no hypothesis is tried. The joint errors of the robot may be wrong instead of the measurements: the larger
evidence of the robot with and without them counts. Otherwise each hypothesis changes the same samples, and
its evidence is computed in the same way. A hypothesis is left out if it leaves the nominal robot much farther
from the measured poses than another one does: undoing a mistake takes its error away and adds none. A
hypothesis is decisive if its evidence exceeds that of the file by the factor exp(15), and if the robot fits
the changed samples as it fits ordinary measurements, with errors of ordinary size.

A robot with large errors fits a few rows with any joint values. A shift of the rows is therefore kept only if
its evidence exceeds by the same factor that of the same measured values with the joint values as they were
read, and with those of other rows at random.

If none is, the angle by which the zero of each joint is off is measured, and the factor that the values of
each joint or of all need, as with a wrong gear ratio. Each of them is a hypothesis, too: with
zeros that are wrong by tens of degrees a robot fits the measurements after a wrong quarter turn as well. A
measured angle that explains far more than the other hypotheses refutes them, but only a decisive one is
reported.

If none is, mistakes in the DH table of the robot are tried. The unit of a robot of impossible size is tried
first (`robot_files`).

If none is, all pairs of hypotheses are compared by the misfit of the nominal robot, and the evidence of the
closest ones is computed. Single hypotheses that need large errors of the robot remain only if no pair brings
the nominal robot much nearer: with errors of decimetres, a robot can fit exactly what a wrong hypothesis
makes of the measurements. Several hypotheses can describe the same change of the data, such as the sign of a
joint and the zeros of two others; all of them are reported.

If there is no such pair either, the base may have moved or something else may have happened during the
measurement. One event leaves at least two of three parts of the file without a change. A single hypothesis
that is found in two of them is therefore reported if it is decisive for the whole file, too, whatever
residuals the event leaves.

Robots with large errors, such as a hand-built arm with a wrong gear ratio, fit touches of unknown points and
few other measurements without positions. A ratio is therefore tried there even if a robot fits. Known
distances between touched points must leave a hypothesis decisive. All samples confirm it, or it is restricted
to a part of them (`confirmation`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from .._typing import Progress, no_progress
from ..measurements.base import Measurement
from ..robot.chain import Chain
from .diagnosis import NO_EVIDENCE, Diagnosis, is_suspicious, leaves_residuals
from .drawn_samples import comparable_items, draw_samples, fit_samples
from .evidence import MANUFACTURED
from .robot_files import find_wrong_lengths, find_wrong_table

if TYPE_CHECKING:
    from .trials import Trial

# Smallest number of samples of a part of a file.
_MIN_SAMPLES_PER_PART = 8
# Number of parts of a file.
_N_PARTS = 3


def diagnose_mixups(
    chain: Chain,
    data: Sequence[Measurement],
    sets: str = MANUFACTURED,
    progress: Progress | None = None,
    holdout: Sequence[Measurement] = (),
) -> Diagnosis:
    """Look for a mistake in measurements that explains why they do not fit the robot."""
    # Samples that are held out of the same files belong to the lines that contain a mistake.
    items = comparable_items(data)
    if not items:
        return Diagnosis(NO_EVIDENCE)
    lengths = [item for item in data if not item.configurations_per_row]
    found = _diagnose(chain, items, lengths, sets, progress or no_progress)
    if not (found.hypotheses or found.zero):
        return found
    from .confirmation import confirm, is_confirmed_by_lengths  # lazy import: few measurements have a mistake

    if found.hypotheses and lengths and not is_confirmed_by_lengths(chain, found, items, lengths, sets):
        return Diagnosis(found.before)
    return confirm(chain, found, [*items, *comparable_items(holdout)], sets)


def _diagnose(
    chain: Chain,
    items: Sequence[Measurement],
    lengths: Sequence[Measurement],
    sets: str,
    report: Progress,
) -> Diagnosis:
    """Look for one mistake or two in samples that are drawn from measurements."""
    diagnosis, trial = _find_single(chain, items, sets, report, lengths)
    if trial is None:
        return diagnosis
    # The mistake may be in one of several measurements.
    if len(items) > 1 and not trial.single.hypotheses:
        separate = [(item, _find_one_or_two(chain, item, sets, report)) for item in items]
        for item, one in separate:
            if one.hypotheses:
                return replace(one, source=item.source)
        if not any(one.is_suspicious for _, one in separate):
            return replace(diagnosis, fits_separately=True)
    found = trial.find_pair()
    if lengths and not found.hypotheses and trial.is_likely(trial.single):
        # A robot with large errors can touch unknown points after a wrong change: lengths must confirm it.
        return trial.single
    if found.hypotheses or len(items) > 1 or not leaves_residuals(found.before):
        return found
    if len(items[0].rows) < _N_PARTS * _MIN_SAMPLES_PER_PART:
        return found
    return trial.find_common(_find_in_parts(chain, items[0], sets, report))


def diagnose_images(chain: Chain, images: Sequence[Measurement], sets: str = MANUFACTURED) -> Diagnosis:
    """Look for a mistake in the joint positions of images that do not move as these say."""
    # Images of another camera have a base and a tool of their own: each file is examined alone.
    found: list[Diagnosis] = []
    for item in images:
        one = diagnose_mixups(chain, [item.tool_poses()], sets)
        named = tuple(each for each in one.hypotheses if each.concerns_joints)
        found.append(replace(one, hypotheses=named, source=item.source))
    first = next((one for one in found if one.hypotheses), Diagnosis(NO_EVIDENCE))
    is_common = all(one.hypotheses == first.hypotheses for one in found)
    return replace(first, source="") if is_common else first


def _find_in_parts(chain: Chain, item: Measurement, sets: str, progress: Progress) -> list[Diagnosis]:
    """Look for one mistake in each part of a measurement while a common one is still possible."""
    from .trials import MIN_PARTS  # lazy import: few measurements are suspicious

    found: list[Diagnosis] = []
    for n_left, part in zip(reversed(range(_N_PARTS)), _parts(item), strict=True):
        found.append(_find_alone(chain, part, sets, progress))
        if sum(bool(each.hypotheses) for each in found) + n_left < MIN_PARTS:
            break
    return found


def _parts(item: Measurement) -> list[Measurement]:
    """Divide a measurement into parts that follow each other."""
    order = np.argsort(item.rows, kind="stable")
    return [item.take(part) for part in np.array_split(order, _N_PARTS)]


def _find_single(
    chain: Chain,
    data: Sequence[Measurement],
    sets: str,
    progress: Progress,
    lengths: Sequence[Measurement] = (),
) -> tuple[Diagnosis, Trial | None]:
    """Look for one mistake in all of the measurements; return what was tried if it is not certain."""
    samples, neighbourhood = draw_samples(data)
    before = fit_samples(chain, samples, sets)
    # A long tool can take the place of links without lengths.
    if lengths_of_robot := find_wrong_lengths(chain, samples, sets, before):
        return lengths_of_robot, None
    is_fitting = not is_suspicious(before)
    if is_fitting and (before.chain is None or any(len(item.positions()) for item in samples)):
        return Diagnosis(before), None
    from .trials import try_hypotheses, try_ratios  # lazy import: few measurements are suspicious

    if is_fitting:
        samples = [*samples, *lengths]
        before = fit_samples(chain, samples, sets) if lengths else before
        # Distances may be between points that the drawn samples do not touch.
        if before.chain is None:
            return Diagnosis(before), None
        return try_ratios(chain, samples, sets, before, progress), None
    found, trial = try_hypotheses(chain, samples, neighbourhood, sets, before, progress)
    if trial and (table := find_wrong_table(chain, samples, sets, before)):
        return table, None
    return found, trial


def _find_alone(chain: Chain, item: Measurement, sets: str, progress: Progress) -> Diagnosis:
    """Look for one mistake in one measurement."""
    diagnosis, trial = _find_single(chain, [item], sets, progress)
    return trial.single if trial else diagnosis


def _find_one_or_two(chain: Chain, item: Measurement, sets: str, progress: Progress) -> Diagnosis:
    """Look for one mistake or two in one measurement."""
    diagnosis, trial = _find_single(chain, [item], sets, progress)
    return trial.find_pair() if trial else diagnosis
