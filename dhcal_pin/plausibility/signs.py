"""Signs of the joints of a low-cost arm, decided by the evidence of measurements.

A servo that is mounted the other way round has the wrong sign. Each hypothesis turns around no joint, one or
two joints, or all joints but these, as a mirrored arm does. Its evidence is that of an arm with the zeros,
lengths and axis directions of a low-cost arm (`evidence`). All hypotheses within the factor
exp(`MIN_LOG_RATIO`) of the best one are possible. The one that turns around the fewest joints is taken, so
that signs are kept as they were read unless the measurements contradict; the others are open questions.

The configuration that decides an open question is the one at which the arms of the two hypotheses, each with
its own base and tool, place the tool farthest from each other. Touched points, whose places are unknown, show
no position of the tool. They are compared only with known distances between them: an arm of another size and
shape can touch unknown points with any signs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations, product

import numpy as np

from .._frozen import frozen
from .._typing import Array
from ..estimation.parameters import LOW_COST_OFFSET_PRIOR, LOW_COST_SLIDE_PRIOR
from ..exceptions import InvalidArgumentError, UnknownNameError
from ..formatting import format_quantity
from ..measurements.base import Measurement
from ..measurements.pose import Pose
from ..robot.chain import Chain
from ..robot.sampling import random_configurations
from ..robot.urdf_edit import with_turned_joints
from .drawn_samples import comparable_items, draw_samples, has_enough_rows
from .evidence import HAND_BUILT, Evidence, fit_evidence
from .hypotheses import Hypothesis, JointChange, inner_revolute_joints, zero_hypothesis

# Logarithm of the ratio of evidence above which a sign is decided. Where the signs of simulated arms are
# decided wrongly, with few or similar poses, it is below 3; with 25 different poses it is above 15.
MIN_LOG_RATIO = 10.0
# Number of joints that are turned around together, or that are not in a mirrored arm.
_MAX_TURNED = 2
# Smallest residual for which the links of camera and board may be exchanged [m]: play and sag leave less.
# Largest ratio of the residual with exchanged links to that without.
_MIN_EXCHANGED, _MAX_EXCHANGED = 0.01, 0.2
# Number of configurations among which the one that decides is chosen, and its smallest useful distance [m].
_N_CONFIGURATIONS, _MIN_DISTANCE = 1000, 0.01
# Largest usual zeros, in default standard deviations.
_LARGEST_ZEROS = 1.5
# Play of the joints in simulations [rad].
_PLAY = np.deg2rad(0.5)
# Number of other sets of turned joints that are stated.
_MAX_LISTED = 7
# Zeros that may be wrong in place of signs [deg]: quarter turns, as of a URDF with another zero pose.
_QUARTER_TURNS = (90.0, -90.0, 180.0)


@frozen
class OpenSigns:
    """Signs that measurements leave open."""

    joints: tuple[str, ...]  #: Joints that may all turn the other way.
    #: Value of each joint of the arm at which the two arms differ most [rad or m], as the file states them.
    configuration: tuple[float, ...]
    #: Distance of the tools of the two arms there [m]; None if the measurements show no positions.
    distance: float | None


@frozen
class SignDecision:
    """Joints of an arm that turn the other way, and what is open."""

    joint_names: tuple[str, ...]  #: Names of all joints.
    is_prismatic: tuple[bool, ...]  #: Whether each of them is prismatic.
    turned: tuple[str, ...]  #: Joints that turn the other way.
    open: tuple[OpenSigns, ...] = ()  #: Open questions, the most likely one first.
    is_compared: bool = True  #: Whether the measurements are enough to compare signs.

    def apply(self, chain: Chain) -> Chain:
        """Return the arm with the axes of the turned joints reversed."""
        return turn_joints(chain, self.turned)

    def to_dict(self) -> dict[str, object]:
        """Return the decision for the JSON document."""
        return {
            "compared": self.is_compared,
            "turned": list(self.turned),
            "open": [{"joints": list(each.joints), "distance_m": each.distance} for each in self.open],
        }

    @property
    def note(self) -> str:
        """Sentence on the joints that were turned around; empty if there are none."""
        if not self.turned:
            return ""
        verb = "joints turn" if len(self.turned) > 1 else "joint turns"
        return (
            f"the {verb} the other way: {', '.join(self.turned)}; the written robot has the reversed axis, "
            "so that the joint values stay as they are"
        )

    @property
    def questions(self) -> list[str]:
        """Open questions, each with what decides it."""
        if not self.is_compared:
            return [
                "The signs of the joints were not compared, which needs positions or poses of the tool, at "
                "least 8, or touched points with known distances. Look which joints turn the other way than "
                "in the URDF, and name them: --turned NAME[,NAME] or --turned none."
            ]
        if len(self.open) > 1:
            return [self._common_question()]
        return [self._question(each) for each in self.open]

    def _common_question(self) -> str:
        """State several open questions at once: the answer to one changes the options of the others."""
        sets = [self.turned, *(self._other(each) for each in self.open[:_MAX_LISTED])]
        names = [name for name in self.joint_names if any(name in each.joints for each in self.open)]
        options = [f"--turned {','.join(each) or 'none'}" for each in sets]
        text = (
            f"The signs of {', '.join(names)} are open: with other zeros, the arm fits the measurements "
            f"about as well with {', '.join(options[:-1])} or {options[-1]}. Look which joints turn the other"
            " way than about their axes in the URDF by the right-hand rule. Add the option that names these"
        )
        likely = self.open[0]
        if likely.distance is None or likely.distance <= _MIN_DISTANCE:
            return f"{text}."
        return (
            f"{text}, or measure at {self._pose(likely)}: between the first two, the tools are "
            f"{_apart(likely.distance)} apart there."
        )

    def _other(self, open_signs: OpenSigns) -> tuple[str, ...]:
        """Return the joints that turn the other way if the answer to an open question is the other one."""
        return tuple(
            name for name in self.joint_names if (name in self.turned) != (name in open_signs.joints)
        )

    def _pose(self, open_signs: OpenSigns) -> str:
        """State the configuration that decides an open question."""
        values = zip(self.joint_names, open_signs.configuration, self.is_prismatic, strict=True)
        return ", ".join(
            f"{n} {1e3 * v:.0f} mm" if p else f"{n} {np.rad2deg(v):.0f} deg" for n, v, p in values
        )

    def _question(self, open_signs: OpenSigns) -> str:
        """State an open question and what decides it."""
        names = open_signs.joints
        several, first = len(names) > 1, names[0]
        text = (
            f"The sign{'s' * several} of {', '.join(names)} {'are' if several else 'is'} open: turned the "
            f"other way{' all together,' if several else ''} with other zeros, the arm fits the measurements "
            "about as well. "
        )
        if open_signs.distance is None:
            text += "Look"
        elif open_signs.distance > _MIN_DISTANCE:
            apart = _apart(open_signs.distance)
            text += (
                f"A measurement at {self._pose(open_signs)} decides it (the tools are {apart} apart there), "
                "or look"
            )
        else:
            text += "No position of the tool decides it: look"
        other = self._other(open_signs)
        as_in_urdf, reversed_ = (self.turned, other) if first in other else (other, self.turned)
        options = [f"--turned {','.join(each) or 'none'}" for each in (as_in_urdf, reversed_)]
        return (
            f"{text} whether rising values turn {first} about its axis in the URDF by the right-hand rule. "
            f"If so, add {options[0]}; if not, add {options[1]}."
        )


def _apart(distance: float) -> str:
    """State the distance of two tools."""
    return format_quantity(distance, "m", 0.1 * distance)


def known_signs(chain: Chain, turned: Sequence[str]) -> SignDecision:
    """Return the decision that some joints are known to turn the other way."""
    for name in turned:
        if name not in chain.joint_names:
            raise UnknownNameError(
                f"--turned {name}: unknown joint; choose from {', '.join(chain.joint_names)}, or write none"
            )
        if name not in _names(chain, _own_joints(chain)):
            raise InvalidArgumentError(
                f"--turned {name}: other joints mimic it; expected a URDF with the reversed axis and "
                "multipliers"
            )
    return SignDecision(chain.joint_names, tuple(chain.is_prismatic.tolist()), tuple(turned))


def decide_signs(chain: Chain, data: Sequence[Measurement]) -> SignDecision:
    """Decide which joints of a low-cost arm turn the other way."""
    undecided = replace(known_signs(chain, ()), is_compared=False)
    samples = _samples(data)
    if not samples:
        return undecided
    fits = _fit_signs(chain, samples)
    ranked = sorted(fits, key=lambda turned: -fits[turned].log)
    if fits[ranked[0]].length_scale > _MIN_EXCHANGED:
        _require_right_links(chain, data, fits[ranked[0]])
    limit = fits[ranked[0]].log - MIN_LOG_RATIO
    possible = [turned for turned in ranked if fits[turned].log >= limit]
    chosen = min(possible, key=len)
    if chosen and _best_quarter_turn(chain, samples) >= fits[ranked[0]].log + MIN_LOG_RATIO:
        # The zero of one joint is wrong, and no sign.
        return replace(undecided, is_compared=True)
    others = [turned for turned in possible if turned != chosen]
    shows_positions = any(len(item.positions()) for item in samples)
    return replace(
        undecided,
        is_compared=True,
        turned=_names(chain, chosen),
        open=tuple(_open_signs(chain, chosen, other, fits, shows_positions) for other in others),
    )


def _best_quarter_turn(chain: Chain, samples: Sequence[Measurement]) -> float:
    """Return the logarithm of the largest evidence with the zero of one joint off by a quarter turn."""
    zeros = [zero_hypothesis(chain, *each) for each in product(inner_revolute_joints(chain), _QUARTER_TURNS)]
    changed = [zero.apply(samples) for zero in zeros]
    return max((fit_evidence(chain, each, HAND_BUILT).log for each in changed if each), default=-np.inf)


def _fit_signs(chain: Chain, samples: Sequence[Measurement]) -> dict[tuple[int, ...], Evidence]:
    """Compute the evidence of each hypothesis."""
    fits = {}
    for turned in _hypotheses(chain):
        change = JointChange.of(chain.n_joints, factors=_signs(chain, turned).tolist())
        changed = Hypothesis("", "", change).apply(samples)
        assert changed is not None
        fits[turned] = fit_evidence(chain, changed, HAND_BUILT)
    return fits


def _require_right_links(chain: Chain, data: Sequence[Measurement], best: Evidence) -> None:
    """Raise an error if images fit an arm with camera and board on each other's links, and not as stated."""
    rigs = [item.rig for item in data if item.rig is not None]
    if len(rigs) < len(data) or not all(rig.has_links_to_exchange for rig in rigs):
        return
    samples = _samples([item.replace(rig=item.rig.with_exchanged_links()) for item in data if item.rig])
    exchanged = max(_fit_signs(chain, samples).values(), key=lambda each: each.log)
    if (
        exchanged.log > best.log + MIN_LOG_RATIO
        and exchanged.length_scale < _MAX_EXCHANGED * best.length_scale
    ):
        camera, board = rigs[0].cameras[0], rigs[0].boards[0]
        raise InvalidArgumentError(
            f"{rigs[0].source or 'rig'}: the images show camera {camera.name!r} on link {board.link!r} and "
            f"board {board.name!r} on link {camera.link!r}; expected these links, the reverse of those stated"
        )


