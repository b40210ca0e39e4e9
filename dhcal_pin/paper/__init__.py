"""The paper: its error factors, simulations and experiment (Cho, Ha, Lee, Park)."""

from .experiment import PaperExperiment, paper_arm, run_experiment
from .factors import (
    alpf,
    error_factors,
    laf,
    ldf,
    link_vectors,
    moved,
    pseudo_inverse_step,
    tail_matrices,
    thf,
    tool_error,
)
from .jacobian_check import Agreement, crosscheck
from .simulations import Simulation, simulate

__all__ = [
    "Agreement",
    "PaperExperiment",
    "Simulation",
    "alpf",
    "crosscheck",
    "error_factors",
    "laf",
    "ldf",
    "link_vectors",
    "moved",
    "paper_arm",
    "pseudo_inverse_step",
    "run_experiment",
    "simulate",
    "tail_matrices",
    "thf",
    "tool_error",
]
