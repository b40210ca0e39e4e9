"""Least-squares estimation: error parameters, problem, QR factorization, solvers, robust weights, batches."""

from .batch import BatchProblem, BatchResult, solve_batch
from .error_model import ErrorModel, ErrorParameter
from .parameters import PARAMETER_SETS, select_parameters
from .priors import Priors
from .problem import Problem, linearize_and_factor
from .qr import TriangularSystem
from .robust import LOSSES
from .solver import METHODS, Progress, SolverResult, gauss_newton, levenberg_marquardt
from .uncertainty import Prediction, Predictor, Uncertainty

__all__ = [
    "LOSSES",
    "METHODS",
    "PARAMETER_SETS",
    "BatchProblem",
    "BatchResult",
    "ErrorModel",
    "ErrorParameter",
    "Prediction",
    "Predictor",
    "Priors",
    "Problem",
    "Progress",
    "SolverResult",
    "TriangularSystem",
    "Uncertainty",
    "gauss_newton",
    "levenberg_marquardt",
    "linearize_and_factor",
    "select_parameters",
    "solve_batch",
]
