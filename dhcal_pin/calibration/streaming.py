"""Calibration from more samples than memory holds, read part by part wherever the part is reduced."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, TypeVar

import numpy as np

from .._typing import Array
from ..estimation import qr
from ..estimation.priors import Priors
from ..estimation.problem import Chunk, Problem
from ..estimation.qr import posterior_sqrt_covariance
from ..estimation.solver import Progress, SolverResult, minimize
from ..exceptions import DhcalError
from ..identifiability import explanations
from ..io.measurement_csv import Part
from ..measurements.base import Measurement
from ..parallel import SERIAL, TaskExecutor
from ..robot.chain import Chain
from .procedure import Method, calibrate
from .result import Result

_Found = TypeVar("_Found")


@dataclass(frozen=True, eq=False)
class StreamProblem(Problem):
    """A problem whose samples come anew, part by part, each time that they are asked for.

    Attributes:
        parts: gives all parts from the first to the last; `data` is the first.
        scales: factors to the sigmas of the parts' groups of rows.
    """

    parts: Callable[[], Iterable[Part]] = tuple
    scales: Mapping[str, float] | None = None

    def map_chunks(self, function: Callable[[Chunk], _Found]) -> Iterator[_Found]:
        """What a function finds in each part, in order."""
        return self.executor.map(partial(_loaded, function, self.errors.chain, self.scales), self.parts())


def _loaded(
    function: Callable[[Chunk], _Found], nominal: Chain, scales: Mapping[str, float] | None, part: Part
) -> _Found:
    item = _read(part)
    return function(Chunk(item.with_scaled_sigma(scales) if scales else item, nominal))


def _read(part: Part) -> Measurement:
    return part() if callable(part) else part


@dataclass(frozen=True, eq=False)
class StreamResult:
    """What a stream told of a chain's errors.

    Attributes:
        problem: with the nominal chain, base and tool as the first part places them, and its p unknowns.
        x: (p,) identified errors, m and rad.
        chain: the calibrated chain.
        solution: the loop's end.
        n_samples: how many there were.
        before, after: RMS errors of all samples by group: "position" in m, "orientation" in rad.
    """

    problem: StreamProblem
    x: Array
    chain: Chain
    solution: SolverResult
    n_samples: int
    before: Mapping[str, float]
    after: Mapping[str, float]

    @property
    def converged(self) -> bool:
        """Whether the last step was too small to matter."""
        return self.solution.converged

    @property
    def rank(self) -> int:
        """Number of directions that the data see, without priors."""
        return qr.rank(self.solution.system.r)

    @property
    def unobservable(self) -> list[str]:
        """What the data cannot tell apart, one sentence a group."""
        return explanations.explain_unobservable(self.problem, self.x, self.solution.system)

    @cached_property
    def std(self) -> Array:
        """Standard deviations (p,) of x, m and rad; infinite where neither data nor a prior tell."""
        root, hidden = posterior_sqrt_covariance(self.solution.system, self.problem.weights)
        return np.where(np.sum(hidden**2, 1) > 1e-6, np.inf, np.linalg.norm(root, axis=1))


def calibrate_stream(
    chain: Chain,
    parts: Callable[[], Iterable[Part]],
    parameters: str | Iterable[str] | None = None,
    *,
    method: Method = "lm",
    priors: Priors | None = None,
    fix: Sequence[str] = (),
    free: Sequence[str] = (),
    known: Mapping[str, float] | None = None,
    max_iterations: int = 100,
    executor: TaskExecutor = SERIAL,
    progress: Progress | None = None,
) -> StreamResult:
    """Identifies a chain's errors from samples of one kind that are never all in memory.

    The first part alone places base and tool and tells sigmas that no instrument states; then all parts are
    read once an iteration. Memory does not grow with them, and the digits do not depend on `where`.

    Args:
        chain: the nominal robot.
        parts: gives the parts anew at each call, as `lambda: iter_measurements("laser.csv", chain)`; some thousand
            samples a part are best.
        parameters: sets of `parameters.SETS`; the chain's own default without it.
        method: "lm", or "gn" for the paper's loop.
        priors: "default", "none", or sigmas by name.
        fix: parameters or sets held at nominal.
        free: single parameters of any set added.
        known: values in m and rad of the instrument's unknowns by name.
        max_iterations: most steps of a loop.
        executor: what parts are shared out to.
        progress: called with the iteration and the cost.

    Raises:
        DhcalError: no part, an instrument with unknowns of its own, or what `calibrate` complains about.
    """
    first = next(iter(parts()), None)
    if first is None:
        raise DhcalError("no measurements to fit")
    head = _read(first)
    known = known or {}
    if missing := [unknown.name for unknown in head.instrument_parameters if unknown.name not in known]:
        raise DhcalError(
            f"{head.kind}: {missing[0]} is unknown; a stream needs surveyed instruments, so give it as known"
        )
    fit = calibrate(
        chain,
        head,
        parameters,
        method=method,
        priors=priors,
        fix=fix,
        free=free,
        known=known,
        loss="linear",
        max_iterations=max_iterations,
    )
    problem = StreamProblem(
        fit.errors, (head,), fit.problem.weights, known, executor, None, parts, _scales(fit, head)
    )
    solution = minimize(problem, method, fit.x, max_iterations, progress)
    end = fit.errors.at(solution.x)
    samples, before, after = 0, {}, {}
    for count, squares in problem.map_chunks(partial(_squares, (fit.nominal_refitted, end), known)):
        samples += count
        for total, found in zip((before, after), squares, strict=True):
            for name, value in found.items():
                total[name] = total.get(name, 0.0) + value
    before, after = (
        {name: float(np.sqrt(value / samples)) for name, value in total.items()} for total in (before, after)
    )
    return StreamResult(problem, solution.x, end, solution, samples, before, after)


def _scales(fit: Result, head: Measurement) -> dict[str, float] | None:
    """What the first part tells of its sigmas, where the instrument does not."""
    if head.has_stated_sigma:
        return None
    (used,) = fit.problem.data
    frames, u = (
        fit.chain.forward_kinematics(head.configurations()),
        fit.problem.instrument_values_of(head, fit.x),
    )
    plain, scaled = (item.residual(frames, u) for item in (head, used))
    return {
        name: float(np.linalg.norm(plain[rows]) / np.linalg.norm(scaled[rows])) or 1.0
        for name, rows in head.residual_groups.items()
    }


def _squares(
    chains: tuple[Chain, ...], known: Mapping[str, float], chunk: Chunk
) -> tuple[int, list[dict[str, Any]]]:
    """A part's number of samples, and its summed squared errors by group under each chain."""
    u, item = chunk.instrument_values(known), chunk.data
    return len(item.rows), [
        {name: float(np.sum(error**2)) for name, error in item.errors(chunk.frames(chain), u).items()}
        for chain in chains
    ]
