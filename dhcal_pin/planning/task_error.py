"""Predicted position error over a task, after measurements at any configurations.

Shapes: p unknowns, m configurations, n joints.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from .._frozen import frozen
from .._typing import Array
from .information import Information


@frozen(eq=False)
class TaskError:
    """Position error over a task."""

    information: Information  # Knowledge before the measurements about the p unknowns
    # Combinations of the unknowns whose variances sum to the mean squared position error, shape (p, w) [m].
    combinations: Array

    @classmethod
    def over(cls, information: Information, task: Array) -> TaskError:
        """Prepare the prediction over a task, with the parts of the error that only priors limit."""
        return cls(information, information.task_combinations(task))

    def observable_part(self, observable: Array) -> TaskError:
        """Return the part of the error that measurements determine."""
        return replace(self, combinations=observable.T @ (observable @ self.combinations))

    def after(self, q: Array) -> float:
        """Predict the error after measurements."""
        return self.after_first(q, [len(q)])[0]

    def after_first(self, q: Array, sizes: Iterable[int]) -> list[float]:
        """Predict the error after the first measurements of a sequence, for several numbers of them."""
        rows = self.information.rows(q).transpose(2, 1, 0)
        r, done, out = self.information.prior_factor, 0, []
        for size in sizes:
            r = np.linalg.qr(np.concatenate([r, rows[done:size].reshape(-1, r.shape[1])]), mode="r")
            done = size
            out.append(float(np.linalg.norm(np.linalg.solve(r.T, self.combinations))))
        return out
