"""Least-squares estimation: error parameters, problem, QR factorization, solvers, robust weights, batches."""

from .batch import BatchProblem, BatchResult, solve_batch
from .error_model import ErrorModel, ErrorParameter
from .parameters import PARAMETER_SETS, select_parameters
from .priors import Priors
from .problem import Problem, linearize_and_factor
from .qr import TriangularSystem
from .robust import LOSSES, Loss
from .solver import METHODS, Progress, SolverResult, gauss_newton, levenberg_marquardt, minimize
from .uncertainty import Prediction, Predictor, Uncertainty

__all__ = [
    "LOSSES",
    "METHODS",
    "PARAMETER_SETS",
    "BatchProblem",
    "BatchResult",
    "ErrorModel",
    "ErrorParameter",
    "Loss",
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
    "minimize",
    "select_parameters",
    "solve_batch",
]