def simulate_decision(chain: Chain, q: Array, rng: np.random.Generator) -> SignDecision:
    """Decide the signs from simulated poses of a right arm with play at joint positions (m, n)."""
    play = np.where(chain.is_prismatic, 0.0, _PLAY / 2 * rng.choice([-1.0, 1.0], q.shape))
    return decide_signs(chain, [Pose(q, chain.poses(q + play))])


def first_errors(chain: Chain, data: Sequence[Measurement]) -> Mapping[str, float]:
    """Estimate errors of a low-cost arm by name, at which a fit of images starts; empty with few images."""
    # A fit that starts at the nominal arm often ends in another minimum where zeros are wrong by 15°.
    samples = _samples(data) if all(item.rig is not None for item in data) else []
    return fit_evidence(chain, samples, HAND_BUILT).errors if samples else {}


def _samples(data: Sequence[Measurement]) -> list[Measurement]:
    """Draw the samples that arms are fitted to; none if they are too few."""
    if data and all(item.rig is not None for item in data):
        # Images show poses of the tool, one by one. Those of another camera have another base and tool.
        data = [max((item.tool_poses() for item in data), key=lambda item: len(item.rows))]
    lengths = [item for item in data if not item.configurations_per_row]
    samples = [*draw_samples(comparable_items(data))[0], *lengths]
    has_length = any(item.has_length_scale for item in samples)
    return samples if has_length and has_enough_rows(samples) else []


