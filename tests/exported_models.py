"""Models that `dhcal export` writes, compiled and loaded, for tests and benchmarks."""

import ctypes
import importlib.util
import subprocess
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np

from dhcal_pin import se3
from dhcal_pin.model_code import model_code
from dhcal_pin.robot import CONDITIONS, FAMILIES, Chain, Conditions, Payload
from dhcal_pin.robot.transmission import Transmission, coefficient_indices, n_coefficients

STRICT = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-Wvla"]
# Functions that ctypes can call; those of the header are static.
_WRAPPER = """
#include "model.h"
void place(const double *q, const double *c, double *pose);
void differentiate(const double *q, const double *c, double *pose, double *jacobian);
int reach(const double *target, const double *c, double *q);
void point(const double *pose, double *out);
void target(const double *point, double *out);
void torques(const double *q, double payload, double *out);
void place_many(const double *q, int m, double *pose);
void differentiate_many(const double *q, int m, double *pose, double *jacobian);
int reach_many(const double *targets, double *q, int m);
static model_conditions known(const double *c)
{
    model_conditions out;
    for (int i = 0; i < MODEL_JOINTS; i++)
        out.approach[i] = c[i];
    out.temperature = c[MODEL_JOINTS];
    out.payload = c[MODEL_JOINTS + 1];
    return out;
}
void place(const double *q, const double *c, double *pose)
{
    model_conditions all;
    if (c) all = known(c);
    model_forward_kinematics(q, c ? &all : NULL, pose);
}
void differentiate(const double *q, const double *c, double *pose, double *jacobian)
{
    model_conditions all;
    if (c) all = known(c);
    model_pose_and_jacobian(q, c ? &all : NULL, pose, jacobian);
}
int reach(const double *target, const double *c, double *q)
{
    model_conditions all;
    if (c) all = known(c);
    return model_inverse_kinematics(target, c ? &all : NULL, q);
}
void point(const double *pose, double *out) { model_measured_point(pose, out); }
void target(const double *point, double *out) { model_tip_target(point, out); }
void torques(const double *q, double payload, double *out) { model_gravity_torques(q, payload, out, NULL); }
void place_many(const double *q, int m, double *pose)
{
    for (int i = 0; i < m; i++)
        model_forward_kinematics(q + i * MODEL_JOINTS, NULL, pose);
}
void differentiate_many(const double *q, int m, double *pose, double *jacobian)
{
    for (int i = 0; i < m; i++)
        model_pose_and_jacobian(q + i * MODEL_JOINTS, NULL, pose, jacobian);
}
int reach_many(const double *targets, double *q, int m)
{
    int reached = 0;
    for (int i = 0; i < m; i++)
        reached += model_inverse_kinematics(targets + 16 * i, NULL, q + i * MODEL_JOINTS);
    return reached;
}
"""


