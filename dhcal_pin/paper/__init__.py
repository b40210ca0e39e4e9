"""The paper's equations, simulations and experiment."""
