"""Search for what happened during a session, from the residuals in the order of measurement.

The search alternates between two steps until nothing more is found:

1. A fit of the robot with all causes found so far. The weights of the samples have a bounded influence
   (Huber), so that outliers do not look like a cause and a cause does not make half of the samples outliers.
2. For all other causes, a score test from the inner products of the rows. With the columns A of a cause, of
   which the fit explains the part A·β, and residuals r of unit variance, the coefficients have the estimate
   M⁻¹·v with M = Aᵀ·A - Aᵀ·J·Q·Jᵀ·A and v = Aᵀ·r, where Q is the covariance of the unknowns of the fit. With
   the prior N(0, s²) in units of a displacement of the tool, the logarithm of the ratio of the evidences is

       ½·vᵀ·(M + s⁻²)⁻¹·v - ½·log det(1 + s²·M),

   of which the greatest over a grid of s counts. Steps between all samples are tested at once with cumulative
   sums of the inner products.

A cause is kept only if it also predicts blocks of consecutive samples that are left out, and if no function
of the configuration explains the samples as well as a function of time does.

Reference: P. J. Huber, Robust Estimation of a Location Parameter, Annals of Mathematical Statistics 35, 1964.

Shapes: N samples in the order of measurement, K cells of consecutive samples, k residuals, c columns.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from .. import se3
from .._frozen import frozen
from .._typing import Array
from ..estimation.problem import Problem
from ..estimation.robust import MAD_TO_STD
from ..measurements.base import Measurement, residual_of
from ..robot.chain import Chain
from .causes import Block, Cause, Constant, Drift, FreeDrift, Shape, Step
from .facts import (
    MAX_RANGE_ERROR,
    MAX_SCALE_CHANGE,
    Event,
    RangeError,
    Scale,
    Session,
    describe_lag,
    describe_scales_of_files,
)
from .linear_model import Layout, covariance_root, inverse, solve_information, whitened_rows
from .part_frames import place_parts, starts_of_parts
from .robot_changes import JointPaths, RobotChanges, apply_changes, update
from .timeline import Timeline, order_samples

# Largest numbers of samples that are examined, and of cells between which steps are tested; the same for the
# screening that decides whether to search.
MAX_SAMPLES, MAX_CELLS = 4000, 400
MAX_SCREENED_SAMPLES, MAX_SCREENED_CELLS = 200, 40
# Largest rise of the logarithm of the noise from the linear fit at the start to the end of a search.
MAX_NOISE_RISE = 0.1
# Largest number of samples among which a lag is looked for.
MAX_PATH_SAMPLES = 20_000
# Logarithm of the ratio of the evidences from which the screening calls for a search.
MIN_SCREENED_EVIDENCE = 2.0
# Weight below which a sample is an outlier, and share of them that calls for a search as well.
OUTLIER_WEIGHT, MAX_SCREENED_OUTLIERS = 0.5, 0.1
# Residual in standard deviations from which the influence of a sample is bounded.
HUBER_LIMIT = 2.0
# Widths of the prior of a cause, as displacements of the tool [m].
WIDTHS = 10.0 ** np.arange(-5.0, 0.5, 0.5)
# Smallest logarithm of the ratio of the evidences of the score test, for a fit with the cause.
MIN_PROPOSED_EVIDENCE = 2.0
# Largest cost of a sample beyond its number of rows: that of an outlier.
MAX_SAMPLE_COST = 16.0
# Smallest logarithm of the ratio of the evidences, and smallest RMS effect in standard deviations.
MIN_LOG_EVIDENCE, MIN_EFFECT = 12.0, 0.5
# Smallest share of the gain of a cause that left-out blocks have to show.
MIN_PREDICTED_SHARE = 0.4
# Number of these blocks, fewest of them on either side of a step, and most of them.
N_BLOCKS, MIN_BLOCKS, MAX_BLOCKS = 20, 6, 200
# Smallest logarithm of the ratio of the evidences of a change over time and over the configuration, and
# largest correlation of both orders that are compared.
MIN_ORDER_EVIDENCE, MAX_ORDER_CORRELATION = 4.0, 0.9
# Largest share of its evidence that a change over time keeps beside a function of the configuration which
# explains it. It was 0.96 to 2.2 where the base moved, and mostly below 0.9 along smooth paths.
MAX_REMAINING_SHARE = 0.9
# Largest share of outliers on the shorter side of a step: more of them are due to another event, or mistakes
# in single samples.
MAX_OUTLIER_SHARE = 0.25
# Logarithm of the ratio of the noises from which a search begins with a lag from some sample on.
MIN_LAG_GAIN = 0.5
# Smallest lag, relative to the time between samples.
MIN_LAG = 0.01
# Time constants of drifts, relative to the duration of the session.
TIME_CONSTANTS = (np.inf, 1.0, 0.7, 0.5, 0.35, 0.25, 0.18, 0.12)
# The same, of which the one that fits best is taken.
FINE_CONSTANTS = (np.inf, *np.geomspace(1.4, 0.08, 16))
# Smallest logarithm of the evidence and RMS effect of a cause that is accepted before the first fit.
MIN_GROSS_EVIDENCE, MIN_GROSS_EFFECT = 60.0, 3.0
# Gain in the logarithm of the likelihood from which a drift is exponential rather than linear.
MIN_CURVATURE_GAIN = 3.0
# Largest number of causes that are tried in vain.
MAX_REJECTED = 2
# Largest number of times that steps and time constants of drifts are changed.
MAX_MOVES = 4
# Largest number of causes, of iterations of a fit, and of passes of the weights in each iteration.
MAX_CAUSES, MAX_ITERATIONS, N_PASSES = 8, 8, 12
# Smallest noise in standard deviations of the measurements: a micrometre if they state none.
MIN_NOISE = 1e-3
# Passes end when no weight and no noise changes by more than this.
PASS_TOL = 0.01
# Smallest effect of a cause in the linear model for a fit with the cause: half of that of one that is kept.
MIN_LINEAR_EFFECT = 0.5 * MIN_EFFECT
# Share of the information about a cause that the fit leaves even if it can explain all of it.
MIN_UNEXPLAINED = 1e-8
# Two robots are named if they lower the logarithm of the noise by this, beyond what more parameters and steps
# of base, tool and joints do, and that of the residuals of the robot with fewer samples, too.
MIN_ROBOT_GAIN = 0.3
# Smallest number of rows of the robot with fewer samples for each unknown of its geometry.
MIN_ROBOT_ROWS = 2.5
# Fewer rows for each unknown show nothing but the unknowns.
MIN_ROWS_PER_UNKNOWN = 1.5
# The same for rows of different configurations with which scales and a lag are looked for.
MIN_DIFFERENT_ROWS_PER_UNKNOWN = 2.0
# Fewest samples on either side of a step.
MIN_SIDE = 3


@frozen(eq=False)
class LinearFit:
    """Fit of the linear model with weights of bounded influence."""

    rows: Array  # Whitened rows, (N, k, c)
    columns: Array  # Columns of the unknowns and causes of the fit, (N, k, p)
    residual: Array  # Residual after the fit, divided by the noise, (N, k)
    step: Array  # Step of the unknowns and causes, (p,)
    prior: Array  # Weights of their priors, (p,)
    score: Array  # Remaining derivative of the cost with equal weights and bounded residuals, (p,)
    weights: Array  # Weights of the samples, (N,)
    noise: Array  # Noise of each row in whitened units, (N, k)

    @cached_property
    def covariance(self) -> Array:
        """Covariance of the unknowns and causes with the weights of the samples, (p, p)."""
        root = self._covariance_root(np.sqrt(self.weights))
        return root @ root.T

    @cached_property
    def test_root(self) -> Array:
        """Square root C of their covariance CCᵀ with equal weights, (p, p)."""
        return self._covariance_root(np.ones(len(self.weights)))

    def _covariance_root(self, roots: Array) -> Array:
        """Return a square root of the covariance with given square roots of the weights, (p, p)."""
        scaled = self.columns * (roots[:, None] / self.noise)[..., None]
        return covariance_root(scaled.reshape(-1, len(self.prior)), self.prior)


class _Search:
    """State of a search."""

    def __init__(
        self, problem: Problem, x: Array, timeline: Timeline, is_ordered: bool, n_samples: int, n_cells: int
    ):
        """Prepare the samples in the order of measurement, linearize the model at x and fit it."""
        self.layout = Layout.of(problem)
        self.is_ordered = is_ordered
        self.timeline, self.chain = timeline, problem.errors.chain
        self.part = timeline.thinned(n_samples)
        self.order = np.argsort(self.part.fitted_numbers, kind="stable")
        self.numbers = self.part.fitted_numbers[self.order]
        self.times = self.part.fitted_times[self.order]
        # First sample of the robot, first sample of each cell, and N.
        self.begin = int(np.searchsorted(self.numbers, timeline.begin))
        n_cells = min(len(self.order) - self.begin, n_cells)
        self.edges = np.linspace(self.begin, len(self.order), n_cells + 1).astype(int)
        self.x = x
        self.changes = RobotChanges()
        self.causes: list[Cause] = []
        # Blocks and types of functions of time that were tried in vain.
        self.rejected: set[tuple[Block, type[Shape]]] = set()
        self.groups = self._noise_groups()
        # Numbers of the rows of each group, of all N·k.
        labels = self.groups.ravel()
        self.members = [np.flatnonzero(labels == label) for label in np.unique(labels[labels >= 0])]
        can_lag = is_ordered and sum(map(len, timeline.numbers)) <= MAX_PATH_SAMPLES
        self.paths = JointPaths(timeline) if can_lag else None
        # Repetitions show a change over time, but not one that is the same for all samples.
        n_different = sum(
            item.residual_dim * len(np.unique(item.configuration_groups)) for item in self.part.data
        )
        self.has_different_rows = n_different >= MIN_DIFFERENT_ROWS_PER_UNKNOWN * len(problem.weights)
        self.rows = self.linearize()
        self.layout = self.layout.restricted_to(self.rows)
        # Columns of all causes.
        self.tested = np.unique(np.concatenate([block.columns for block in self.layout.blocks]))
        self.first_fit = self.solve(self.rows, [])

    def _noise_groups(self) -> Array:
        """Label the rows that have one noise, (N, k); -1 for rows that a kind does not have."""
        items = self.part.data
        width, units = max(item.residual_dim for item in items), []
        labels = []
        for item in items:
            label = np.full((len(item.rows), width), -1)
            for group in item.residual_groups.values():
                key = (group.unit, item.has_stated_sigma)
                if key not in units:
                    units.append(key)
                label[:, : item.residual_dim][:, group.rows] = units.index(key)
            labels.append(label)
        return np.concatenate(labels)[self.order]

    def move_frames(self, changes: RobotChanges) -> None:
        """Begin with the steps of base and tool in given changes."""
        own = self._base()
        twists = {
            "base": se3.log6(se3.inverse(own) @ changes.base.poses @ own),
            "tool": se3.log6(changes.tool.poses),
        }
        self.causes = [
            Cause(block, Step(number), after - before, np.zeros((6, 6)))
            for block in self.layout.blocks
            if block.kind in twists
            for number, (before, after) in zip(
                getattr(changes, block.kind).steps, pairwise(twists[block.kind]), strict=True
            )
        ]
        self.changes = changes
        self.first_fit = self._fit()

    def move_lag(self) -> None:
        """Begin with a lag from some sample on."""
        block = next(block for block in self.layout.blocks if block.kind == "lag")
        self.causes = [Cause(block, Constant(), np.zeros(1), np.zeros((1, 1)))]
        fit = self.iterate(self._fit())
        if places := self._shapes(Step, ()):
            self._add(next(self._scores(fit, [block], places, self._products(fit))))
        self.first_fit = self._settle()

    # ------------------------------------------------------------------------------------------- fit
    def linearize(self) -> Array:
        """Return the whitened rows with the current unknowns and changes."""
        return self._linearized(self.changes, self.causes)

    def _linearized_without(self, i: int) -> Array:
        """Return the whitened rows with the current unknowns and all changes but those of a cause."""
        # Linear models at different motions of base or tool differ where only priors determine a direction.
        others = [*self.causes[:i], *self.causes[i + 1 :]]
        return self._linearized(self._changes_of(others), others)

    def _linearized(self, changes: RobotChanges, causes: Sequence[Cause]) -> Array:
        """Return the whitened rows with the current unknowns and some changes and causes."""
        data, _ = apply_changes(changes, self.chain, self.part, self.paths)
        rates = np.zeros((len(self.order), self.chain.n_joints))
        if self.paths is not None:
            numbers, times = self.part.fitted_numbers, self.part.fitted_times
            rates = self.paths.evaluate(numbers, times, changes.lag_at(numbers, times))[1]
        rows = whitened_rows(self.layout, self.x, data, rates)[self.order]
        for cause in causes:
            # A constant payload is part of the model, and changes nothing over time.
            if cause.block.is_of_values or _is_part_of_model(cause):
                rows[..., -1] -= cause.columns_of(rows, self.numbers, self.times) @ cause.values
        return rows

    def _columns(self, rows: Array, causes: Sequence[Cause], *others: Array) -> Array:
        """Return the columns of the unknowns, of causes, and others (N, k, ·), (N, k, ·)."""
        parts = [cause.columns_of(rows, self.numbers, self.times) for cause in causes]
        return np.concatenate([rows[..., self.layout.model], *parts, *others], -1)

    def _prior(self, causes: Sequence[Cause]) -> Array:
        """Return the weights of the priors of the unknowns and of causes, (p,)."""
        # A prior of one metre decides what the measurements do not show, such as turns of a point.
        return np.concatenate([self.layout.weights, *(1 / cause.sizes for cause in causes)])

    def _weighted_columns(
        self, fit: LinearFit, without: Cause, rows: Array, causes: Sequence[Cause]
    ) -> Array:
        """Return weighted columns of the unknowns and of causes, and the residual as if one were left out."""
        columns = self._columns(rows, causes, self._residual_without(rows, without)[..., None])
        columns *= (np.sqrt(fit.weights)[:, None] / fit.noise)[..., None]
        return columns

    def solve(self, rows: Array, causes: Sequence[Cause]) -> LinearFit:
        """Fit unknowns and causes to linearized rows."""
        return self._solve(rows, self._columns(rows, causes), causes)

    def _solve(self, rows: Array, columns: Array, causes: Sequence[Cause]) -> LinearFit:
        """Fit unknowns and causes with given columns (N, k, p), with weights of bounded influence."""
        residual, prior = rows[..., -1], self._prior(causes)
        value = np.concatenate([self.x, *(cause.values for cause in causes)])
        is_row = self.groups >= 0
        flat = columns.reshape(-1, columns.shape[-1])
        products = [part.T @ part for part in (flat.take(chosen, 0) for chosen in self.members)]
        noise, weights = np.ones(residual.shape), np.ones(len(rows))

        def information_with(weights: Array) -> Array:
            """Return the inner products of all rows; few samples have weights below 1."""
            total = sum(
                product / noise.flat[chosen[0]] ** 2
                for product, chosen in zip(products, self.members, strict=True)
            )
            is_low = weights < 1
            return total - _information(
                columns[is_low], np.sqrt(1 - weights[is_low])[:, None] / noise[is_low]
            )

        after = residual
        step = covariance = np.zeros(0)
        freedom = 1.0
        for _ in range(N_PASSES):
            information = information_with(weights)
            posterior = information + np.diag(prior**2)
            covariance = inverse(posterior)
            right = np.tensordot(residual * weights[:, None] / noise**2, columns, 2)
            # The inverse times a vector loses the digits of directions that only priors determine.
            step = solve_information(posterior, right - prior**2 * value)
            after = residual - columns @ step
            freedom = max(1 - float(np.sum(covariance * information)) / is_row.sum(), 0.05)
            last_noise, noise = noise, np.ones(residual.shape)
            for chosen in self.members:
                scale = MAD_TO_STD * np.median(np.abs(after.flat[chosen])) / np.sqrt(freedom)
                noise.flat[chosen] = max(scale, MIN_NOISE)
            size = np.sqrt(np.sum((after / noise) ** 2 * is_row, 1) / is_row.sum(1))
            previous, weights = weights, np.minimum(1.0, HUBER_LIMIT / np.maximum(size, 1e-12))
            if max(np.abs(weights - previous).max(), np.abs(noise / last_noise - 1).max()) < PASS_TOL:
                break
        # Variance of the bounded residuals, so that the score test keeps its level with outliers.
        bounded = (after / noise) * weights[:, None]
        variance = np.sum(bounded**2 * is_row) / (np.sum(is_row) * freedom)
        noise = np.maximum(noise * np.sqrt(variance), MIN_NOISE)
        residual = after / noise
        score = np.tensordot(residual * weights[:, None] / noise, columns, 2) - prior**2 * (value + step)
        return LinearFit(rows, columns, residual, step, prior, score, weights, noise)

    def iterate(self, fit: LinearFit) -> LinearFit:
        """Fit unknowns and causes until the steps are negligible, from a fit at their current values."""
        for _ in range(MAX_ITERATIONS):
            self._advance(fit)
            change = np.sqrt(np.mean((fit.columns @ fit.step / fit.noise) ** 2 * fit.weights[:, None]))
            fit = self._fit()
            if change < 0.05:
                break
        return fit

    def _fit(self) -> LinearFit:
        """Fit unknowns and causes once, and keep the rows at their current values."""
        self.rows = self.linearize()
        return self.solve(self.rows, self.causes)

    def _advance(self, fit: LinearFit) -> None:
        """Move unknowns and causes by the step of a fit."""
        p = len(self.x)
        base = self._base()
        self.x = self.x + fit.step[:p]
        steps, covariances, at = [], [], p
        for cause in self.causes:
            c = len(cause.values)
            steps.append(fit.step[at : at + c])
            covariances.append(fit.covariance[at : at + c, at : at + c])
            at += c
        self.changes = update(self.changes, self.causes, steps, base, self.layout.links)
        self.causes = [
            replace(cause, values=cause.values + step, covariance=covariance)
            for cause, step, covariance in zip(self.causes, steps, covariances, strict=True)
        ]

    @property
    def robot(self) -> Chain:
        """The robot at the current unknowns."""
        return self.layout.problem.chain(self.layout.errors_at(self.x))

    def _base(self) -> Array:
        """Return the pose of the base (4, 4) at the current unknowns [m]."""
        return self.robot.base

    # ------------------------------------------------------------------------------------------- test
    def best_cause(self, fit: LinearFit) -> Cause | None:
        """Return the cause of greatest evidence that is not in a fit."""
        return next(iter(self._ranked_causes(fit)), None)

    def _ranked_causes(self, fit: LinearFit) -> list[Cause]:
        """Return the causes that are not in a fit, that of greatest evidence first."""
        return sorted(self._candidates(fit), key=lambda cause: -cause.log_evidence)

    def _candidates(self, fit: LinearFit) -> Iterator[Cause]:
        """Yield the causes that are not in a fit, the function of time of greatest evidence of each."""
        products = self._products(fit)
        # Blocks with the same number of columns and the same functions of time are tested at once.
        alike: dict[tuple[type[Shape], int, tuple[int, ...], bool], list[Block]] = {}
        for block in self.layout.blocks:
            for kind in self._kinds(block):
                taken = self._taken_steps(block) if kind is Step else ()
                key = kind, len(block.columns), taken, block.changes_between_files
                alike.setdefault(key, []).append(block)
        for (kind, _, taken, is_between_files), blocks in alike.items():
            if shapes := self._shapes(kind, taken, is_between_files):
                yield from self._scores(fit, blocks, shapes, products)

    def _follows_configuration(self, i: int) -> bool:
        """Return whether a function of the configuration explains the samples as well in place of a cause."""
        # Errors of the arm that the model does not contain depend on the configuration. Along a smooth path
        # they change slowly over time, too.
        without = copy.copy(self)
        without.causes = [*self.causes[:i], *self.causes[i + 1 :]]
        fit = self.solve(self._linearized_without(i), without.causes)
        # The order of the samples does not change it.
        root = fit.test_root

        def changes(order: Array) -> list[Cause]:
            """Return the changes over the samples in an order."""
            names = ("rows", "columns", "residual", "weights", "noise")
            ordered = replace(fit, **{name: getattr(fit, name)[order] for name in names})
            vars(ordered)["test_root"] = root
            return [cause for cause in without._candidates(ordered) if not cause.block.is_of_recording]

        q = np.concatenate([item.q for item in self.part.data])[self.order]
        frames = [self.chain.forward_kinematics(item.conditions()) for item in self.part.data]
        heights = [np.concatenate([each.bodies[:, 3, 2], each.tool[3:, 2]]) for each in frames]
        # Gravity bends an arm in proportion to the direction of its links.
        rises = np.diff(np.concatenate(heights, 1)[:, self.order], axis=0)
        in_time = np.arange(len(q))
        # Samples without a time stay in front.
        kept, free = in_time[: self.begin], in_time[self.begin :]
        orders = [
            np.append(kept, free[np.argsort(values[self.begin :], kind="stable")])
            for values in (*q.T, *rises)
        ]
        # A joint that moved one way during the session does not tell the order from its position.
        correlations = [np.corrcoef(each[self.begin :], free)[0, 1] for each in orders]
        others = [
            each for each, c in zip(orders, correlations, strict=True) if abs(c) < MAX_ORDER_CORRELATION
        ]
        over_time = changes(in_time)
        needed = max((cause.log_evidence for cause in over_time), default=-np.inf) - MIN_ORDER_EVIDENCE
        own = _evidence_of(self.causes[i].block, over_time)
        for order in others:
            found = max(changes(order), key=lambda cause: cause.log_evidence, default=None)
            if found is None or found.log_evidence <= needed:
                continue
            # The evidence of a true change remains beside errors of the arm.
            columns = np.empty((*fit.residual.shape, len(found.values)))
            columns[order] = found.columns_of(fit.rows[order], self.numbers, self.times)
            added = replace(found, values=np.zeros_like(found.values))
            both = self._solve(fit.rows, np.concatenate([fit.columns, columns], -1), [*without.causes, added])
            if _evidence_of(self.causes[i].block, without._candidates(both)) < MAX_REMAINING_SHARE * own:
                return True
        return False

    def _effect(self, fit: LinearFit, cause: Cause) -> float:
        """Return the RMS effect of a cause on the residuals that it concerns, which other unknowns leave."""
        own = cause.columns_of(fit.rows, self.numbers, self.times) @ cause.values
        others = np.tensordot(own / fit.noise**2, fit.columns, 2)
        effect = (own - fit.columns @ (fit.test_root @ (fit.test_root.T @ others))) / fit.noise
        return float(np.sqrt(np.sum(effect**2) / (np.sum(self.groups >= 0) * self._concerned(cause))))

    def _concerned(self, cause: Cause) -> float:
        """Return the share of the samples on the shorter side of a step; 1 for other causes."""
        return self.part.shorter_side(cause.shape.number) if isinstance(cause.shape, Step) else 1.0

    def _products(self, fit: LinearFit) -> Array:
        """Return the products of tested columns with those of the fit, tested ones and residuals, by cell."""
        columns = np.concatenate([fit.columns, fit.rows[..., self.tested], fit.residual[..., None]], -1)
        columns /= fit.noise[..., None]
        columns[..., -1] = fit.residual * fit.weights[:, None]
        return _cell_products(columns, self.edges, slice(fit.columns.shape[-1], -1))

    def _kinds(self, block: Block) -> list[type[Shape]]:
        """Return the types of functions of time that are tested for a block."""
        kinds = block.shapes
        used = {type(c.shape) for c in self.causes if (c.block.kind, c.block.of) == (block.kind, block.of)}
        if block.is_of_recording:
            if not self._can_show_errors(block):
                return []
            if block.kind == "lag" and used:
                kinds = Step, Drift
        elif FreeDrift in used or not self.is_ordered:
            kinds = tuple(kind for kind in kinds if kind is Step)
        elif Drift in used:
            kinds = tuple(kind for kind in kinds if kind is not Drift)
        return [kind for kind in kinds if (block, kind) not in self.rejected]

    def _can_show_errors(self, block: Block) -> bool:
        """Return whether the samples can show an error of the recording."""
        if block.kind == "lag":
            return self.has_different_rows and self.paths is not None
        is_shown = self.timeline.has_consecutive_files or not block.changes_between_files
        return self.has_different_rows and is_shown

    def _taken_steps(self, block: Block) -> tuple[int, ...]:
        """Return the numbers of the samples at which a block has steps."""
        return tuple(c.shape.number for c in self.causes if c.block is block and isinstance(c.shape, Step))

    def _shapes(self, kind: type[Shape], taken: Sequence[int], is_between_files: bool = False) -> list[Shape]:
        """Return the functions of time of a type, which are equally likely, without steps near others."""
        if kind is Constant:
            return [Constant()]
        if kind is Step:
            inner = self.edges
            if is_between_files or not self.is_ordered:
                inner = np.searchsorted(self.numbers, self.timeline.file_starts)
            others = [self.begin, len(self.numbers), *np.searchsorted(self.numbers, taken).tolist()]
            inner = inner[np.abs(inner[:, None] - others).min(1) >= MIN_SIDE]
            return [Step(number) for number in self.numbers[inner].tolist()]
        begin, end = float(self.times[self.begin]), float(self.times[-1])
        if begin == end:
            return []
        if kind is FreeDrift:
            return [FreeDrift(begin, end)]
        return [Drift(begin, end, ratio * (end - begin)) for ratio in TIME_CONSTANTS]

    def _scores(
        self, fit: LinearFit, blocks: Sequence[Block], shapes: Sequence[Shape], products: Array
    ) -> Iterator[Cause]:
        """Yield the cause of greatest evidence among functions of time of each of several blocks."""
        own, p = np.searchsorted(self.tested, [block.columns for block in blocks]), fit.columns.shape[-1]
        firsts = self.edges[:-1]
        # Products of each cell, (K, B, c, ·).
        parts = [products[:, own[:, :, None], p + own[:, None]], products[:, own, -1], products[:, own, :p]]
        if isinstance(shapes[0], Step):
            steps = [shape.number for shape in shapes if isinstance(shape, Step)]
            ends = np.searchsorted(self.numbers[firsts], steps)
            inner, right, beside = (np.cumsum(part, 0)[ends - 1] for part in parts)
            # f is -1 before the step.
            right, beside = -right, -beside
        else:
            f = np.array([shape.values(self.numbers[firsts], self.times[firsts]) for shape in shapes])
            n_functions = f.shape[2]
            count = n_functions * own.shape[1]
            squares = f[:, :, :, None] * f[:, :, None]
            inner = np.moveaxis(np.tensordot(squares, parts[0], (1, 0)), 3, 1).swapaxes(3, 4)
            inner = inner.reshape(len(f), len(own), count, count)
            right, beside = (np.tensordot(f, part, (1, 0)).swapaxes(1, 2) for part in parts[1:])
            right = right.reshape(len(f), len(own), count)
            beside = beside.reshape(len(f), len(own), count, -1)
        sizes = np.tile([block.sizes for block in blocks], right.shape[2] // own.shape[1])
        explained = beside @ fit.test_root
        matrix = inner - explained @ explained.swapaxes(2, 3)
        matrix += MIN_UNEXPLAINED * inner * np.eye(sizes.shape[1])
        right = right - explained @ (fit.test_root.T @ fit.score)
        values, vectors = np.linalg.eigh(matrix * sizes[:, None] * sizes[:, :, None])
        values = np.maximum(values, 0.0)
        along = np.einsum("sbij,sbi->sbj", vectors, right * sizes)
        square = WIDTHS[:, None, None, None] ** 2
        gain = 0.5 * np.sum(along**2 * square / (1 + square * values) - np.log1p(square * values), -1)
        for i, block in enumerate(blocks):
            width, index = np.unravel_index(np.argmax(gain[:, :, i]), gain.shape[:2])
            log_evidence = float(gain[width, index, i])
            log_evidence -= float(np.log(len(shapes)) + np.log(len(self.layout.blocks)))
            scaled = along[index, i] / (values[index, i] + WIDTHS[width] ** -2)
            estimate = vectors[index, i] @ scaled * sizes[i]
            yield Cause(block, shapes[int(index)], estimate, np.zeros((len(estimate),) * 2), log_evidence)

    # ------------------------------------------------------------------------------------------- search
    def run(self) -> None:
        """Find all causes."""
        fit = self.first_fit
        gross = self.best_cause(fit)
        if gross and gross.log_evidence > MIN_GROSS_EVIDENCE and self._effect(fit, gross) > MIN_GROSS_EFFECT:
            self._add(gross)
            fit = self._fit()
        fit = self.iterate(fit)
        ranked = self._ranked_causes(fit)
        while ranked and len(self.causes) < MAX_CAUSES:
            found = ranked.pop(0)
            if found.log_evidence < MIN_PROPOSED_EVIDENCE:
                break
            if self._can_have_effect(fit, found):
                before = self.x, self.changes, [*self.causes]
                settled, evidence = self._settle_with(found)
                if evidence >= MIN_LOG_EVIDENCE:
                    fit, ranked = settled, self._ranked_causes(settled)
                    continue
                self.x, self.changes, self.causes = before
            self.rejected.add((found.block, type(found.shape)))
            if len(self.rejected) > MAX_REJECTED:
                break
        self._confirm()

    def _can_have_effect(self, fit: LinearFit, found: Cause) -> bool:
        """Return whether the linear model shows enough effect of a cause that is not in a fit."""
        if found.block.kind == "lag":
            return True  # Its effect is not linear.
        trial = copy.copy(self)
        trial.rows, trial.causes = fit.rows, [*self.causes]
        trial._add(found)
        with_cause = trial.solve(fit.rows, trial.causes)
        # A step concerns fewer samples than a drift.
        if trial._change_drifts(with_cause):
            with_cause = trial.solve(fit.rows, trial.causes)
        cause = trial.causes[-1]
        values = with_cause.step[-len(cause.values) :]
        return self._effect(fit, replace(cause, values=values)) >= MIN_LINEAR_EFFECT

    def _settle_with(self, found: Cause) -> tuple[LinearFit, float]:
        """Fit with one more cause and those of its outliers, and return the smallest evidence of them."""
        first, n_outliers = len(self.causes), np.inf
        while True:
            self._add(found)
            fit = self._settle()
            added = [i for i in range(first, len(self.causes)) if not _is_part_of_model(self.causes[i])]
            evidence = min(self._judge(self.rows, fit, i).log_evidence for i in added)
            # The samples behind another event are outliers of a step, until this event is found.
            share = max(self._outlier_share(fit, self.causes[i]) for i in added)
            last, n_outliers = n_outliers, int(np.sum(fit.weights < OUTLIER_WEIGHT))
            if evidence >= MIN_LOG_EVIDENCE or share <= MAX_OUTLIER_SHARE or n_outliers >= last:
                return fit, evidence
            best = self.best_cause(fit)
            if len(self.causes) >= MAX_CAUSES or not best or best.log_evidence < MIN_PROPOSED_EVIDENCE:
                return fit, evidence
            found = best

    def _remove(self, i: int) -> LinearFit:
        """Remove a cause, and fit without it."""
        del self.causes[i]
        stepping = {(c.block.kind, c.block.of) for c in self.causes if isinstance(c.shape, Step)}
        self.causes = [
            c for c in self.causes if not _is_part_of_model(c) or (c.block.kind, c.block.of) in stepping
        ]
        self._drop_others()
        return self._settle()

    def _add(self, cause: Cause) -> None:
        """Add a cause, with coefficients of zero."""
        # A step of the payload would imitate a part of a constant one, such as that of wrong masses, and a
        # wire may have had the wrong zero before its step.
        if cause.block.kind in ("payload", "wire"):
            constant = replace(cause, shape=Constant(), values=np.zeros_like(cause.values))
            if not any(each.block is cause.block and _is_part_of_model(each) for each in self.causes):
                self.causes.append(constant)
        self.causes.append(replace(cause, values=np.zeros_like(cause.values)))

    def _settle(self) -> LinearFit:
        """Fit, and move the steps to the samples where they fit best."""
        fit = self.iterate(self._fit())
        for _ in range(MAX_MOVES):
            if not (self._move_steps(fit) or self._change_drifts(fit)):
                break
            fit = self.iterate(self._fit())
        return fit

    def _change_drifts(self, fit: LinearFit) -> bool:
        """Replace each drift by the drift or step that fits best; return whether one changed."""
        n_rows, has_changed = float(np.sum(self.groups >= 0)), False
        for i, cause in enumerate(self.causes):
            old = cause.shape
            if not isinstance(old, Drift | FreeDrift):
                continue
            others = [*self.causes[:i], *self.causes[i + 1 :]]
            rows = self.linearize() if has_changed else self.rows
            simple, span = replace(cause, values=np.zeros(len(cause.block.sizes))), old.end - old.begin
            tried = [
                replace(simple, shape=Drift(old.begin, old.end, ratio * span)) for ratio in FINE_CONSTANTS
            ]
            if isinstance(old, FreeDrift):
                tried.append(cause)
            tried += [replace(simple, shape=step) for step in self._best_steps(cause, rows, others)]
            columns = self._weighted_columns(fit, cause, rows, [*others, *tried])
            flat = columns.reshape(-1, columns.shape[-1])
            products = flat.T @ flat
            prior = self._prior([*others, *tried])
            ends = len(prior) - np.cumsum([0, *(len(c.values) for c in reversed(tried))])[::-1]
            # Each coefficient costs the logarithm of the number of rows; a linear drift is the simplest one.
            costs = [
                _cost(products, products, prior, np.append(np.arange(ends[0]), np.arange(first, last)))
                + (last - first) * np.log(n_rows)
                for first, last in pairwise(ends)
            ]
            costs[0] -= 2 * MIN_CURVATURE_GAIN
            best = tried[int(np.argmin(costs))]
            if best.shape == old:
                continue
            self.causes[i] = best
            self._drop_others()
            has_changed = True
        return has_changed

    def _best_steps(self, drift: Cause, rows: Array, others: Sequence[Cause]) -> list[Step]:
        """Return the step of greatest evidence in place of a drift; none if no place is left."""
        block = drift.block
        places = self._shapes(Step, self._taken_steps(block)) if Step in self._kinds(block) else []
        if not places:
            return []
        fit = self.solve(self._undone(rows, drift), others)
        found = self._scores(fit, [block], places, self._products(fit))
        return [cause.shape for cause in found if isinstance(cause.shape, Step)]

    def _drop_others(self) -> None:
        """Drop the changes of causes that are not among the present ones."""
        self.changes = self._changes_of(self.causes)

    def _changes_of(self, causes: Sequence[Cause]) -> RobotChanges:
        """Return the current changes of some causes without those of others."""
        held = [np.zeros_like(cause.values) for cause in causes]
        return update(self.changes, causes, held, self._base(), self.layout.links)

    def log_noise(self, fit: LinearFit) -> float:
        """Return the mean logarithm of the noise of a fit."""
        return float(np.mean(np.log(fit.noise[self.groups >= 0])))

    def _undone(self, rows: Array, cause: Cause) -> Array:
        """Return the rows as if a cause had been left out of the model."""
        undone = rows.copy()
        undone[..., -1] = self._residual_without(rows, cause)
        return undone

    def _residual_without(self, rows: Array, cause: Cause) -> Array:
        """Return the residuals (N, k) as if a cause had been left out of the model."""
        return rows[..., -1] + cause.columns_of(rows, self.numbers, self.times) @ cause.values

    def _move_steps(self, fit: LinearFit) -> bool:
        """Move each step to where the samples before and after it fit best; return whether one moved."""
        has_moved = False
        for i, cause in enumerate(self.causes):
            if not isinstance(cause.shape, Step) or cause.block.changes_between_files:
                continue
            change = fit.rows[..., cause.block.columns] @ cause.values / fit.noise
            old, number = cause.shape.number, self._best_place(fit, change, cause.shape.number)
            if number != old:
                self.causes[i] = replace(cause, shape=Step(number))
                self.changes = self.changes.with_step(cause.block.kind, cause.block.index, old, number)
                has_moved = True
        return has_moved

    def _best_place(self, fit: LinearFit, change: Array, number: int) -> int:
        """Return the number of a sample before which a step with a change (N, k) fits best."""
        inner = np.arange(self.begin + MIN_SIDE, len(self.numbers) - MIN_SIDE + 1)
        if not self.is_ordered or not inner.size:
            return number
        is_after = self.numbers >= number
        after = np.where(is_after[:, None], fit.residual, fit.residual - change)
        costs = [_bounded_cost(r) for r in (after + change, after)]
        # Cost of a step behind each sample: `before` for the samples up to it, `after` behind.
        total = np.cumsum(costs[0] - costs[1])
        return int(self.numbers[int(inner[np.argmin(total[inner - 1])])])

    def _confirm(self) -> None:
        """Remove the causes that left-out blocks of samples do not show."""
        while self.causes:
            rows = self.linearize()
            full = self.solve(rows, self.causes)
            judged = [
                cause if _is_part_of_model(cause) else self._judge(rows, full, i)
                for i, cause in enumerate(self.causes)
            ]
            judged_ones = [i for i, cause in enumerate(judged) if not _is_part_of_model(cause)]
            worst = min(judged_ones, key=lambda i: judged[i].log_evidence)
            if judged[worst].log_evidence >= MIN_LOG_EVIDENCE:
                self.causes = judged
                changes = (i for i in judged_ones if not judged[i].block.is_of_recording)
                imitated = next((i for i in changes if self._follows_configuration(i)), None)
                if imitated is None:
                    break
                worst = imitated
            self._remove(worst)

    def _judge(self, rows: Array, full: LinearFit, i: int) -> Cause:
        """Return a cause with the evidence for it, given all others."""
        cause, others = self.causes[i], [*self.causes[:i], *self.causes[i + 1 :]]
        rows_without = self._linearized_without(i)
        without = self.solve(rows_without, others)
        # The same noise and weights for both.
        root = (np.sqrt(full.weights)[:, None] / full.noise)[..., None]
        stacks = (
            root * self._columns(rows_without, others, rows_without[..., -1:]),
            self._weighted_columns(full, cause, rows, [*others, cause]),
        )
        prior = self._prior([*others, cause])
        count = len(rows) - self.begin
        length = min(count / N_BLOCKS, count * self._concerned(cause) / MIN_BLOCKS)
        inside, predicted = _predicted_gain(stacks, prior, self.begin, length)
        effect = float(np.sqrt(max(inside, 0.0) / (np.sum(self.groups >= 0) * self._concerned(cause))))
        is_supported = predicted >= MIN_PREDICTED_SHARE * inside and effect >= MIN_EFFECT
        is_supported = is_supported and self._outlier_share(full, cause) <= MAX_OUTLIER_SHARE
        is_supported = is_supported and not self._is_negligible_lag(cause)
        evidence = self._log_evidence(cause, i, full, without) if is_supported else -np.inf
        return replace(cause, log_evidence=evidence)

    def _is_negligible_lag(self, cause: Cause) -> bool:
        """Return whether a cause is a lag that is too short to be one."""
        # Backlash between configurations at random looks like it: both follow the direction of motion.
        return cause.block.kind == "lag" and bool(
            abs(cause.values[0]) < MIN_LAG * np.median(np.diff(self.times))
        )

    def _outlier_share(self, fit: LinearFit, cause: Cause) -> float:
        """Return the share of outliers on the shorter side of a step, or among all samples."""
        is_outlier = fit.weights[self.begin :] < OUTLIER_WEIGHT
        if not isinstance(cause.shape, Step):
            return float(np.mean(is_outlier))
        is_before = self.numbers[self.begin :] < cause.shape.number
        side = is_before if 2 * is_before.sum() < len(is_before) else ~is_before
        return float(np.mean(is_outlier[side]))

    def _log_evidence(self, cause: Cause, i: int, full: LinearFit, without: LinearFit) -> float:
        """Return the logarithm of the ratio of the evidences with and without a cause."""
        limit = np.sum(self.groups >= 0, 1) + MAX_SAMPLE_COST
        costs = [
            float(np.sum(np.minimum(np.sum((fit.residual * fit.noise / full.noise) ** 2, 1), limit)))
            for fit in (without, full)
        ]
        start = len(self.x) + sum(len(c.values) for c in self.causes[:i])
        own, sizes = slice(start, start + len(cause.values)), cause.sizes
        information = inverse(full.covariance[own, own] / sizes / sizes[:, None]) - np.eye(len(sizes))
        values = np.maximum(np.linalg.eigvalsh(information), 0.0)
        square = WIDTHS[:, None] ** 2
        width = np.sum(np.log1p(square * values) + (cause.values / sizes) ** 2 / square, 1)
        n_places = {Step: len(self.edges), Drift: len(TIME_CONSTANTS)}.get(type(cause.shape), 1)
        prior = np.log(n_places) + np.log(len(self.layout.blocks))
        return 0.5 * (costs[0] - costs[1] - float(width.min())) - float(prior)

    # ------------------------------------------------------------------------------------------- after it
    def with_lag_alone(self) -> _Search | None:
        """Return a search with a lag as the only cause; None if there is no lag."""
        # The last samples of a path are near each other: a step imitates small errors of the lag there.
        lag = [cause for cause in self.causes if cause.block.kind == "lag"]
        if not lag:
            return None
        alone = copy.copy(self)
        alone.causes = lag
        alone._drop_others()
        alone._settle()
        return alone

    def corrected_timeline(self) -> Timeline:
        """Return the timeline with the joint positions at the times of the measured values."""
        fitted, held_out = apply_changes(self.changes, self.chain, self.timeline, self.paths)
        return replace(self.timeline, data=(*fitted, *held_out))

    def place_steps(self) -> None:
        """Move steps between two fitted samples to where the held-out samples between them fit best."""
        timeline, chain = self.timeline, self.robot
        values = self.layout.problem.instruments(self.layout.errors_at(self.x))
        held_out = timeline.numbers[timeline.n_fitted :]
        for i, cause in enumerate(self.causes):
            if not isinstance(cause.shape, Step) or cause.block.changes_between_files:
                continue
            old = cause.shape.number
            last = self.numbers[self.numbers < old].max(initial=-1)
            between = sorted(n for numbers in held_out for n in numbers.tolist() if last < n < old)
            costs = {}
            for new in (old, *between):
                changes = self.changes.with_step(cause.block.kind, cause.block.index, old, new)
                _, items = apply_changes(changes, self.chain, timeline, self.paths)
                costs[new] = 0.0
                for item, numbers in zip(items, held_out, strict=True):
                    part = item.take(np.isin(numbers, between))
                    if len(part.rows):
                        costs[new] += float(np.sum(np.abs(residual_of(part, chain, values))))
            best = min(costs, key=lambda number: costs[number])
            self.changes = self.changes.with_step(cause.block.kind, cause.block.index, old, best)
            self.causes[i] = replace(cause, shape=Step(best))

    def stated(self, cause: Cause) -> Cause:
        """Return a cause with the points whose motion is stated, if it is a motion of the base."""
        if cause.block.kind != "base" or not self.timeline.is_of_contacts:
            return cause
        number = cause.shape.number if isinstance(cause.shape, Step) else None
        values = self.layout.problem.instruments(self.layout.errors_at(self.x))
        points = [
            [values[f"point_{name}.{axis}"] for axis in "xyz"]
            for name in self.timeline.touched_points(number)
        ]
        base = self._base()
        in_base = (np.array(points) - base[:3, 3]) @ base[:3, :3]
        return replace(cause, block=replace(cause.block, touched=in_base))

    def _second_robot(
        self, rows: Array, others: Sequence[Cause], block: Block, number: int
    ) -> tuple[int, LinearFit]:
        """Fit two robots, one after the other, and find the first sample of the second one."""

        def solve(number: int) -> LinearFit:
            robot = Cause(block, Step(number), np.zeros(len(block.sizes)), np.empty((0, 0)))
            return self.solve(rows, [*others, robot])

        fit = solve(number)
        for _ in range(MAX_MOVES):
            change = fit.rows[..., block.columns] @ fit.step[-len(block.sizes) :] / fit.noise
            place = self._best_place(fit, change, number)
            if place == number:
                break
            number, fit = place, solve(place)
        return number, fit

    def _steps_of_all(self, number: int) -> list[Cause]:
        """Return steps of base, tool, payload and the zeros of all joints at a sample."""
        blocks = [b for b in self.layout.blocks if not b.is_of_recording and b.kind != "links"]
        return [Cause(b, Step(number), np.zeros(len(b.sizes)), np.empty((0, 0))) for b in blocks]

    def _gain_of_side(self, one: LinearFit, two: LinearFit, number: int, n_unknowns: int) -> float:
        """Return by how much a second robot lowers the logarithm of the residuals on the shorter side."""
        is_after = self.numbers >= number
        side = is_after if 2 * is_after.sum() < len(is_after) else ~is_after
        is_row = self.groups[side] >= 0
        if is_row.sum() < MIN_ROBOT_ROWS * n_unknowns:
            return -np.inf  # So few rows fit any robot.
        sizes = [np.median(np.abs(fit.residual * fit.noise)[side][is_row]) for fit in (one, two)]
        freedom = 1 - n_unknowns / is_row.sum()
        return float(np.log(sizes[0] / max(sizes[1], MIN_NOISE)) + 0.5 * np.log(freedom))

    def other_robot(self) -> Event | None:
        """Describe where the samples of a second robot begin, and what differs most; None for one robot."""
        rows = self.linearize()
        one, names = self.solve(rows, self.causes), self.layout.problem.errors.parameters
        # Where robots differ much, no single cause explains the second one, so that none was kept.
        tried = [c for c in self._candidates(one) if isinstance(c.shape, Step)]
        likely = [max(tried, key=lambda cause: cause.log_evidence)] if tried else []
        steps = sorted({c.shape.number for c in (*self.causes, *likely) if isinstance(c.shape, Step)})
        geometric = [c for c in self.layout.model if c < len(names) and names[c].coefficient_index is None]
        # The prior is that of one robot, see `solve`.
        sizes = np.array([names[c].prior for c in geometric])
        block = Block("robot", "", np.array(geometric), sizes)
        count = float(np.sum(self.groups >= 0))
        if count < len(self.layout.model) + len(sizes):
            return None  # Two robots fit so few samples whatever was measured.
        needed = 0.5 * len(sizes) * np.log(count) + MIN_ROBOT_GAIN * count
        best: tuple[float, int, LinearFit] | None = None
        for first in steps:
            others = [c for c in self.causes if c.shape != Step(first)]
            number, two = self._second_robot(rows, others, block, first)
            # One robot must not fit as well, nor one of which everything but the geometry of the arm changed.
            rivals = one, self.solve(rows, [*self.causes, *self._steps_of_all(number)])
            gain = count * min(float(np.mean(np.log(each.noise / two.noise))) for each in rivals)
            of_side = min(self._gain_of_side(each, two, number, len(sizes)) for each in rivals)
            if of_side > MIN_ROBOT_GAIN and gain > (best[0] if best else needed):
                best = gain, number, two
        if best is None:
            return None
        difference, std = best[2].step[-len(sizes) :], np.sqrt(np.diag(best[2].covariance)[-len(sizes) :])
        # The most significant difference of the arm itself.
        is_arm = self.layout.problem.errors.is_of_arm[geometric]
        worst = max(range(len(is_arm)), key=lambda i: (is_arm[i], abs(difference[i]) / std[i]))
        before, after = (self.timeline.place(best[1] + i) for i in (-1, 0))
        name, unit = names[geometric[worst]].name, names[geometric[worst]].unit
        size = abs(float(difference[worst]))
        return Event("robot", name, before, after, size, float(std[worst]), unit)


def _evidence_of(block: Block, causes: Iterable[Cause]) -> float:
    """Return the greatest evidence of a change of a block."""
    return max((cause.log_evidence for cause in causes if cause.block == block), default=-np.inf)


def _is_part_of_model(cause: Cause) -> bool:
    """Return whether a cause is a payload or a zero of all samples, which is fitted beside a step of it."""
    return cause.block.kind in ("payload", "wire") and isinstance(cause.shape, Constant)


def _information(columns: Array, root: Array) -> Array:
    """Return the inner products of columns (N, k, p) with square roots of weights (N, k) or (N, 1)."""
    flat = (columns * root[..., None]).reshape(-1, columns.shape[-1])
    return flat.T @ flat


def _predicted_gain(
    stacks: tuple[Array, Array], prior: Array, begin: int, length: float
) -> tuple[float, float]:
    """Return how much a cause reduces the cost: of all samples, and of left-out blocks of timed ones."""
    # Rows without the cause, and with its columns behind those of the others.
    inside, predicted = [], []
    n_timed = len(stacks[0]) - begin
    count = int(np.clip(n_timed / max(length, 1.0), 2, MAX_BLOCKS))
    edges = np.unique(np.linspace(0, n_timed, count + 1).astype(int))
    for stack in stacks:
        timeless = stack[:begin].reshape(-1, stack.shape[-1])
        parts = _cell_products(stack[begin:], edges)
        total = parts.sum(0) + timeless.T @ timeless
        used = np.arange(stack.shape[-1] - 1)
        inside.append(_cost(total, total, prior, used))
        predicted.append(float(np.sum(_cost(total - parts, parts, prior, used))))
    return inside[0] - inside[1], predicted[0] - predicted[1]


def _cost(kept: Array, out: Array, prior: Array, used: Array) -> Array:
    """Return the squared residuals with products `out`, for the fit of some columns to products `kept`."""
    own = np.ix_(used, used)
    x = -solve_information(kept[..., *own] + np.diag(prior[used] ** 2), kept[..., used, -1])
    along = out[..., *own] @ x[..., None] + 2 * out[..., used, -1:]
    return out[..., -1, -1] + np.sum(x[..., None] * along, (-2, -1))


def _bounded_cost(residual: Array) -> Array:
    """Return the cost of each sample, (N,), which grows linearly beyond the limit of influence."""
    size = np.sqrt(np.mean(residual**2, 1))
    return (size**2 - np.maximum(size - HUBER_LIMIT, 0.0) ** 2) * residual.shape[1]


def can_have_session(data: Sequence[Measurement]) -> bool:
    """Return whether all samples of the robot show where base and tool are, and there are such samples."""
    shown = [item.shows_changes for item in data if item.configurations_per_row]
    return any(shown) and all(shown)


def has_enough_rows(problem: Problem, timeline: Timeline) -> bool:
    """Return whether the samples that are searched have enough rows to show more than the unknowns."""
    n_rows = sum(item.residual_dim * len(item.rows) for item in timeline.thinned(MAX_SAMPLES).data)
    return n_rows >= MIN_ROWS_PER_UNKNOWN * len(problem.weights)


def find_session(problem: Problem, x: Array, holdout: Sequence[Measurement], is_ordered: bool) -> Session:
    """Find what happened during a session, from an approximate solution x (p,) with base and tool."""
    # Held-out measurements only count for the timeline. Without an order only files may differ.
    timeline, chain = order_samples(problem.data, holdout), problem.errors.chain
    nothing = Session(timeline, chain, is_ordered)
    if not has_enough_rows(problem, timeline):
        return nothing
    if not _is_suspicious(problem, x, timeline, is_ordered):
        return nothing
    # A large event may have shifted the solution, and the nominal robot may be far from the measurements.
    starts = [
        _Search(problem, start, timeline, is_ordered, MAX_SAMPLES, MAX_CELLS)
        for start in (np.zeros_like(x), x)
    ]
    parts = starts_of_parts(problem, x, timeline) if is_ordered else ()
    for each in dict.fromkeys((timeline.file_starts, parts)):
        if placed := place_parts(problem, timeline, each):
            moved, changes = placed
            fitted = timeline.with_fitted(moved.data)
            starts.append(_Search(moved, np.zeros_like(x), fitted, is_ordered, MAX_SAMPLES, MAX_CELLS))
            starts[-1].move_frames(changes)
    noises = [search.log_noise(search.first_fit) for search in starts]
    if starts[0].paths is not None and starts[0].has_different_rows:
        delayed = _Search(problem, np.zeros_like(x), timeline, is_ordered, MAX_SAMPLES, MAX_CELLS)
        delayed.move_lag()
        # Two more unknowns reduce the noise of anything else a little, too.
        if (noise := delayed.log_noise(delayed.first_fit)) < min(noises) - MIN_LAG_GAIN:
            starts, noises = [*starts, delayed], [*noises, noise]
    search = starts[int(np.argmin(noises))]
    search.run()
    # A search that ends in a wrong minimum says nothing.
    if search.log_noise(search.solve(search.linearize(), search.causes)) > min(noises) + MAX_NOISE_RISE:
        return nothing
    alone = search.with_lag_alone() if len(search.causes) > 1 else None
    if alone and not _is_suspicious(problem, alone.x, alone.corrected_timeline(), is_ordered):
        search = alone
    other_robot = search.other_robot()
    search.place_steps()
    causes = tuple(
        search.stated(cause)
        for cause in search.causes
        if cause.block.is_of_values or not _is_part_of_model(cause)
    )
    constants = [
        (cause.block.kind, float(cause.values[0]), float(np.sqrt(cause.covariance[0, 0])), cause.block.of)
        for cause in causes
        if isinstance(cause.shape, Constant)
    ]
    ranges = [
        RangeError(value, std)
        for kind, value, std, _ in constants
        if kind == "range" and abs(value) <= MAX_RANGE_ERROR
    ]
    return Session(
        timeline,
        search.chain,
        is_ordered,
        search.changes,
        causes,
        (other_robot,) if other_robot else (),
        lag=describe_lag(causes, search.changes, timeline),
        scales=(
            *(
                Scale(1 + value, std, axis)
                for kind, value, std, axis in constants
                if kind == "scale" and abs(value) <= MAX_SCALE_CHANGE
            ),
            *describe_scales_of_files(causes, timeline),
        ),
        range_error=next(iter(ranges), None),
    ).described()


def _is_suspicious(problem: Problem, x: Array, timeline: Timeline, is_ordered: bool) -> bool:
    """Return whether a test of a part of the samples calls for a search."""
    screening = _Search(problem, x, timeline, is_ordered, MAX_SCREENED_SAMPLES, MAX_SCREENED_CELLS)
    fit = screening.first_fit
    if np.mean(fit.weights < OUTLIER_WEIGHT) > MAX_SCREENED_OUTLIERS:
        return True
    found = screening.best_cause(fit)
    return found is not None and found.log_evidence > MIN_SCREENED_EVIDENCE


def _cell_products(rows: Array, edges: Array, some: slice = np.s_[:]) -> Array:
    """Return the inner products of some columns of each cell with all columns, (K, ·, c)."""
    if np.ptp(np.diff(edges)) == 0:
        cells = rows[edges[0] : edges[-1]].reshape(len(edges) - 1, -1, rows.shape[-1])
        return cells[..., some].swapaxes(1, 2) @ cells
    cells = (rows[a:b].reshape(-1, rows.shape[-1]) for a, b in pairwise(edges))
    return np.array([cell[:, some].T @ cell for cell in cells])
