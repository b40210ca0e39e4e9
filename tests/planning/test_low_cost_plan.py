"""Plans of photographs for a low-cost arm: poses that see the board and decide the signs of the joints."""

import numpy as np
import pytest
from paper_arms import photograph_plan

from dhcal_pin import Chain
from dhcal_pin.measurements.base import Noise
from dhcal_pin.measurements.mounting import MountedRig
from dhcal_pin.planning import PlannedImages, plan
from dhcal_pin.plausibility.signs import decide_signs

# Number of candidates, seeds of arms, and number of poses.
SERIES = [(60, [4], 15), pytest.param(150, range(6), 20, marks=pytest.mark.slow)]


@pytest.mark.parametrize(("candidates", "seeds", "count"), SERIES)
def test_planned_poses_decide_the_signs(candidates, seeds, count):
    options = {"min_share": 0.4, "joint_error": np.deg2rad(3)}

    def choose(chain: Chain, rig: MountedRig) -> np.ndarray:
        images, noise = PlannedImages(rig, **options), Noise(1e-3, np.deg2rad(0.5))
        found = plan(chain, count, images=images, noise=noise, candidates=candidates)
        assert "decide which joints" in found.notes[-1]
        return found.q

    for seed in seeds:
        shot = photograph_plan(seed, choose, is_on_wrist=bool(seed % 2))
        assert shot.images.n_images >= 0.5 * count, seed
        decision = decide_signs(shot.nominal, [shot.images])
        assert set(decision.turned) == set(shot.arm.wrong), seed
        assert not decision.open, seed
