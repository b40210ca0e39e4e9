"""What the data cannot tell apart, in words: which parameters, why, and what would tell them.

A reason is printed only after it was checked on the arm at hand: a combination is carried along the
chain, and where it passes a joint it must be a motion that this joint's own motion leaves as it is: along
or about a revolute joint's axis, along anything or about the axis of a prismatic one. Where a check fails
the plain fact remains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from . import se3
from .chain import BASE, Chain, joint_station, link_station
from .measurements import Unknown
from .nullspace import Experiment, Group, groups
from .parameters import Parameter
from .poses import Pose
from .positions import Position
from .se3 import Array
from .solver import Problem, Triangle

# Carried combinations, the largest entry 1, agree with a reason to this.
_EXACT = 1e-5
# Axes within this of each other, rad and m, are parallel, or the same line.
_PARALLEL = 1e-6
# Axes within this are called nearly parallel.
_NEARLY = np.deg2rad(5.0)
# More names than these make no sentence.
_MANY = 12


def listed(names: Sequence[str]) -> str:
    """Names as in a sentence."""
    if len(names) > _MANY:
        names = [*names[: _MANY - 1], f"{len(names) - _MANY + 1} more"]
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def _numbered(word: str, plural: str, numbers: Sequence[int], chain: Chain) -> str:
    """Joints or axes by their place from 1, with the joints' names where these do not tell it."""
    names = [chain.moving[j - 1] for j in numbers]
    text = f"{word if len(numbers) == 1 else plural} {listed([str(j) for j in numbers])}"
    told = all(str(j) in name for j, name in zip(numbers, names, strict=True))
    return text if told else f"{text} ({', '.join(names)})"


def _axes(numbers: Sequence[int], chain: Chain) -> str:
    return _numbered("axis", "axes", numbers, chain)


def _sum(names: Sequence[str], weights: Array) -> str:
    """A weighted sum, as `d2 + d3 - 0.5 a4`."""
    weights = weights / weights[0]
    text = names[0]
    for name, weight in zip(names[1:], weights[1:], strict=True):
        size = abs(weight)
        factor = "" if abs(size - 1) < 1e-4 else f"{size:.3g} "
        text += f" {'+' if weight > 0 else '-'} {factor}{name}"
    return text


def tilt(chain: Chain, first: int, second: int) -> tuple[float, float]:
    """Angle in rad between the lines of two axes, and distance in m of the second's origin from the first.

    Of the axes numbered from 1, with the joints between them at zero.
    """
    between = np.eye(4)
    for j in range(first, second):
        between = between @ chain.links[j]
    sine = np.linalg.norm(between[:2, 2])
    return float(np.arctan2(sine, abs(between[2, 2]))), float(np.linalg.norm(between[:2, 3]))


@dataclass(frozen=True, eq=False)
class Passage:
    """How an unseen combination passes along the chain.

    Attributes:
        bodies: between which bodies it acts, 0 the base link.
        shifts, turns: the joints, from 1, along and about whose axes it passes unnoticed.
        slides: the prismatic joints that it passes in another direction than along their axis.
        tool: (r, 6) what is left at the measured point; zero if the whole tool stays.
    """

    bodies: tuple[int, int]
    shifts: list[int]
    turns: list[int]
    slides: list[int]
    tool: Array


def passage(chain: Chain, bodies: Array, twists: Array, vectors: Array) -> Passage | None:
    """How combinations (p, r) of twists in bodies' frames pass along the chain; None if a joint notices.

    Args:
        chain: at the values of the unknowns.
        bodies, twists: (p,), (p, 6) of the robot's unknowns.
        vectors: (p, r).
    """
    shifts, turns, slides = set[int](), set[int](), set[int]()
    carried = np.zeros((6, vectors.shape[1]))
    for body, link in enumerate(chain.links):
        mine = bodies == body
        carried = carried + twists[mine].T @ vectors[mine]
        last = body == len(chain.moving)
        carried = se3.adjoint(se3.inverse(link @ chain.tool if last else link)) @ carried
        size = np.abs(carried).max(1) > _EXACT
        if last or not size.any():
            continue
        joint = body + 1
        slide = chain.prismatic[body]
        if size[[3, 4]].any() or (size[[0, 1]].any() and not slide):
            return None
        shifts |= {joint} if size[2] else set()
        turns |= {joint} if size[5] else set()
        slides |= {joint} if size[:2].any() else set()
    acting = np.unique(bodies[np.abs(vectors).max(1) > _EXACT])
    return Passage(
        (int(acting[0]), int(acting[-1])), sorted(shifts), sorted(turns), sorted(slides), carried.T
    )


