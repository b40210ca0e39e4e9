"""The paper: its error factors, its simulations and its experiment (Cho, Ha, Lee and Park).

Everything here reproduces or checks the paper "Positioning Accuracy Improvement of Robots by Link Parameter
Calibration". Methods that other packages use do not belong here.
"""

from .experiment import PaperExperiment, paper_arm, run_experiment
from .factors import (
    alpf,
    apply_correction,
    differential_motion,
    error_factors,
    laf,
    ldf,
    link_vectors,
    pseudo_inverse_step,
    q_matrices,
    tail_matrices,
    thf,
    tool_error,
)
from .jacobian_check import Agreement, crosscheck
from .simulations import Simulation, simulate, simulation_rows

__all__ = [
    "Agreement",
    "PaperExperiment",
    "Simulation",
    "alpf",
    "apply_correction",
    "crosscheck",
    "differential_motion",
    "error_factors",
    "laf",
    "ldf",
    "link_vectors",
    "paper_arm",
    "pseudo_inverse_step",
    "q_matrices",
    "run_experiment",
    "simulate",
    "simulation_rows",
    "tail_matrices",
    "thf",
    "tool_error",
]
