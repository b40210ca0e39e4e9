"""Public names of dhcal_pin.estimation.batch; `__init__.py` loads each on first use."""

from .chains import ChainBatch as ChainBatch
from .qr import TriangularSystemBatch as TriangularSystemBatch
from .solver import BatchProblem as BatchProblem
from .solver import BatchResult as BatchResult
from .solver import solve_batch as solve_batch
