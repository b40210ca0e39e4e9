"""Explanations of unobservable and poorly identified parameters, as sentences for users.

Each sentence names the parameters, the reason, what is identifiable, and what to measure. A reason is
stated only if it was verified on the robot at hand: a combination of errors is propagated along the chain,
and each joint that it passes must leave it unchanged (see `propagation`). If no reason can be verified,
only the parameters are named. An advice is given only if the hypothetical measurement makes the
parameters observable (see `null_space`).

Correction curves, the harmonics of high order, are explained apart from the other parameters: limited ranges
of the joints leave many combinations of them open. The other parameters are explained as if the curves were
known, and one sentence states how many combinations of the curves are open.

Redundancies of the model, such as base pose and origin of joint 1, exist for every instrument. Poses of
cameras and boards are redundant with those of base and tool in all images. Their sentences start with
`EXPECTED`, and users can ignore them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..estimation import qr
from ..estimation.error_model import ErrorParameter
from ..estimation.parameters import fold_harmonics
from ..estimation.problem import Problem
from ..estimation.qr import TriangularSystem
from ..formatting import format_count, join_names
from ..measurements.pose import Pose
from ..measurements.position import Position
from ..robot.chain import BASE_FRAME, Chain
from ..robot.error_families import CURVE_ORDERS
from ..robot.transmission import harmonic_orders
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

# Start of the sentences on redundancies that no measurement can resolve.
EXPECTED = "Expected, no action needed: "
# Reason for an undetermined size of the robot.
SCALE_UNKNOWN = "the measurements do not determine the size of the robot"
# Largest angle of axes that a sentence calls parallel to within an angle [rad].
_NEARLY_PARALLEL_RAD = np.deg2rad(5.0)
# Largest number of names in a sentence.
_MAX_NAMES = 12
# Entries of the projector on weakly observable directions, in units of the priors, that connect two
# parameters.
_MIN_CORRELATION = 0.1
# Smallest singular value, relative to the norm of R, of an observable direction.
_OBSERVABLE_RTOL = 1e-8
# Weights of a sum that are this close to 1 are not written; a sum with weights below the second value is not
# written.
_UNIT_WEIGHT_TOL, _ZERO_WEIGHT = 1e-4, 1e-6
# Configurations for tests of how a combination moves the robot.
_N_RANDOM_SAMPLES = 30


def _list_names(names: Sequence[str]) -> str:
    """Join names; summarize the last ones if there are too many."""
    if len(names) > _MAX_NAMES:
        names = [*names[: _MAX_NAMES - 1], f"{len(names) - _MAX_NAMES + 1} more"]
    return join_names(names)


def _numbered(word: str, plural: str, numbers: Sequence[int], chain: Chain) -> str:
    """Name joints or axes by their numbers from 1, and by joint names that do not contain the number."""
    names = [chain.moving_joints[j - 1] for j in numbers]
    text = f"{word if len(numbers) == 1 else plural} {_list_names([str(j) for j in numbers])}"
    is_clear = all(str(j) in name for j, name in zip(numbers, names, strict=True))
    return text if is_clear else f"{text} ({', '.join(names)})"


def _axes(numbers: Sequence[int], chain: Chain) -> str:
    """Name joint axes, such as "axes 2 and 3"."""
    return _numbered("axis", "axes", numbers, chain)


def _weighted_sum(names: Sequence[str], weights: Array) -> str:
    """Format a weighted sum, such as "d2 + d3 - 0.5 a4"."""
    text = names[0]
    for name, weight in zip(names[1:], weights[1:] / weights[0], strict=True):
        size = abs(weight)
        factor = "" if abs(size - 1) < _UNIT_WEIGHT_TOL else f"{size:.3g} "
        text += f" {'+' if weight > 0 else '-'} {factor}{name}"
    return text


def _describe_frame(chain: Chain, frame: int) -> str:
    """Name an error frame."""
    if frame == BASE_FRAME:
        return "base pose"
    if frame >= chain.tip_frame:
        return "the tool" if frame == chain.tool_frame_index else "the tip"
    number = _numbered("joint", "joints", [frame // 2], chain)
    return f"the origin of {number}" if frame % 2 == 0 else f"the link behind {number}"


def _parallel(axes: Sequence[int], angle: float, chain: Chain) -> str:
    """State that axes are parallel, exactly or to within an angle [rad]."""
    tolerance = "" if angle < PARALLEL_TOL else f" to within {np.rad2deg(angle):.2g}°"
    return f"{_axes(axes, chain)} are parallel{tolerance}"


def _explain_propagation(chain: Chain, way: Propagation, parameters: Sequence[ErrorParameter]) -> str:
    """Explain why a combination of parameters that passes joints does not move the tool."""
    axes = sorted(axes_acted_on(chain, parameters) | {*way.translation_joints, *way.rotation_joints})
    if not way.crossed_prismatic_joints and len(axes) == axes[-1] - axes[0] + 1 > 1:
        relations = [axis_angle_and_distance(chain, i, j) for i, j in pairwise(axes)]
        if all(max(relation) < PARALLEL_TOL for relation in relations):
            return f"{_axes(axes, chain)} lie on one line"
        largest_angle = max(angle for angle, _ in relations)
        if not way.rotation_joints and largest_angle < NEGLIGIBLE:
            return _parallel(axes, largest_angle, chain)
    motions = []
    if way.rotation_joints and way.rotation_joints == way.translation_joints:
        motions.append(f"a rotation about and a translation along {_axes(way.rotation_joints, chain)}")
    else:
        if way.rotation_joints:
            motions.append(f"a rotation about {_axes(way.rotation_joints, chain)}")
        if way.translation_joints:
            motions.append(f"a translation along {_axes(way.translation_joints, chain)}")
    if way.crossed_prismatic_joints:
        motions.append(f"a translation across prismatic {_axes(way.crossed_prismatic_joints, chain)}")
    n_joints = len({*way.rotation_joints, *way.translation_joints, *way.crossed_prismatic_joints})
    is_single = len(motions) == 1 and not (way.rotation_joints and way.translation_joints)
    return (
        f"{' and '.join(motions)} {'has' if is_single else 'have'} the same effect before and behind "
        f"{'that joint' if n_joints == 1 else 'those joints'}"
    )


@frozen(eq=False)
class Explainer:
    """Sentences on the unobservable directions of one problem."""

    probe: ObservabilityProbe  # Problem, and values at which its Jacobian is taken
    layers: dict[Cause, Array]  # Null space by cause, from `ObservabilityProbe.null_space_layers`
    names: list[str]  # Names of the unknowns, length p
    plain_errors: PlainErrors  # Geometric errors of the robot, the first of the unknowns

    def sentence(self, group: UnobservableGroup) -> str:
        """Explain one group of unobservable directions."""
        names = [self.names[i] for i in group.members]
        if group.cause == "structure" and group.members[-1] < len(self.probe.problem.errors.parameters):
            return EXPECTED + self._explain_redundancy(group, names)
        if group.cause in ("structure", "instrument") and (entries := self._rig_entries(group)):
            return EXPECTED + self._explain_free_frame(group, names, entries)
        explain = {
            "structure": self._explain_structure,
            "instrument": self._explain_instrument,
            "poses": self._explain_poses,
            "unmoved": self._explain_unmoved,
        }
        reason, advice = explain[group.cause](group)
        extent = self._describe_observable(group, names)
        return f"{self._listed(group, names)}: {reason + '; ' if reason else ''}{extent}; {advice}"

    def _listed(self, group: UnobservableGroup, names: list[str]) -> str:
        """List the names of a group; of too many names, those with the largest entries."""
        order = np.argsort(-np.abs(group.vectors[group.members]).max(1), kind="stable")
        selected = sorted(order[: _MAX_NAMES - 1]) + sorted(order[_MAX_NAMES - 1 :])
        return _list_names([names[i] for i in selected])

    def _explain_redundancy(self, group: UnobservableGroup, names: list[str]) -> str:
        """Explain parameters of the robot that no instrument can separate."""
        listed = self._listed(group, names)
        subject = f"{listed} {'is' if len(names) == 1 else 'are'} redundant"
        extent = self._describe_observable(group, names, by=" by any measurement")
        members, way = self._robot_part(group)
        if way is None or np.abs(way.tool_twists).max() > NEGLIGIBLE:
            return f"{subject}; {extent}"
        chain = self.plain_errors.chain
        if way.translation_joints or way.rotation_joints or way.crossed_prismatic_joints:
            reason = _explain_propagation(chain, way, members)
            if all(name in extent for name in names):
                return f"{reason}, so {extent}"
            return f"{subject}, because {reason}; {extent}"
        frames = [p.error_frame for p in members]
        first, last = _describe_frame(chain, min(frames)), _describe_frame(chain, max(frames))
        if first == last:
            return f"{subject}, because all act at {first}; {extent}"
        extent = self._describe_observable(group, names, listed, by=" by any measurement")
        return f"{first} and {last} are redundant, because no joint moves between them; {extent}"

    def _describe_observable(
        self, group: UnobservableGroup, names: list[str], listed: str = "", by: str = ""
    ) -> str:
        """Describe which combinations of the members, `listed` or named before, are identifiable."""
        # The count refers to the null space of the group's cause, because other groups may share its members.
        members, r = group.members, group.vectors.shape[1]
        _, s, vt = qr.singular_value_decomposition(self.layers[group.cause][members].T)
        n_lost = int(np.sum(s > NEGLIGIBLE))
        n_lost_now = int(np.linalg.matrix_rank(self.layers["unmoved"][members], NEGLIGIBLE))
        one, several = "can be identified", "can be identified"
        if n_lost_now == n_lost:
            one, several = "is identifiable", "are identifiable"
        if r == len(members):
            return f"the measurements do not depend on {'it' if r == 1 else 'any of them'}"
        if n_lost != r:
            number, verb = ("one combination", "is") if r == 1 else (f"{r} combinations", "are")
            return f"{number} of {listed or 'them'} {verb} not identifiable{by}"
        whole = listed or f"the {len(members)}"
        if len(members) > r + 1:
            return f"only {len(members) - r} combinations of {whole} {several}{by}"
        weights = vt[-1]
        has_mixed_units = len({self.probe.problem.parameters[i].unit for i in members}) > 1
        if has_mixed_units or np.abs(weights).min() < _ZERO_WEIGHT:
            return f"only one combination of {whole} {one}{by}"
        return f"only {_weighted_sum(names, weights)} {one}{by}"

    def _robot_part(self, group: UnobservableGroup) -> tuple[list[ErrorParameter], Propagation | None]:
        """Return the geometric errors of a group, and their propagation if the group has no other members."""
        count = len(self.plain_errors.parameters)
        members = [i for i in group.members if i < count]
        way = (
            propagate_along_chain(self.plain_errors, group.vectors[:count])
            if len(members) == len(group.members)
            else None
        )
        return [self.plain_errors.parameters[i] for i in members], way

    def _rig_entries(self, group: UnobservableGroup) -> dict[str, bool]:
        """Return the cameras and boards whose poses take part in a group, and whether the tool moves them."""
        sets, moves = dict[str, str](), dict[str, bool]()
        for item in self.probe.problem.data:
            if (rig := item.rig) is not None:
                sets |= {p.name: item.set_of(p.name) for p in item.instrument_parameters}
                for kind, entries, mounts in (
                    ("camera", rig.cameras, rig.camera_mounts),
                    ("board", rig.boards, rig.board_mounts),
                ):
                    moves |= {f"{kind}_{e.name}": m.moves for e, m in zip(entries, mounts, strict=True)}
        n_robot = len(self.probe.problem.errors.parameters)
        members = [self.names[i] for i in group.members if i >= n_robot]
        if any(sets.get(name, "intrinsics") == "intrinsics" for name in members):
            return {}
        entries = dict.fromkeys(name.rpartition(".")[0] for name in members)
        return {entry: moves[entry] for entry in entries}

    def _explain_free_frame(
        self, group: UnobservableGroup, names: list[str], entries: dict[str, bool]
    ) -> str:
        """Explain that poses of cameras and boards take the place of those of base and tool."""
        frames = [frame for frame, moves in (("base", False), ("tool", True)) if moves in entries.values()]
        frame = f"the pose of {' and '.join(f'the {name}' for name in frames)}"
        poses = f"the pose{'s' if len(entries) > 1 else ''} of {_list_names(list(entries))}"
        n_directions = group.vectors.shape[1]
        number = "one combination" if n_directions == 1 else f"{n_directions} combinations"
        return (
            f"{poses} can take the place of {frame}, and all images stay the same; {number} of "
            f"{self._listed(group, names)} {'is' if n_directions == 1 else 'are'} not identifiable by images"
        )

    def _explain_structure(self, group: UnobservableGroup) -> tuple[str, str]:
        """Explain a redundancy in which instrument parameters take part."""
        return "", "add measurements that depend on them"

    def _explain_instrument(self, group: UnobservableGroup) -> tuple[str, str]:
        """Explain directions that the instruments at hand cannot observe at any pose."""
        members, way = self._robot_part(group)
        chain = self.plain_errors.chain
        has_other_members = len(group.members) > len(members)
        observed = [item.observed_body for item in self.probe.problem.data]
        nearest = min((self.plain_errors.bodies[i] for i in group.members[: len(members)]), default=-1)
        if not has_other_members and all(body is not None and body <= nearest for body in observed):
            return "the observed links are before this part of the robot", self._suggest_measurement(group)
        if members and all(p.error_frame == BASE_FRAME for p in members):
            if has_other_members:
                reason = "the robot and the instrument can move together without changing a measurement"
            else:
                reason = "the measurements do not change when the whole robot moves in this way"
            return reason, self._suggest_measurement(group)
        if not has_other_members and (reason := self._explain_angles(group)):
            return reason, self._suggest_measurement(group)
        if way is not None and np.abs(way.tool_twists[:, :3]).max() < NEGLIGIBLE:
            reason = "only the orientation of the tool depends on this, and the orientation is not measured"
            return reason, self._suggest_measurement(group)
        last = len(chain.moving_joints)
        point = (chain.link_transforms[-1] @ chain.tool)[:2, 3]
        is_behind_last_joint = all(
            self.plain_errors.bodies[i] >= last - 1
            for i in group.members
            if i < len(self.plain_errors.bodies)
        )
        is_point_on_axis = not chain.prismatic[-1] and np.linalg.norm(point) < PARALLEL_TOL
        if not has_other_members and is_behind_last_joint and is_point_on_axis:
            reason = f"the measured point lies on {_axes([last], chain)} and does not move with that joint"
            offset = self.probe.with_offset_point().hypothetical_r_factor(range(chain.n_joints))
            suggestion = self._suggest_measurement(group)
            if self._is_determined_by(offset, group):
                suggestion = f"measure a point beside that axis, or {suggestion}"
            return reason, suggestion
        if self._is_scaling(group):
            return SCALE_UNKNOWN, _size_advice(self.probe.problem)
        return "the measurements do not change", self._suggest_measurement(group)

    def _explain_angles(self, group: UnobservableGroup) -> str:
        """Explain why measured angles do not depend on a group; empty if lengths are measured, too."""
        data = self.probe.problem.data
        if not self.probe.measures_angles_only:
            return ""
        _, motions = self._tool_motions(group)
        turns = np.concatenate(motions[:, 3:], 1)
        sizes = np.linalg.svd(turns, compute_uv=False)
        if sizes[0] < NEGLIGIBLE:
            return "this does not turn the tool, and only angles are measured"
        axes = {item.symmetry_axis for item in data}
        if sizes[1] < NEGLIGIBLE and len(axes) == 1 and (axis := axes.pop()):
            return f"this turns the tool about {axis}, and the measurements stay the same"
        return ""

    def _tool_motions(self, group: UnobservableGroup) -> tuple[Array, Array]:
        """Return the tool (3, m) at random configurations, and its velocities (r, 6, m) by a group."""
        errors, count = self.plain_errors, len(self.plain_errors.parameters)
        q = self.probe.draw_configurations(np.random.default_rng(0), _N_RANDOM_SAMPLES)
        frames = errors.chain.forward_kinematics(q)
        velocities = errors.chain.tool_jacobian(frames, errors.bodies, errors.twists)
        return frames.tool[3], np.tensordot(group.vectors[:count].T, velocities, 1)

    def _is_scaling(self, group: UnobservableGroup) -> bool:
        """Decide whether a group scales the robot about some point and has no other effect."""
        if group.vectors.shape[1] != 1 or len(group.members) < 2:
            return False
        robot = [i for i in group.members if i < len(self.probe.problem.errors.parameters)]
        if not robot or robot[-1] >= len(self.plain_errors.parameters):
            return False
        # Displacement = scale·point + translation + rotation × point, fitted to all samples.
        point, velocities = self._tool_motions(group)
        displacement = velocities[0, :3]
        motions = [*(np.eye(3)[i][:, None] * np.ones_like(point) for i in range(3))]
        motions += [np.cross(np.eye(3)[i], point.T).T for i in range(3)]
        rows = np.array([point, *motions]).reshape(7, -1).T
        solution, *_ = np.linalg.lstsq(rows, displacement.ravel(), rcond=None)
        largest_misfit = np.abs(rows @ solution - displacement.ravel()).max()
        return bool(largest_misfit < NEGLIGIBLE and abs(solution[0]) > NEGLIGIBLE)

    def _is_determined_by(self, r: Array, group: UnobservableGroup) -> bool:
        """Decide whether measurements with an R factor observe all directions of a group."""
        s = qr.singular_values(r @ group.vectors)
        return bool(s.min() > _OBSERVABLE_RTOL * np.linalg.norm(r))

    def _suggest_measurement(self, group: UnobservableGroup) -> str:
        """Suggest the simplest additional measurement that makes a group observable."""
        has_positions = any(len(item.positions()) for item in self.probe.problem.data)
        joints = range(self.plain_errors.chain.n_joints)
        if self._is_determined_by(self.probe.hypothetical_r_factor(joints, Position), group):
            return "measure the position of the tool in a fixed frame"
        if self._is_determined_by(self.probe.hypothetical_r_factor(joints, Pose), group):
            return f"measure the {'orientation' if has_positions else 'pose'} of the tool in a fixed frame"
        return "add other poses or measurements"

    def _explain_unmoved(self, group: UnobservableGroup) -> tuple[str, str]:
        """Explain directions that joints which never moved would make observable."""
        names = [self.plain_errors.chain.joint_names[j] for j in self.probe.unmoved_joints()]
        return (
            f"{_list_names(names)} never moved",
            f"move {'this joint' if len(names) == 1 else 'these joints'}",
        )

    def _explain_poses(self, group: UnobservableGroup) -> tuple[str, str]:
        """Explain directions that more or other poses would make observable."""
        if len(self.names) - self.layers["unmoved"].shape[1] == self.probe.n_equations:
            # The number of poses is that of the verdict: as few as determine them leave outliers undetected.
            return (
                f"{self.probe.n_equations} equations for {len(self.names)} parameters",
                "measure more poses",
            )
        chain = self.plain_errors.chain
        decisive = [
            j
            for j in range(chain.n_joints)
            if self._is_determined_by(self.probe.hypothetical_r_factor([j]), group)
        ]
        joints = _list_names([chain.joint_names[j] for j in decisive]) if decisive else "the joints"
        return "the poses are too similar", f"measure poses over the full range of {joints}"


def _explain_few_equations(probe: ObservabilityProbe, n_open: int) -> tuple[str, str]:
    """Explain that curves are open because there are too few equations, and how many poses are missing."""
    n_equations, samples = probe.n_equations, sum(len(item.rows) for item in probe.problem.data)
    poses = format_count(-(-n_open * samples // n_equations), "more pose")
    return f"{n_equations} equations for {len(probe.x)} parameters", f"measure at least {poses}"


def explain_unobservable(probe: ObservabilityProbe, system: TriangularSystem) -> list[str]:
    """Explain which parameters are not identifiable, why, and what to measure."""
    if system.rank == len(probe.x):
        return []
    curve_joints = _curve_joints(probe.problem)
    if (curve_joints < 0).all():
        return _explain_null_space(probe)
    kept = np.flatnonzero(curve_joints < 0)
    is_explained = qr.rank(system.r[:, kept]) == len(kept)
    sentences = [] if is_explained else _explain_null_space(_with_known_curves(probe, kept))
    return [*sentences, *_explain_curves(probe, system, curve_joints)]


def _curve_joints(problem: Problem) -> Array:
    """Return the joint of each unknown that belongs to a correction curve, -1 for others, shape (p,)."""
    n = problem.errors.chain.n_joints
    indices = np.array(
        [-1 if p.coefficient_index is None else p.coefficient_index for p in problem.errors.parameters], int
    )
    is_curve = harmonic_orders(indices, n) >= CURVE_ORDERS.start
    others = np.full(len(problem.instrument_parameters), -1)
    return np.concatenate([np.where(is_curve, indices % n, -1), others])


def _with_known_curves(probe: ObservabilityProbe, kept: Array) -> ObservabilityProbe:
    """Return a probe in which only some unknowns remain; the others stay as in x."""
    problem, errors, n_robot = probe.problem, probe.problem.errors, len(probe.problem.errors.parameters)
    known = probe.x.copy()
    known[kept] = 0.0
    parameters = tuple(errors.parameters[i] for i in kept if i < n_robot)
    reduced = replace(errors, chain=errors.at(known[:n_robot]), parameters=parameters)
    reduced_problem = replace(problem, errors=reduced, weights=problem.weights[kept], bounds=None)
    return ObservabilityProbe(reduced_problem, probe.x[kept])


def _explain_curves(probe: ObservabilityProbe, system: TriangularSystem, curve_joints: Array) -> list[str]:
    """Explain how many combinations of the correction curves are not identifiable, and of which joints."""
    others = curve_joints < 0

    def n_open(r: Array, n_determined: int) -> int:
        return len(others) - n_determined - (int(others.sum()) - qr.rank(r[:, others]))

    if not (count := n_open(system.r, system.rank)):
        return []
    shares = np.sum(system.null_space**2, 1)
    by_joint = {
        name: round(float(shares[curve_joints == i].sum())) for i, name in enumerate(probe.chain.joint_names)
    }
    listed = ", ".join(f"{name} {share}" for name, share in by_joint.items() if share)
    if system.rank == probe.n_equations:
        reason, advice = _explain_few_equations(probe, count)
    elif n_open(probe.full_range, qr.rank(probe.full_range)) < count:
        reason, advice = "the poses are too similar", "measure poses over the full range of the joints"
    else:
        reason, advice = "the ranges of the joints are too small", "only the priors determine them"
    return [
        f"correction curves: {reason}; {count} of {int((~others).sum())} combinations of harmonics are not "
        f"identifiable{f' ({listed})' if listed else ''}; {advice}"
    ]


def _explain_null_space(probe: ObservabilityProbe) -> list[str]:
    """Explain all unobservable directions of a problem."""
    problem, x = probe.problem, probe.x
    layers = probe.null_space_layers(probe.r)
    plain_errors = PlainErrors.from_model(problem.errors, x[: len(problem.errors.parameters)])
    names = [p.name for p in problem.parameters]
    explainer = Explainer(probe, dict(layers), names, plain_errors)
    groups = _merge_groups(group_directions(layers, plain_errors.error_frames))
    sentences = [explainer.sentence(group) for group in groups]
    if probe.is_scale_unobservable and not any(SCALE_UNKNOWN in text for text in sentences):
        text = f"all lengths together: {SCALE_UNKNOWN}, only the priors do; {_size_advice(problem)}"
        sentences.insert(0, text)
    return sentences


def explain_unknown_size(probe: ObservabilityProbe) -> tuple[str, str] | None:
    """State that the size of the robot is not determined, and what to measure; None if it is."""
    return (SCALE_UNKNOWN, _size_advice(probe.problem)) if probe.is_scale_unobservable else None


def _size_advice(problem: Problem) -> str:
    """Return the measurement that determines the size of a robot."""
    if any(item.is_contact for item in problem.data):
        return "add a known distance between contact points"
    return "measure the position of the tool in a fixed frame"


def label_unobservable(sentence: str) -> str:
    """Label a sentence of `explain_unobservable` for lists with other topics."""
    return sentence if sentence.startswith(EXPECTED) else f"not observable: {sentence}"


def _merge_groups(groups: list[UnobservableGroup]) -> list[UnobservableGroup]:
    """Merge groups of one cause if their union has one identifiable combination."""
    # Groups of the causes "poses" and "unmoved" are always merged.
    out: list[UnobservableGroup] = []
    for group in groups:
        for i, other in enumerate(out):
            union = UnobservableGroup(group.cause, np.concatenate([other.vectors, group.vectors], 1))
            has_one_combination = len(union.members) == union.vectors.shape[1] + 1
            if other.cause == group.cause and (has_one_combination or group.cause in ("poses", "unmoved")):
                out[i] = union
                break
        else:
            out.append(group)
    return out


def explain_weakly_observable(
    probe: ObservabilityProbe, system: TriangularSystem, prior_std: Array, noise: float
) -> list[str]:
    """Explain which parameters are observable but hardly better known than before the measurement."""
    if np.isnan(noise):
        return [
            "the accuracy of all parameters is unknown, because there are no redundant measurements to "
            "estimate the noise from; state the standard deviations of the instrument or measure more poses"
        ]
    directions, std_ratios = observability.weakly_observable(system, prior_std, noise)
    if not len(std_ratios):
        return []
    problem, n_robot = probe.problem, len(probe.problem.errors.parameters)
    names = [p.name for p in problem.parameters]
    plain_errors = PlainErrors.from_model(problem.errors, probe.x[:n_robot])
    # R factor of as many poses over the full range of the joints.
    full_range = probe.full_range / np.sqrt(probe.n_repetitions)
    scaled = directions / prior_std[:, None]
    # The curve of a joint is explained as a whole.
    curve_joints = _curve_joints(problem)
    is_same_curve = (curve_joints[:, None] == curve_joints) & (curve_joints >= 0)
    projector = np.abs(scaled @ scaled.T)
    adjacency = (projector > _MIN_CORRELATION) | (
        is_same_curve & np.logical_and.outer(*[np.diag(projector) > _MIN_CORRELATION] * 2)
    )
    variance = (scaled * std_ratios**2) @ scaled.T
    out = []
    for members in observability.connected_components(adjacency):
        block = np.ix_(members, members)
        count = max(1, round(float(np.trace((scaled @ scaled.T)[block]))))
        ratio_squared, main = (part[..., -count:] for part in np.linalg.eigh(variance[block]))
        what = (
            "" if len(members) == 1 else " of one combination" if count == 1 else f" of {count} combinations"
        )
        text = (
            f"{_list_names(fold_harmonics(names[i] for i in members))}: standard deviation{what} still "
            f"{100 * np.sqrt(ratio_squared[0]):.0f} %{' or more' * (count > 1)} of the prior"
        )
        geometric = [plain_errors.parameters[i] for i in members if i < len(plain_errors.parameters)]
        if relation := _nearly_parallel_axes(plain_errors, geometric):
            text += f"; {relation}"
        change = full_range[:, members] @ (prior_std[list(members), None] * main)
        s = np.linalg.norm(change, axis=0) / noise
        is_known = np.all(1 / np.hypot(1.0, s) < observability.MAX_KNOWN_STD_RATIO)
        if is_known and not any(item.rig for item in problem.data):
            text += "; measure over the full range of the joints"
        out.append(text)
    return out


def _nearly_parallel_axes(errors: PlainErrors, parameters: Sequence[ErrorParameter]) -> str:
    """Name adjacent axes that parameters act along and that are parallel to within a small angle."""
    axes = axes_acted_on(errors.chain, parameters)
    angles = {j: axis_angle_and_distance(errors.chain, j, j + 1)[0] for j in axes if j + 1 in axes}
    adjacency = np.zeros((len(errors.chain.moving_joints) + 2,) * 2)
    for j in (j for j, angle in angles.items() if angle < _NEARLY_PARALLEL_RAD):
        adjacency[j : j + 2, j : j + 2] = 1
    relations = []
    for run in observability.connected_components(adjacency):
        relations.append(_parallel(run, max(angles[j] for j in run[:-1]), errors.chain))
    return " and ".join(relations)
