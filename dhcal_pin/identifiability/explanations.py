"""What the data cannot tell apart, in words: which parameters, why, and what would tell them.

A reason is printed only after it was checked on the arm at hand: a combination is carried along the
chain, and where it passes a joint it must be a motion that this joint's own motion leaves as it is (see
`passage`). Where a check fails the plain fact remains. What would help is computed, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from .._typing import Array
from ..estimation import qr
from ..estimation.error_model import ErrorParameter
from ..estimation.problem import Problem, linearize_and_factor
from ..estimation.qr import TriangularSystem
from ..measurements.pose import Pose
from ..measurements.position import Position
from ..robot.chain import BASE_FRAME, Chain
from . import observability
from .null_space import Cause, ObservabilityProbe, UnobservableGroup, group_directions
from .propagation import (
    NEGLIGIBLE,
    PARALLEL_TOL,
    PlainErrors,
    Propagation,
    axes_acted_on,
    axis_angle_and_distance,
    propagate_along_chain,
)

# Axes within this of parallel are nearly so.
_NEARLY_PARALLEL_RAD = np.deg2rad(5.0)


# More names than these make no sentence.
_MAX_NAMES = 12


# Entries that count of the projector on what is weakly seen, each parameter in its expected spread.
_MIN_CORRELATION = 0.1


# What data without a length leave open.
SCALE_UNKNOWN = "the readings do not tell how large the robot is"


SCALE = (
    f"all lengths together: {SCALE_UNKNOWN}; priors alone do; a known distance of touched points would tell"
)


def join_names(names: Sequence[str]) -> str:
    """Names as in a sentence."""
    if len(names) > _MAX_NAMES:
        names = [*names[: _MAX_NAMES - 1], f"{len(names) - _MAX_NAMES + 1} more"]
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def _numbered(word: str, plural: str, numbers: Sequence[int], chain: Chain) -> str:
    """Joints or axes by their place from 1, with the joints' names where these do not tell it."""
    names = [chain.moving_joints[j - 1] for j in numbers]
    text = f"{word if len(numbers) == 1 else plural} {join_names([str(j) for j in numbers])}"
    told = all(str(j) in name for j, name in zip(numbers, names, strict=True))
    return text if told else f"{text} ({', '.join(names)})"


def _axes(numbers: Sequence[int], chain: Chain) -> str:
    return _numbered("axis", "axes", numbers, chain)


def _sum(names: Sequence[str], weights: Array) -> str:
    """A weighted sum, as `d2 + d3 - 0.5 a4`."""
    text = names[0]
    for name, weight in zip(names[1:], weights[1:] / weights[0], strict=True):
        size = abs(weight)
        factor = "" if abs(size - 1) < 1e-4 else f"{size:.3g} "
        text += f" {'+' if weight > 0 else '-'} {factor}{name}"
    return text


