"""Public names of dhcal_pin.paper; `__init__.py` loads each on first use."""

from .experiment import PaperExperiment as PaperExperiment
from .experiment import paper_arm as paper_arm
from .experiment import run_experiment as run_experiment
from .factors import alpf as alpf
from .factors import apply_correction as apply_correction
from .factors import error_factors as error_factors
from .factors import laf as laf
from .factors import ldf as ldf
from .factors import link_vectors as link_vectors
from .factors import pseudo_inverse_step as pseudo_inverse_step
from .factors import tail_matrices as tail_matrices
from .factors import thf as thf
from .factors import tool_error as tool_error
from .jacobian_check import Agreement as Agreement
from .jacobian_check import crosscheck as crosscheck
from .simulations import Simulation as Simulation
from .simulations import simulate as simulate
from .simulations import simulation_rows as simulation_rows