def _hypotheses(chain: Chain) -> list[tuple[int, ...]]:
    """List the numbers of the joints that each hypothesis turns around, those with few joints first."""
    own = _own_joints(chain)
    few = [each for count in range(_MAX_TURNED + 1) for each in combinations(own, count)]
    mirrored = [tuple(j for j in own if j not in each) for each in few]
    return sorted({*few, *mirrored}, key=lambda each: (len(each), each))


def _own_joints(chain: Chain) -> list[int]:
    """List the joints that no other joint mimics; the signs of the others depend on multipliers."""
    return [j for j in range(chain.n_joints) if np.count_nonzero(chain.mimic_matrix[:, j]) == 1]


def _signs(chain: Chain, turned: Sequence[int]) -> Array:
    """Return the sign of each joint, (n,)."""
    return np.where(np.isin(np.arange(chain.n_joints), turned), -1.0, 1.0)


def _names(chain: Chain, numbers: Sequence[int]) -> tuple[str, ...]:
    """Return the names of joints."""
    return tuple(chain.joint_names[j] for j in numbers)


def _open_signs(
    chain: Chain,
    chosen: tuple[int, ...],
    other: tuple[int, ...],
    fits: dict[tuple[int, ...], Evidence],
    shows_positions: bool,
) -> OpenSigns:
    """Find the configuration at which the arms of two hypotheses differ most."""
    q = random_configurations(chain, _N_CONFIGURATIONS)
    positions = []
    for turned in (chosen, other):
        arm = fits[turned].chain
        assert arm is not None
        # Limits hold for the joint values of the robot itself.
        positions.append(arm.poses(q * _signs(chain, chosen) * _signs(chain, turned))[:, :3, 3])
    distances = np.linalg.norm(positions[0] - positions[1], axis=1)
    best = int(np.argmax(distances))
    read = q[best] * _signs(chain, chosen)
    different = sorted({*chosen} ^ {*other})
    distance = float(distances[best]) if shows_positions else None
    return OpenSigns(_names(chain, different), tuple(read.tolist()), distance)


