"""A kind of a user that observes the position of a point on any link."""

from typing import ClassVar

import numpy as np
import pytest
from robots import with_masses

import dhcal_pin as dh
from dhcal_pin._kernels.types import ObservationMatrix
from dhcal_pin.estimation import Problem, select_parameters
from dhcal_pin.estimation.problem import linearize_and_factor
from dhcal_pin.measurements.base import whitened_jacobian
from dhcal_pin.measurements.columns import length_columns
from dhcal_pin.measurements.groups import POSITION
from dhcal_pin.measurements.position import PointMeasurement
from dhcal_pin.measurements.validation import validated_array, validated_joint_positions

POINT = np.array([0.1, -0.2, 0.3])


class LinkPoint(PointMeasurement):
    """Positions of a known point of a link."""

    kind = "link_point"
    residual_groups: ClassVar = {"position": POSITION}
    COLUMNS = length_columns("positions", "x", "y", "z")

    def __init__(self, q, positions, body, pose, sigma=None):
        q = validated_joint_positions(q, "LinkPoint")
        super().__init__(q, validated_array(positions, (len(q), 3), "LinkPoint: positions"), sigma)
        self.__dict__.update(body=body, local=pose[:3, :3] @ POINT + pose[:3, 3])

    def replace(self, **values):
        """Return a copy that observes the same point."""
        copy = super().replace(**values)
        copy.__dict__.update(body=self.body, local=self.local, rig=self.rig)
        return copy

    @property
    def observed_body(self):
        """Number of the body that carries the point."""
        return self.body

    def point(self, frames):
        """Return the modelled points (3, m)."""
        x, y, z, origin = frames.bodies[self.body]
        return x * self.local[0] + y * self.local[1] + z * self.local[2] + origin

    def model(self, points, u):
        """Tool points are not used."""
        raise NotImplementedError

    def residual(self, frames, u):
        """Return the whitened residuals (3, m)."""
        return (self._values - self.point(frames)) * self._weights

    def observation_matrix(self, frames, u, residual):
        """Return the terms: the point moves with v + ω × (p - p_tool)."""
        lever, one = self.point(frames) - frames.tool[3], np.ones(len(self.rows))
        rows, components, coefficients = [], [], []
        for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
            rows += [i] * 3
            components += [i, 3 + j, 3 + k]
            coefficients += [one, lever[k], -lever[j]]
        weights = np.repeat(self._weights, 3, 0)
        return ObservationMatrix(
            np.array(rows), np.array(components), np.array(coefficients) * weights, self.body
        )

    def instrument_jacobian(self, frames, u):
        """Return an empty array: there are no unknowns."""
        return np.empty((0, 3, len(self.rows)))

    @classmethod
    def simulate(cls, chain, q, noise, rng):
        """Files and simulations are not needed here."""
        raise NotImplementedError


def measured(chain, q, link):
    body, pose = chain.link_in_body(link)
    exact = LinkPoint(q, np.zeros((len(q), 3)), body, pose)
    return LinkPoint(q, exact.point(chain.forward_kinematics(q)).T, body, pose, 1.0)


@pytest.mark.parametrize(
    ("robot", "number"), [("ur10", 1), ("ur10", 4), ("ur10", 6), ("mimicking", 2), ("mimicking", 3)]
)
def test_derivatives_of_a_point_on_a_link_equal_central_differences(robot, number, request):
    """With errors of all families, in front of the link and behind it; the R factor is that of these rows."""
    if robot == "ur10":
        chain = dh.Chain.from_urdf("example:ur10", tip="tool0")
    else:
        chain = with_masses(request.getfixturevalue("mimicking"), np.random.default_rng(1))
    rng, h = np.random.default_rng(number), 1e-5
    link = chain.urdf.joint(chain.moving_joints[number - 1]).child
    errors = select_parameters(chain, "placement,base,tool,offset,gain,harmonics,compliance,coupling")
    scale = np.array([1e-4 if p.unit == "rad/Nm" else 2e-2 for p in errors.parameters])
    x = scale * rng.normal(size=len(errors.parameters))
    q = rng.uniform(-2, 2, (5, chain.n_joints))
    data, none = measured(errors.at(x), q, link), np.empty(0)
    model = errors.derivative(x)
    frames = model[0].forward_kinematics(q)
    rows = whitened_jacobian(data, model, frames, none, data.residual(frames, none))
    for k, parameter in enumerate(errors.parameters):
        size = max(1.0, np.abs(rows[k]).max())
        step = h / size * np.eye(len(x))[k]
        up, down = (data.residual(errors.at(x + s * step).forward_kinematics(q), none) for s in (1, -1))
        np.testing.assert_allclose(rows[k] / size, -(up - down) / (2 * h), atol=1e-7, err_msg=parameter.name)
    found = linearize_and_factor(Problem(errors, (data,), np.zeros(len(x))), x, small_angle=False)
    flat = rows.reshape(len(x), -1)
    scale = 1 / np.maximum(np.linalg.norm(flat, axis=1), 1e-3)
    products = (found.r * scale).T @ (found.r * scale)
    np.testing.assert_allclose(products, (flat @ flat.T) * np.outer(scale, scale), atol=1e-10)


def test_points_on_an_inner_link_identify_the_joints_before_it():
    """Without noise, and nothing of the joints behind."""
    chain = dh.Chain.from_urdf("example:ur10", tip="tool0")
    rng = np.random.default_rng(0)
    errors = select_parameters(chain, "minimal")
    x = np.array([3e-3 if p.unit == "rad" else 1e-3 for p in errors.parameters]) * rng.normal(size=24)
    q = rng.uniform(-2, 2, (40, 6))
    data = measured(errors.at(x), q, "wrist_1_link")
    fit = dh.calibrate(chain, data, "minimal", priors="none", loss="linear")
    before = np.array([p.error_frame <= 6 for p in errors.parameters])
    behind = np.array([p.error_frame > 8 for p in errors.parameters])
    np.testing.assert_allclose(fit.x[before], x[before], atol=1e-9)
    assert np.abs(fit.x[behind]).max() < 1e-12
