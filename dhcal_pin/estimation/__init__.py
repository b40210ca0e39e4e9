"""Least-squares estimation: error parameters, problem, QR, solvers, robust weights."""
