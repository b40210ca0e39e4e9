"""Random arms, instruments, sizes, conditions and options: calibrations end, and accepted ones are right."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from camera_setups import ARMS, simulate, tool_error, visible_corners, wrong_arm
from slow_cases import some_slow

from dhcal_pin import calibrate
from dhcal_pin.exceptions import DhcalError
from dhcal_pin.measurements import KINDS, CameraCorners, Measurement, Noise
from dhcal_pin.robot import Chain
from dhcal_pin.robot.conditions import Conditions
from dhcal_pin.se3 import exp6

# Numbers of samples and of images; the second half is more than searches draw at random.
SIZES, N_IMAGES = (25, 60, 120, 300, 700, 1500), (25, 60, 120, 260)
# Distances between points need touches of the same points.
OTHERS = [kind for kind in KINDS if kind not in ("camera", "point_distance")]


def photographed(arm: Chain, truth: Chain, n_images: int, rng: np.random.Generator) -> CameraCorners:
    """Return images of one or two cameras and boards, between which a camera or a board may have moved."""
    n_cameras, n_boards = rng.choice([1, 1, 2], 2)
    setup = simulate(
        arm,
        truth,
        rng,
        is_on_wrist=bool(rng.random() < 0.5),
        n_images=n_images,
        sigma=0.3,
        n_cameras=int(n_cameras),
        n_boards=int(n_boards),
    )
    if rng.random() < 0.6:
        return setup.images
    rig, entries = setup.exact.rig, str(rng.choice(["cameras", "boards"]))
    poses = list(getattr(rig, entries))
    poses[0] = replace(poses[0], pose=poses[0].pose @ exp6(rng.normal(0, 0.01, 6)))
    q = setup.exact.q[np.any(np.diff(setup.exact.q, axis=0, prepend=np.inf) != 0, 1)]
    first = int(rng.uniform(0.1, 0.9) * len(q))
    views = [
        *visible_corners(truth, rig, q[:first]),
        *visible_corners(truth, replace(rig, **{entries: tuple(poses)}), q[first:]),
    ]
    rows, camera, board, corner, pixels = (np.concatenate(each) for each in zip(*views, strict=True))
    names = [f"camera{i}" for i in camera], [f"board{i}" for i in board]
    return CameraCorners(
        rows, pixels + 0.3 * rng.standard_normal(pixels.shape), corner, setup.images.rig, *names
    )


def disturbed(item, rng):
    """Return samples with conditions, with a zero that changes, or with wrong joint values."""
    if item.is_contact or item.configurations_per_row != 1:
        return item
    m, n = item.q.shape
    columns = {
        "time": np.cumsum(rng.random(m)),
        "temperature": 25 + 5 * np.sort(rng.random(m)),
        "payload": rng.choice([0.0, 2.0, 5.0], m),
        "approach": rng.choice([-1.0, 0.0, 1.0], (m, n)),
    }
    # The corners of an image have one condition.
    names = [name for name in columns if rng.random() < 0.15 and (name == "time" or not item.n_images)]
    q, order = item.q.copy(), np.argsort(item.rows, kind="stable")
    if rng.random() < 0.25:
        q[order[int(m * rng.uniform(0.2, 0.8)) :], rng.integers(n)] += np.deg2rad(rng.choice([0.1, 0.5, 3]))
    if rng.random() < 0.2 and not item.n_images:
        is_wrong = rng.random(m) < rng.choice([0.02, 0.2])
        q[is_wrong] += rng.normal(0, 0.2, (int(is_wrong.sum()), n))
    recorded = Conditions(q, **{name: columns[name] for name in names}) if names else None
    return item.replace(q=q, recorded=recorded)


def random_case(seed, is_small):
    """Return a nominal arm, the true one, fitted and held-out measurements, and options."""
    rng = np.random.default_rng([seed, 4711])
    arm = ARMS[str(rng.choice(list(ARMS)))]()
    truth = wrong_arm(arm, float(rng.choice([1e-4, 1e-3])), rng)
    m, n_images = (int(rng.choice(each[: 2 if is_small else None])) for each in (SIZES, N_IMAGES))
    has_images = rng.random() < 0.5
    data: list[Measurement] = [photographed(arm, truth, n_images, rng)] if has_images else []
    for kind in rng.choice(OTHERS, int(rng.choice([0, 0, 1] if has_images else [1, 1, 2])), replace=False):
        q = rng.uniform(np.maximum(arm.lower, -2.5), np.minimum(arm.upper, 2.5), (m, arm.n_joints))
        noise = Noise(float(rng.choice([5e-5, 5e-4])), 1e-3)
        data.append(KINDS[str(kind)].simulate(truth, q, noise, rng))
    data, holdout = [disturbed(item, rng) for item in data], []
    if rng.random() < 0.25:
        drawn = []
        for item in data:
            group = item.sample_groups
            drawn.append((rng.random(int(group.max()) + 1) < 0.25)[group])
        holdout = [item.take(mask) for item, mask in zip(data, drawn, strict=True)]
        data = [item.take(~mask) for item, mask in zip(data, drawn, strict=True)]
    options: dict[str, Any] = {
        "loss": str(rng.choice(["auto", "auto", "auto", "linear", "huber", "tukey"])),
        "extend": str(rng.choice(["", "", "none"])),
        "session": str(rng.choice(["auto", "auto", "auto", "off", "unordered"])),
        "priors": str(rng.choice(["", "", "", "none"])),
    }
    return arm, truth, data, holdout, {name: value for name, value in options.items() if value}


@pytest.mark.parametrize(
    "seeds", some_slow([range(2), *(range(i, i + 10) for i in range(100, 200, 10))], {0})
)
def test_random_calibrations_end_and_accepted_ones_are_right(seeds):
    """Not one accepted arm is worse than the nominal one, or far worse than predicted."""
    for seed in seeds:
        arm, truth, data, holdout, options = random_case(seed, is_small=len(seeds) < 10)
        try:
            fit = calibrate(arm, data, holdout=holdout, **options)
        except DhcalError:
            continue
        assert np.isfinite(fit.x).all(), seed
        q = [item.q for item in data if item.configurations_per_row == 1]
        if fit.verdict.status == "ok" and q and fit.position_std > 0:
            chosen = np.random.default_rng(seed).permutation(np.concatenate(q))[:80]
            error, nominal = (tool_error(chain, truth, chosen) for chain in (fit.chain, arm))
            assert error < max(3 * fit.position_std, 5e-5), seed
            assert error < 1.1 * nominal + 2e-5, seed