def _own_axes(chain: Chain, parameters: Sequence[Parameter]) -> set[int]:
    """Joints along or about whose axes parameters act themselves."""
    out = set()
    for p in parameters:
        twist = np.array(p.twist)
        for j, axis in enumerate(chain.axes, start=1):
            at = p.station in (joint_station(j), link_station(j))
            if at and np.allclose(np.cross(twist.reshape(2, 3), axis), 0, atol=1e-9):
                out.add(j)
    return out


def _place(chain: Chain, station: int) -> str:
    if station == BASE:
        return "the base"
    if station >= chain.tip_station:
        return "the tool" if station == chain.tool_station else "the tip"
    return _numbered("joint", "joints", [station // 2], chain)


def _why(chain: Chain, way: Passage, parameters: Sequence[Parameter]) -> str:
    """The geometric reason why a combination of parameters leaves the whole tool where it is."""
    if not (way.shifts or way.turns or way.slides):
        places = list(dict.fromkeys(_place(chain, p.station) for p in parameters))
        if len(places) == 1:
            return f"they act at one place, {places[0]}"
        return f"no joint moves between {listed(places)}"
    axes = sorted(_own_axes(chain, parameters) | set(way.shifts))
    if not way.turns and not way.slides and len(axes) > 1:
        if all(tilt(chain, axes[0], j)[0] < _PARALLEL for j in axes[1:]):
            return f"{_axes(axes, chain)} are parallel"
    if len(way.turns) > 1 and all(max(tilt(chain, way.turns[0], j)) < _PARALLEL for j in way.turns[1:]):
        return f"{_axes(way.turns, chain)} lie on one line"
    motions = []
    if way.turns:
        motions.append(f"a turn about {_axes(way.turns, chain)}")
    if way.shifts:
        motions.append(f"a shift along {_axes(way.shifts, chain)}")
    if way.slides:
        motions.append(f"a shift of {_numbered('joint', 'joints', way.slides, chain)}, which only slides")
    passes = "passes" if len(motions) == 1 else "pass"
    joints = sorted({*way.turns, *way.shifts, *way.slides})
    return f"{' and '.join(motions)} {passes} {'that joint' if len(joints) == 1 else 'those joints'} unnoticed"


@dataclass(frozen=True, eq=False)
class Explainer:
    """Sentences on the unseen directions of one experiment.

    Attributes:
        experiment: the problem, and where its Jacobian is taken.
        hidden: (p, d) basis of all that the data do not see.
        names: (p,).
        robot: (r,) the robot's parameters, first among the names.
        chain: at the values of the unknowns.
        bodies, twists: what the robot's parameters move.
    """

    experiment: Experiment
    hidden: Array
    names: list[str]
    robot: tuple[Parameter, ...]
    chain: Chain
    bodies: Array
    twists: Array

    def sentence(self, group: Group) -> str:
        """What a group's parameters have to do with each other, why, what is seen, what would help."""
        members = group.members
        names = [self.names[i] for i in members]
        reason, advice = {
            "arm": self._arm, "instrument": self._instrument, "still": self._still, "poses": self._poses
        }[group.cause](group)  # fmt: skip
        who = f"{listed(names)}: {reason}" if reason else listed(names)
        return f"{who}{': ' if not reason else '; '}{self._seen(group, names)}{advice}"

    def _seen(self, group: Group, names: list[str]) -> str:
        """How much of the members is seen, counted against all that is not."""
        members = group.members
        _, s, vt = np.linalg.svd(self.hidden[members].T)
        lost = int(np.sum(s > 1e-6))
        if len(members) == lost:
            return "no reading depends on it" if lost == 1 else "nothing is seen of any of them"
        if len(members) == lost + 1:
            weights = np.where(np.abs(vt[-1]) < 1e-6 * np.abs(vt[-1]).max(), 0.0, vt[-1])
            taking = np.flatnonzero(weights)
            return f"only {_sum([names[i] for i in taking], weights[taking])} is seen"
        return f"only {len(members) - lost} combinations of the {len(members)} are seen"

    def _robot_part(self, group: Group) -> tuple[list[Parameter], Passage | None]:
        members = [i for i in group.members if i < len(self.robot)]
        inside = len(members) == len(group.members)
        part = group.vectors[: len(self.robot)]
        way = passage(self.chain, self.bodies, self.twists, part) if inside else None
        return [self.robot[i] for i in members], way

    def _arm(self, group: Group) -> tuple[str, str]:
        members, way = self._robot_part(group)
        advice = ", and no measurement of this arm can tell more"
        if way is None or np.abs(way.tool).max() > _EXACT:
            return "", advice
        return _why(self.chain, way, members), advice

    def _instrument(self, group: Group) -> tuple[str, str]:
        members, way = self._robot_part(group)
        joints = list(range(self.chain.size))
        position = any(len(item.positions()) for item in self.experiment.problem.data)
        advice = ""
        for kind, text in (
            (Position, "the tool's position in a fixed frame"),
            (Pose, "its orientation too" if position else "the tool's pose in a fixed frame"),
        ):
            seen = self.experiment.triangle(joints, kind) @ group.vectors
            if np.linalg.matrix_rank(seen, 1e-8 * np.linalg.norm(seen)) == group.vectors.shape[1]:
                advice = f"; measuring {text} would tell"
                break
        outside = [i for i in group.members if i >= len(self.robot)]
        base = all(p.station == BASE for p in members)
        if base and outside:
            return "the instrument and the robot can move as one", advice
        if base:
            return "the readings stay the same when the whole robot moves so", advice
        if way is not None and np.abs(way.tool[:, :3]).max() < _EXACT:
            return "the tool only turns about the measured point, and that is not read", advice
        return "the readings stay the same", advice

    def _still(self, group: Group) -> tuple[str, str]:
        joints = self.experiment.still()
        words = f"{'joint' if len(joints) == 1 else 'joints'} {listed([self.chain.joint_names[j] for j in joints])}"
        return f"{words} never moved", f"; moving {'it' if len(joints) == 1 else 'them'} would tell more"

    def _poses(self, group: Group) -> tuple[str, str]:
        problem = self.experiment.problem
        rows = sum(item.residual(self.chain.sweep(item.configurations()), problem.values(item, self.experiment.x)).size
                   for item in problem.data)  # fmt: skip
        samples = sum(len(item.rows) for item in problem.data)
        short = group.vectors.shape[1]
        p = len(self.names)
        reason = f"{rows} readings for {p} unknowns"
        if p - self.hidden.shape[1] == rows:
            more = -(-short * samples // rows)
            return reason, f"; at least {more} more {'pose is' if more == 1 else 'poses are'} needed"
        return "the poses are too much alike", "; poses over the joints' whole range would tell"


def unobservable(problem: Problem, x: Array, triangle: Triangle) -> list[str]:
    """What the data cannot tell apart, why, and what would tell it; every unseen direction in one sentence.

    Args:
        problem: the unknowns and the data.
        x: (p,) where the triangle was taken.
        triangle: of the data alone.

    Returns:
        Sentences; none where all is seen.
    """
    experiment = Experiment(problem, x)
    layers = experiment.layers(triangle.r)
    if not layers[-1][1].shape[1]:
        return []
    robot = problem.errors.parameters
    chain, bodies, twists = problem.errors.derivative(x[: len(robot)])
    names = [p.name for p in (*robot, *problem.unknowns)]
    explainer = Explainer(experiment, layers[-1][1], names, robot, chain, bodies, twists)
    return [explainer.sentence(group) for group in _joined(groups(layers, bodies, len(robot)))]


def _joined(found: list[Group]) -> list[Group]:
    """Groups of which one combination each is seen, put together where they share a parameter."""
    out: list[Group] = []
    for group in found:
        for i, other in enumerate(out):
            both = Group(group.cause, np.concatenate([other.vectors, group.vectors], 1))
            chained = all(len(g.members) == g.vectors.shape[1] + 1 for g in (group, other, both))
            if other.cause == group.cause and (chained or group.cause in ("poses", "still")):
                out[i] = both
                break
        else:
            out.append(group)
    return out
