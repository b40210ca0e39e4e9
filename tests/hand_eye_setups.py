"""Simulated hand-eye calibrations in which one thing is wrong."""

from dataclasses import replace

import numpy as np
from camera_setups import ARMS, Setup, simulate

from dhcal_pin import Chain, select_parameters
from dhcal_pin.calibration.evaluation import compute_errors
from dhcal_pin.measurements import CameraCorners

# What can be wrong.
FAULTS = (
    "nothing",
    "arm",
    "offsets",
    "size",
    "warped",
    "corners",
    "focal",
    "centre",
    "distortion",
    "rows",
    "lag",
)

# Standard deviation of an image coordinate [px].
SIGMA = 0.2


def shortest_tour(q: np.ndarray) -> list[int]:
    """Return the order of configurations in which each one is followed by the nearest one that is left."""
    order, left = [0], set(range(1, len(q)))
    while left:
        order.append(min(left, key=lambda i: float(np.sum((q[i] - q[order[-1]]) ** 2))))
        left.remove(order[-1])
    return order


def faulty_setup(
    name: str,
    fault: str,
    seed: int,
    *,
    is_on_wrist: bool,
    n_images: int = 30,
    sigma: float = SIGMA,
    severity: float = 1.0,
    spread: float = 0.5,
) -> tuple[Chain, CameraCorners, Setup]:
    """Simulate images of an arm that is trusted, with one of `FAULTS`, `severity` times its usual size.

    Returned are the nominal arm, the images with the rig as a user states it, and the set-up. The noise is
    `sigma` [px], and `spread` the standard deviation of the joint values [rad].
    """
    rng = np.random.default_rng(seed)
    chain = ARMS[name]()
    truth = chain
    if fault in ("arm", "offsets"):
        errors = select_parameters(chain, "placement" if fault == "arm" else "offset")
        std = np.array(
            [2e-3 if p.unit == "m" else 5e-3 if fault == "arm" else 8e-3 for p in errors.parameters]
        )
        truth = errors.at(severity * std * rng.standard_normal(len(std)))
    setup = simulate(
        chain, truth, rng, is_on_wrist=is_on_wrist, n_images=n_images, sigma=sigma, spread=spread
    )
    true, stated = setup.exact.rig, setup.images.rig
    lens = true.cameras[0].values.copy()
    if fault == "focal":
        lens[:2] *= 1 + 0.03 * severity * rng.choice([-1, 1])
    elif fault == "centre":
        lens[2:4] += severity * rng.choice([-20, 20], 2)
    elif fault == "distortion":
        lens[4:] = 0.0
    stated = replace(stated, cameras=(replace(stated.cameras[0], values=lens),))
    points = true.boards[0].points
    centred = points - points.mean(0)
    if fault == "size":
        points = points * (1 + 0.03 * severity * rng.choice([-1, 1]))
    elif fault == "warped":
        points = points + severity * 3e-3 * np.outer((centred[:, 0] / np.abs(centred).max()) ** 2, [0, 0, 1])
    elif fault == "corners":
        points = points + severity * rng.normal(0, 7e-4, points.shape)
    board = replace(true.boards[0], type="points", listed_points=points)
    # Images in the order of a tour, as a person takes them.
    q, number = np.unique(setup.images.q, axis=0, return_inverse=True)
    order = shortest_tour(q) if fault == "lag" else rng.permutation(len(q))
    tour = q[order]
    rank = np.argsort(order)[number.reshape(-1)]
    # The robot was still on its way to the stated joint values.
    lag = 0.05 * severity if fault == "lag" else 0.0
    actual = (1 - lag) * tour[rank] + lag * tour[np.maximum(rank - 1, 0)]
    exact = setup.exact.replace(q=actual, rig=replace(true, boards=(board,)))
    known = {p.name: p.nominal for p in exact.instrument_parameters}
    pixels = exact.values - compute_errors(truth, [exact], known)[0]["pixels"]
    pixels = pixels + sigma * rng.standard_normal(pixels.shape)
    rows = np.argsort(rank, kind="stable")
    if fault == "rows":
        rows = rows[rank[rows] < len(tour) - 1]
        rank = rank + 1
    images = CameraCorners(tour[rank[rows]], pixels[rows], setup.images.corner[rows], stated)
    return chain, images, setup