def turn_joints(chain: Chain, names: Sequence[str]) -> Chain:
    """Return a chain whose joints of these names turn the other way, in its URDF, too."""
    if not names:
        return chain
    if chain.transmission is not None:
        raise InvalidArgumentError(
            f"{chain.urdf.source}: {', '.join(names)} turn the other way, but the sidecar has joint errors "
            "for the present directions; expected a robot without a sidecar"
        )
    joint, moving = (np.isin(each, names) for each in (chain.joint_names, chain.moving_joints))
    return replace(
        chain,
        urdf=with_turned_joints(chain.urdf, names),
        axes=np.where(moving[:, None], -chain.axes, chain.axes) + 0.0,  # turns -0.0 into 0.0
        lower=np.where(joint, -chain.upper, chain.lower),
        upper=np.where(joint, -chain.lower, chain.upper),
    )


def with_wide_limits(chain: Chain) -> Chain:
    """Return a chain whose limits hold for all values that joints with wrong zeros and signs can report."""
    extent = np.fmax(np.abs(chain.lower), np.abs(chain.upper))
    extent = extent + _LARGEST_ZEROS * np.where(
        chain.is_prismatic, LOW_COST_SLIDE_PRIOR, LOW_COST_OFFSET_PRIOR
    )
    return replace(chain, lower=-extent, upper=extent)
