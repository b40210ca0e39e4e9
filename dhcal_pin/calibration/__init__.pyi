"""Public names of dhcal_pin.calibration; `__init__.py` loads each on first use."""

from .cross_validation import CrossValidation as CrossValidation
from .cross_validation import Generalization as Generalization
from .cross_validation import cross_validate as cross_validate
from .evaluation import Accuracy as Accuracy
from .evaluation import Comparison as Comparison
from .evaluation import ErrorStatistics as ErrorStatistics
from .evaluation import accuracy as accuracy
from .model_selection import Extension as Extension
from .model_selection import FamilyTrial as FamilyTrial
from .partition import Fold as Fold
from .partition import blocked_folds as blocked_folds
from .partition import k_fold as k_fold
from .partition import leave_one_group_out as leave_one_group_out
from .partition import split as split
from .presentation.residual_table import ResidualTable as ResidualTable
from .procedure import Method as Method
from .procedure import calibrate as calibrate
from .result import Result as Result
from .streaming import StreamResult as StreamResult
from .streaming import calibrate_stream as calibrate_stream
from .verdict import Verdict as Verdict
