"""Batches: many problems with the same unknowns and numbers of samples, solved at once by array operations.

`solver` states the problems and solves them. `chains` has the robots of a batch, and `qr` the triangular
systems.
"""

from .chains import ChainBatch
from .qr import TriangularSystemBatch
from .solver import BatchProblem, BatchResult, solve_batch

__all__ = [
    "BatchProblem",
    "BatchResult",
    "ChainBatch",
    "TriangularSystemBatch",
    "solve_batch",
]
