"""Public names of dhcal_pin.estimation; `__init__.py` loads each on first use."""

from .batch import BatchProblem as BatchProblem
from .batch import BatchResult as BatchResult
from .batch import solve_batch as solve_batch
from .error_model import ErrorModel as ErrorModel
from .error_model import ErrorParameter as ErrorParameter
from .parameters import PARAMETER_SETS as PARAMETER_SETS
from .parameters import ParameterSet as ParameterSet
from .parameters import select_parameters as select_parameters
from .priors import Priors as Priors
from .problem import Problem as Problem
from .problem import linearize_and_factor as linearize_and_factor
from .qr import TriangularSystem as TriangularSystem
from .robust import LOSSES as LOSSES
from .robust import Loss as Loss
from .solver import METHODS as METHODS
from .solver import SolverResult as SolverResult
from .solver import gauss_newton as gauss_newton
from .solver import levenberg_marquardt as levenberg_marquardt
from .solver import minimize as minimize
from .uncertainty import Prediction as Prediction
from .uncertainty import Predictor as Predictor
from .uncertainty import Uncertainty as Uncertainty
