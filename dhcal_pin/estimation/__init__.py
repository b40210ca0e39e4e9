"""Least-squares estimation: error parameters, problem, QR factorization, solvers, robust weights, batches."""

from .batch import Batch, Solutions, solve
from .error_model import ErrorModel, Parameter
from .parameters import SETS, select
from .priors import Priors
from .problem import Problem, reduce
from .qr import Triangle
from .robust import LOSSES
from .solver import METHODS, Progress, Solution, gauss_newton, levenberg_marquardt
from .uncertainty import Prediction, Predictor, Uncertainty

__all__ = [
    "LOSSES",
    "METHODS",
    "SETS",
    "Batch",
    "ErrorModel",
    "Parameter",
    "Prediction",
    "Predictor",
    "Priors",
    "Problem",
    "Progress",
    "Solution",
    "Solutions",
    "Triangle",
    "Uncertainty",
    "gauss_newton",
    "levenberg_marquardt",
    "reduce",
    "select",
    "solve",
]
