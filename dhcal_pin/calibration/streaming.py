"""Calibration from more samples than memory holds, read part by part in every iteration.

Only the triangular factor R of the whitened rows [J | r] is needed to solve a step, and R of all rows
follows from the factors of the parts: QR of [R_1; R_2; ...]. Memory therefore does not grow with the number
of parts. The parts are read where they are factored, for example in other processes, and the result does
not depend on where.

The first part alone initializes base and tool frames, and determines the standard deviations that the
instrument does not state and the widths of the default priors. Outliers are not rejected (loss "linear").
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from typing import TypeVar

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..estimation.priors import Priors
from ..estimation.problem import Chunk, Problem
from ..estimation.solver import IterationCallback, SolverResult, minimize
from ..estimation.uncertainty import UNBOUNDED_TOL
from ..exceptions import InvalidArgumentError
from ..identifiability import explanations
from ..identifiability.null_space import ObservabilityProbe
from ..io.measurement_files import Part
from ..measurements.arguments import require_chain
from ..measurements.base import Measurement, instrument_values
from ..parallel import SERIAL, TaskExecutor
from ..robot.chain import Chain
from .presentation.residual_table import sigma_scales
from .procedure import Method, calibrate

_Value = TypeVar("_Value")


@frozen(eq=False)
class StreamProblem(Problem):
    """Least-squares problem whose samples are read again, part by part, whenever they are needed."""

    # Function that returns all parts in order; `data` is the first one.
    parts: Callable[[], Iterable[Part]] = tuple
    # Factors to the standard deviations of each residual group by name; None for 1.
    scales: Mapping[str, float] | None = None

    def map_chunks(self, function: Callable[[Chunk], _Value]) -> Iterator[_Value]:
        """Apply a function to each part."""
        return self.executor.map(
            partial(_apply_to_part, function, self.errors.chain, self.scales), self.parts()
        )


def _apply_to_part(
    function: Callable[[Chunk], _Value], nominal: Chain, scales: Mapping[str, float] | None, part: Part
) -> _Value:
    """Read a part, scale its standard deviations and apply a function to it."""
    item = _read(part).mounted(nominal)
    return function(Chunk(item.with_scaled_sigma(scales) if scales else item, nominal))


def _read(part: Part) -> Measurement:
    """Return the samples of a part, which may be a function that reads them."""
    return part() if callable(part) else part


@frozen(eq=False)
class StreamResult:
    """Calibration from a stream of samples."""

    #: Problem with the nominal chain, its base and tool as initialized from the first part, and p unknowns.
    problem: StreamProblem
    x: Array  #: Identified errors, (p,) [m or rad]
    chain: Chain  #: Calibrated chain
    solution: SolverResult  #: Solution of `problem`
    n_samples: int  #: Number of samples
    #: RMS errors of all samples before, by name: "position" [m], "orientation" [rad].
    before: Mapping[str, float]
    after: Mapping[str, float]  #: RMS errors of all samples after

    @property
    def converged(self) -> bool:
        """Whether the last step was negligible."""
        return self.solution.converged

    @property
    def rank(self) -> int:
        """Number of observable directions in parameter space, without priors."""
        return self.solution.system.rank

    @property
    def unobservable(self) -> list[str]:
        """One sentence per group of parameters that the data cannot distinguish, with the reason."""
        return explanations.explain_unobservable(
            ObservabilityProbe(self.problem, self.x), self.solution.system
        )

    @cached_property
    def std(self) -> Array:
        """Standard deviations of x, (p,) [m or rad]; infinite if neither data nor a prior determine it."""
        root, unbounded = self.solution.system.sqrt_covariance(self.problem.weights)
        return np.where(np.sum(unbounded**2, 1) > UNBOUNDED_TOL, np.inf, np.linalg.norm(root, axis=1))


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
    progress: IterationCallback | None = None,
) -> StreamResult:
    """Identify the kinematic errors of a robot from samples of one kind that are never all in memory.

    All parts are read once per iteration.

    Args:
        chain: Nominal robot.
        parts: Function that returns the parts anew at each call, such as
            `lambda: iter_measurements("laser.csv", chain)`; parts of some thousand samples are best.
        parameters: Names of parameter sets, keys of `estimation.PARAMETER_SETS`; the chain's own default set
            if not given.
        method: "lm" (Levenberg-Marquardt), or "gn" for the Gauss-Newton iteration of the paper.
        priors: "default", "none", or standard deviations by parameter name or pattern.
        fix: Names of parameters or sets to hold at their nominal values.
        free: Names of single parameters of any set to identify as well.
        known: Values of instrument parameters by name [m or rad].
        max_iterations: Largest number of iterations of one solution.
        executor: Executor that reads and factors the parts.
        progress: Called after each iteration with its number and the cost.

    Returns:
        Calibrated chain with the errors of all samples.

    Raises:
        InvalidArgumentError: If there are no samples, or an instrument has parameters that are not known.
    """
    require_chain(chain)
    first = next(iter(parts()), None)
    if first is None:
        raise InvalidArgumentError("no measurements to fit; expected at least one part")
    head = _read(first).mounted(chain)
    known = known or {}
    if missing := [parameter.name for parameter in head.instrument_parameters if parameter.name not in known]:
        raise InvalidArgumentError(
            f"{head.kind}: {missing[0]} is unknown; a stream needs known instrument parameters, so give "
            "its value in `known`"
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
        extend="none",
        max_iterations=max_iterations,
    )
    problem = StreamProblem(
        fit.errors,
        (head,),
        fit.problem.weights,
        known,
        executor,
        parts=parts,
        scales=None if head.has_stated_sigma else sigma_scales(fit, 0),
    )
    solution = minimize(problem, method, fit.x, max_iterations, progress)
    calibrated = fit.errors.at(solution.x)
    n_samples, before, after = 0, {}, {}
    for count, sums in problem.map_chunks(
        partial(_squared_errors, (fit.nominal_refitted, calibrated), known)
    ):
        n_samples += count
        for total, part_sum in zip((before, after), sums, strict=True):
            for name, value in part_sum.items():
                total[name] = total.get(name, 0.0) + value
    before, after = (
        {name: float(np.sqrt(value / n_samples)) for name, value in total.items()}
        for total in (before, after)
    )
    return StreamResult(problem, solution.x, calibrated, solution, n_samples, before, after)


def _squared_errors(
    chains: tuple[Chain, ...], known: Mapping[str, float], chunk: Chunk
) -> tuple[int, list[dict[str, float]]]:
    """Return the number of samples of a part, and under each chain the sum of squared errors by name."""
    u, item = instrument_values(chunk.data, known), chunk.data
    return len(item.rows), [
        {name: float(np.sum(error**2)) for name, error in item.errors(chunk.frames(chain), u).items()}
        for chain in chains
    ]
