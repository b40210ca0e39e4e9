"""Console output: the structure of a screen, the screens of the commands, and printing with rich.

Screens are built from results and contain text only. Computation of results does not belong here.
"""