def python_model(chain: Chain, folder: Path) -> ModuleType:
    """Write the model in Python and import it."""
    path = folder / "model.py"
    path.write_text(model_code(chain, path), encoding="utf-8")
    spec = importlib.util.spec_from_file_location("model", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _pointer(values: np.ndarray | None) -> ctypes.c_void_p | None:
    return None if values is None else values.ctypes.data_as(ctypes.c_void_p)


class CModel:
    """Model in C with the functions of the model in Python, for one sample."""

    def __init__(self, chain: Chain, folder: Path, compiler: str = "gcc", optimization: str = "-O0"):
        self.n, self.compiler = chain.n_joints, compiler
        self.defaults = chain.reference_temperature, chain.payload.mass if chain.payload else 0.0
        (folder / "model.h").write_text(model_code(chain, "model.h"), encoding="utf-8")
        (folder / "wrapper.c").write_text(_WRAPPER, encoding="utf-8")
        library = folder / f"{compiler}{optimization}.so"
        options = [*STRICT, optimization, "-shared", "-fPIC"]
        subprocess.run([compiler, *options, "wrapper.c", "-o", library.name, "-lm"], cwd=folder, check=True)
        self.library = ctypes.CDLL(str(library))

    def _conditions(self, approach, temperature, payload):
        if approach is temperature is payload is None:
            return None
        given = (temperature, payload)
        rest = [default if one is None else one for one, default in zip(given, self.defaults, strict=True)]
        return np.array([*(np.zeros(self.n) if approach is None else approach), *rest])

    def forward_kinematics(self, q, approach=None, temperature=None, payload=None):
        """Compute the pose of the tip."""
        pose, known = np.empty((4, 4)), self._conditions(approach, temperature, payload)
        self.library.place(_pointer(np.array(q, float)), _pointer(known), _pointer(pose))
        return pose

    def pose_and_jacobian(self, q, approach=None, temperature=None, payload=None):
        """Compute the pose of the tip and the body Jacobian."""
        pose, jacobian = np.empty((4, 4)), np.empty((6, self.n))
        q, known = np.array(q, float), self._conditions(approach, temperature, payload)
        self.library.differentiate(_pointer(q), _pointer(known), _pointer(pose), _pointer(jacobian))
        return pose, jacobian

    def inverse_kinematics(self, target, start, approach=None, temperature=None, payload=None):
        """Bring the tip to a target; return joint positions and whether they reach it."""
        target, q = np.ascontiguousarray(target, float), np.array(start, float)
        known = self._conditions(approach, temperature, payload)
        return q, bool(self.library.reach(_pointer(target), _pointer(known), _pointer(q)))

    def _convert(self, function, pose):
        pose, out = np.ascontiguousarray(pose, float), np.empty((4, 4))
        function(_pointer(pose), _pointer(out))
        return out

    def measured_point(self, pose):
        """Compute the pose of the measured point."""
        return self._convert(self.library.point, pose)

    def tip_target(self, point):
        """Compute the pose of the tip for a pose of the measured point."""
        return self._convert(self.library.target, point)

    def gravity_torques(self, q, payload=None):
        """Compute the torques of gravity."""
        q, out = np.array(q, float), np.empty(self.n)
        mass = self.defaults[1] if payload is None else payload
        self.library.torques(_pointer(q), ctypes.c_double(mass), _pointer(out))
        return out

    def forward_kinematics_of_all(self, q: np.ndarray) -> None:
        """Compute the poses at (m, n) positions, for clocks."""
        self.library.place_many(_pointer(q), len(q), _pointer(np.empty(16)))

    def pose_and_jacobian_of_all(self, q: np.ndarray) -> None:
        """Compute the poses and Jacobians at (m, n) positions, for clocks."""
        self.library.differentiate_many(
            _pointer(q), len(q), _pointer(np.empty(16)), _pointer(np.empty(6 * self.n))
        )

    def inverse_kinematics_of_all(self, targets: np.ndarray, start: np.ndarray) -> int:
        """Reach targets (m, 4, 4) from starts (m, n) and count those that are reached, for clocks."""
        return self.library.reach_many(_pointer(targets), _pointer(start.copy()), len(start))


def with_joint_errors(chain: Chain, rng: np.random.Generator, families=tuple(FAMILIES)) -> Chain:
    """Return a chain with all errors of some families, of the size of their priors."""
    indices = coefficient_indices(*chain.mimic_matrix.shape)
    coefficients = np.zeros(n_coefficients(*chain.mimic_matrix.shape))
    for name, family in FAMILIES.items():
        if name in families:
            entries = [c.entry for c in family.coefficients(chain, indices)]
            coefficients[entries] = family.prior * rng.standard_normal(len(entries))
    return chain.with_transmission(Transmission(coefficients, chain.loads))


def with_payload_and_frames(chain: Chain, rng: np.random.Generator) -> Chain:
    """Return a chain with a payload, another reference temperature, base and tool."""
    base, tool = se3.exp6(rng.standard_normal((2, 6)))
    chain = replace(chain, reference_temperature=23.5, base=base, tool=tool)
    return chain.with_payload(Payload(2.5, (0.02, -0.03, 0.1)))


def random_conditions(chain: Chain, m: int, rng: np.random.Generator) -> Conditions:
    """Draw joint positions and all conditions on which joint errors depend."""
    q = rng.uniform(-2.5, 2.5, (m, chain.n_joints))
    drawn = {
        name: condition.draw(rng, q.shape, chain.reference_temperature)
        for name, condition in CONDITIONS.items()
        if condition.draw
    }
    return Conditions(q, **drawn, payload=rng.uniform(0, 5, m))