def _describe_frame(chain: Chain, station: int) -> str:
    if station == BASE_FRAME:
        return "the base"
    if station >= chain.tip_frame:
        return "the tool" if station == chain.tool_frame_index else "the tip"
    number = _numbered("joint", "joints", [station // 2], chain)
    return f"the origin of {number}" if station % 2 == 0 else f"the link behind {number}"


def _parallel(axes: Sequence[int], angle: float, chain: Chain) -> str:
    """That axes are parallel, exactly or to within an angle in rad."""
    within = "" if angle < PARALLEL_TOL else f" to within {np.rad2deg(angle):.2g}°"
    return f"{_axes(axes, chain)} are parallel{within}"


def _explain_propagation(chain: Chain, way: Propagation, parameters: Sequence[ErrorParameter]) -> str:
    """The geometric reason why a combination of parameters leaves the whole tool where it is."""
    if not (way.translation_joints or way.rotation_joints or way.crossed_prismatic_joints):
        stations = [p.error_frame for p in parameters]
        first, last = _describe_frame(chain, min(stations)), _describe_frame(chain, max(stations))
        return f"no joint moves between {first} and {last}" if first != last else f"they all act at {first}"
    axes = sorted(axes_acted_on(chain, parameters) | {*way.translation_joints, *way.rotation_joints})
    if not way.crossed_prismatic_joints and len(axes) == axes[-1] - axes[0] + 1 > 1:
        tilts = [axis_angle_and_distance(chain, i, j) for i, j in pairwise(axes)]
        if all(max(one) < PARALLEL_TOL for one in tilts):
            return f"{_axes(axes, chain)} lie on one line"
        worst = max(angle for angle, _ in tilts)
        if not way.rotation_joints and worst < NEGLIGIBLE:
            return _parallel(axes, worst, chain)
    motions = []
    if way.rotation_joints and way.rotation_joints == way.translation_joints:
        motions.append(f"a turn about and a shift along {_axes(way.rotation_joints, chain)}")
    else:
        motions += [f"a turn about {_axes(way.rotation_joints, chain)}"] if way.rotation_joints else []
        motions += [f"a shift along {_axes(way.translation_joints, chain)}"] if way.translation_joints else []
    if way.crossed_prismatic_joints:
        motions.append(
            f"a shift across {_axes(way.crossed_prismatic_joints, chain)} of a joint that only slides"
        )
    joints = (
        "that joint"
        if len({*way.rotation_joints, *way.translation_joints, *way.crossed_prismatic_joints}) == 1
        else "those joints"
    )
    look = "looks" if len(motions) == 1 and not (way.rotation_joints and way.translation_joints) else "look"
    return f"{' and '.join(motions)} {look} the same before and behind {joints}"


@dataclass(frozen=True, eq=False)
class Explainer:
    """Sentences on the unseen directions of one experiment.

    Attributes:
        probe: the problem, and where its Jacobian is taken.
        layers: of `Experiment.layers`.
        names: (p,).
        plain_errors: the robot's plain parameters, first among the names.
    """

    probe: ObservabilityProbe
    layers: dict[Cause, Array]
    names: list[str]
    plain_errors: PlainErrors

    def sentence(self, group: UnobservableGroup) -> str:
        """What a group's parameters have to do with each other, why, what is seen, what would help."""
        say = {"arm": self._arm, "instrument": self._instrument, "still": self._still, "poses": self._poses}
        reason, advice = say[group.cause](group)
        names = [self.names[i] for i in group.members]
        seen = self._describe_observable(group, names)
        if reason and all(name in seen for name in names):
            return f"{reason}: {seen}; {advice}"
        # Of too many names those that move most.
        order = np.argsort(-np.abs(group.vectors[group.members]).max(1), kind="stable")
        main = sorted(order[: _MAX_NAMES - 1]) + sorted(order[_MAX_NAMES - 1 :])
        return f"{join_names([names[i] for i in main])}: {reason + '; ' if reason else ''}{seen}; {advice}"

    def _describe_observable(self, group: UnobservableGroup, names: list[str]) -> str:
        """How much of the members can be seen, counted against all that cannot be for the same cause."""
        members, r = group.members, group.vectors.shape[1]
        _, s, vt = np.linalg.svd(self.layers[group.cause][members].T)
        lost = int(np.sum(s > NEGLIGIBLE))
        now = int(np.linalg.matrix_rank(self.layers["still"][members], NEGLIGIBLE))
        verb = "is" if now == lost else "can be"
        if r == len(members):
            return "the readings do not depend on it" if r == 1 else "the readings depend on none of them"
        if lost != r:
            return "what one changes the others undo" if r == 1 else f"{r} combinations of them stay unseen"
        if len(members) > r + 1:
            return (
                f"only {len(members) - r} combinations of the {len(members)} {verb.replace('is', 'are')} seen"
            )
        weights = vt[-1]
        if len({self._unit(i) for i in members}) > 1 or np.abs(weights).min() < 1e-6:
            return f"only one combination of the {len(members)} {verb} seen"
        return f"only {_sum(names, weights)} {verb} seen"

    def _unit(self, i: int) -> str:
        problem = self.probe.problem
        return (*problem.errors.parameters, *problem.instrument_parameters)[i].unit

    def _robot_part(self, group: UnobservableGroup) -> tuple[list[ErrorParameter], Propagation | None]:
        """The plain parameters of a group, and how it passes along the chain if these are all of it."""
        count = len(self.plain_errors.parameters)
        members = [i for i in group.members if i < count]
        way = (
            propagate_along_chain(self.plain_errors, group.vectors[:count])
            if len(members) == len(group.members)
            else None
        )
        return [self.plain_errors.parameters[i] for i in members], way

    def _arm(self, group: UnobservableGroup) -> tuple[str, str]:
        members, way = self._robot_part(group)
        robot = len(self.probe.problem.errors.parameters)
        if all(i < robot for i in group.members):
            advice = "no measurement of this arm tells more"
        else:
            advice = "more readings that depend on them may tell"
        if way is None or np.abs(way.tool_twists).max() > NEGLIGIBLE:
            return "", advice
        return _explain_propagation(self.plain_errors.chain, way, members), advice

    def _instrument(self, group: UnobservableGroup) -> tuple[str, str]:
        members, way = self._robot_part(group)
        chain = self.plain_errors.chain
        outside = len(group.members) > len(members)
        if members and all(p.error_frame == BASE_FRAME for p in members):
            if outside:
                return "the robot and the instrument can move as one", self._suggest_reading(group)
            return "the readings stay the same when the whole robot moves so", self._suggest_reading(group)
        if way is not None and np.abs(way.tool_twists[:, :3]).max() < NEGLIGIBLE:
            return (
                "the tool only turns about the measured point, and that is not read",
                self._suggest_reading(group),
            )
        last = len(chain.moving_joints)
        point = (chain.link_transforms[-1] @ chain.tool)[:2, 3]
        behind = all(
            self.plain_errors.bodies[i] >= last - 1
            for i in group.members
            if i < len(self.plain_errors.bodies)
        )
        if not outside and behind and not chain.prismatic[-1] and np.linalg.norm(point) < PARALLEL_TOL:
            reason = f"the measured point lies on {_axes([last], chain)} and does not move with it"
            aside = self.probe.with_offset_point().hypothetical_r_factor(range(chain.n_joints))
            other = "a point beside that axis or " if self._is_determined_by(aside, group) else ""
            return reason, other + self._suggest_reading(group)
        if self._is_scaling(group):
            return SCALE_UNKNOWN, self._suggest_reading(group)
        return "the readings stay the same", self._suggest_reading(group)

    def _is_scaling(self, group: UnobservableGroup) -> bool:
        """Whether a group makes the whole robot larger about some point, and does no more than that."""
        if group.vectors.shape[1] != 1 or len(group.members) < 2:
            return False
        path, count = self.plain_errors, len(self.plain_errors.parameters)
        robot = [i for i in group.members if i < len(self.probe.problem.errors.parameters)]
        if not robot or robot[-1] >= count:
            return False
        frames = path.chain.forward_kinematics(self.probe.draw(np.random.default_rng(0), 30))
        velocities = path.chain.tool_jacobian(frames, path.bodies, path.twists)[:, :3]
        moved = np.tensordot(group.vectors[:count, 0], velocities, 1)
        point = frames.tool[3]
        motions = [*(np.eye(3)[i][:, None] * np.ones_like(point) for i in range(3))]
        motions += [np.cross(np.eye(3)[i], point.T).T for i in range(3)]
        rows = np.array([point, *motions]).reshape(7, -1).T
        found, *_ = np.linalg.lstsq(rows, moved.ravel(), rcond=None)
        return bool(np.abs(rows @ found - moved.ravel()).max() < NEGLIGIBLE and abs(found[0]) > NEGLIGIBLE)

    def _is_determined_by(self, triangle: Array, group: UnobservableGroup) -> bool:
        """Whether a triangle sees all of a group's directions."""
        s = np.linalg.svd(triangle @ group.vectors, compute_uv=False)
        return bool(s.min() > 1e-8 * np.linalg.norm(triangle))

    def _suggest_reading(self, group: UnobservableGroup) -> str:
        """The least reading besides those at hand that would tell a group's directions."""
        position = any(len(item.positions()) for item in self.probe.problem.data)
        joints = range(self.plain_errors.chain.n_joints)
        if self._is_determined_by(self.probe.hypothetical_r_factor(joints, Position), group):
            return "the tool's position in a fixed frame would tell"
        if self._is_determined_by(self.probe.hypothetical_r_factor(joints, Pose), group):
            return f"the tool's {'orientation' if position else 'pose in a fixed frame'} would tell"
        return "other poses or readings may tell"

    def _still(self, group: UnobservableGroup) -> tuple[str, str]:
        names = [self.plain_errors.chain.joint_names[j] for j in self.probe.unmoved_joints()]
        return (
            f"{join_names(names)} never moved",
            f"moving {'it' if len(names) == 1 else 'them'} would tell more",
        )

    def _poses(self, group: UnobservableGroup) -> tuple[str, str]:
        problem, r = self.probe.problem, group.vectors.shape[1]
        samples = sum(len(item.rows) for item in problem.data)
        rows = self.probe.count_rows()
        if len(self.names) - self.layers["still"].shape[1] == rows:
            more = -(-r * samples // rows)
            return f"{rows} readings for {len(self.names)} unknowns", (
                f"at least {more} more {'pose is' if more == 1 else 'poses are'} needed"
            )
        free = [
            j
            for j in range(self.plain_errors.chain.n_joints)
            if self._is_determined_by(self.probe.hypothetical_r_factor([j]), group)
        ]
        where = join_names([self.plain_errors.chain.joint_names[j] for j in free]) if free else "the joints"
        return "the poses are too much alike", f"poses all over the range of {where} would tell"


def explain_unobservable(problem: Problem, x: Array, triangle: TriangularSystem) -> list[str]:
    """What the data cannot tell apart, why, and what would tell it; every unseen direction in one sentence.

    Args:
        problem: the unknowns and the data.
        x: (p,) the unknowns' values.
        triangle: of the data alone, at x or where the last step came from.

    Returns:
        Sentences; none where all is seen.
    """
    if qr.rank(triangle.r) == len(x):
        return []
    experiment = ObservabilityProbe(problem, x)
    # The last step, small as it is, turns unseen directions by more than other readings may: taken anew.
    here = linearize_and_factor(problem, x, small_angle=False).r
    layers = experiment.layers(here)
    path = PlainErrors.from_model(problem.errors, x[: len(problem.errors.parameters)])
    names = [p.name for p in (*problem.errors.parameters, *problem.instrument_parameters)]
    explainer = Explainer(experiment, dict(layers), names, path)
    found = [explainer.sentence(group) for group in _joined(group_directions(layers, path.error_frames))]
    untold = experiment.is_scale_unobservable(here) and not any(SCALE_UNKNOWN in text for text in found)
    return [SCALE, *found] if untold else found


def _joined(found: list[UnobservableGroup]) -> list[UnobservableGroup]:
    """Groups of which one combination each is seen, put together where they share a parameter."""
    out: list[UnobservableGroup] = []
    for group in found:
        for i, other in enumerate(out):
            both = UnobservableGroup(group.cause, np.concatenate([other.vectors, group.vectors], 1))
            chained = len(both.members) == both.vectors.shape[1] + 1
            if other.cause == group.cause and (chained or group.cause in ("poses", "still")):
                out[i] = both
                break
        else:
            out.append(group)
    return out


def explain_weakly_observable(
    problem: Problem, x: Array, triangle: TriangularSystem, expected: Array, noise: float
) -> list[str]:
    """What counts in the rank but is hardly better known than before the measurement, and why.

    Args:
        problem: the unknowns and the data.
        x: (p,) where the triangle was taken.
        triangle: of the data alone.
        expected: (p,) standard deviations before any measurement, m and rad.
        noise: standard deviation of the whitened residuals; NaN where nothing tells it.

    Returns:
        A sentence for each set of parameters that share such directions.
    """
    if np.isnan(noise):
        return [
            "no reading is left over to tell the noise, so nothing tells how far to believe what was found: "
            "state the instrument's sigmas or measure more poses"
        ]
    directions, left = observability.weakly_observable(triangle.r, expected, noise)
    if not len(left):
        return []
    names = [p.name for p in (*problem.errors.parameters, *problem.instrument_parameters)]
    path = PlainErrors.from_model(problem.errors, x[: len(problem.errors.parameters)])
    experiment = ObservabilityProbe(problem, x)
    elsewhere = experiment.hypothetical_r_factor(range(path.chain.n_joints)) / np.sqrt(
        experiment.n_repetitions
    )
    scaled = directions / expected[:, None]
    variance = (scaled * left**2) @ scaled.T
    out = []
    for members in observability.clusters(np.abs(scaled @ scaled.T) > _MIN_CORRELATION):
        mine = np.ix_(members, members)
        count = max(1, round(float(np.trace((scaled @ scaled.T)[mine]))))
        share, main = (part[..., -count:] for part in np.linalg.eigh(variance[mine]))
        what = (
            "" if len(members) == 1 else "a combination is " if count == 1 else f"{count} combinations are "
        )
        text = f"{join_names([names[i] for i in members])}: {what}hardly better known than before the measurement, "
        text += f"{100 * np.sqrt(share[0]):.0f} %{' or more' * (count > 1)} of the expected spread is left"
        if near := _nearly_parallel_axes(
            path, [path.parameters[i] for i in members if i < len(path.parameters)]
        ):
            text += f"; {near}"
        told = np.linalg.norm(elsewhere[:, members] @ (expected[list(members), None] * main), axis=0) / noise
        if np.all(1 / np.hypot(1.0, told) < observability.MAX_KNOWN_STD_RATIO):
            text += "; as many poses all over the joints' range would tell more"
        out.append(text)
    return out


def _nearly_parallel_axes(path: PlainErrors, parameters: Sequence[ErrorParameter]) -> str:
    """Which neighbouring axes, along which parameters act, are parallel but for a small angle."""
    axes = axes_acted_on(path.chain, parameters)
    near = {j: axis_angle_and_distance(path.chain, j, j + 1)[0] for j in axes if j + 1 in axes}
    linked = np.zeros((len(path.chain.moving_joints) + 2,) * 2)
    for j in (j for j, angle in near.items() if angle < _NEARLY_PARALLEL_RAD):
        linked[j : j + 2, j : j + 2] = 1
    said = []
    for run in observability.clusters(linked):
        said.append(_parallel(run, max(near[j] for j in run[:-1]), path.chain))
    return " and ".join(said)
