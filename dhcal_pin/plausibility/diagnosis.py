"""What was mixed up in measurements, and which measurements are suspicious."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .._frozen import frozen
from ..formatting import format_quantity, join_names
from .evidence import Evidence
from .hypotheses import ALL, Hypothesis

# Logarithm of the ratio of evidence above which a hypothesis is decisive. Honest data reach 4.
MIN_LOG_RATIO = 15.0
# Without positions, several wrong zeros of a hand-built arm explain much of what one does. One is believed if
# its evidence exceeds theirs by this logarithm: by 13 where one was wrong, by 3 where several were.
MIN_LOG_ADVANTAGE = 6.0
# Evidence of too few measurements: nothing is known about them.
NO_EVIDENCE = Evidence(log=0.0, width=0.0, length_scale=np.nan, angle_scale=np.nan)
# Measurements are suspicious if they need errors of this width, in default standard deviations, or leave
# residuals of this size [m], [rad].
_SUSPICIOUS_WIDTH, _SUSPICIOUS_LENGTH, _SUSPICIOUS_ANGLE = 4.0, 2e-3, 1e-2
# Residuals of measurements that state a large noise may be this much larger.
_MAX_NOISE_RATIO = 2.0
# Residuals that fall by this factor are named in the sentence.
_MIN_NAMED_RATIO = 2.0


@frozen
class Diagnosis:
    """Hypotheses that explain measurements decisively better than the measurements as they were read."""

    before: Evidence  #: Evidence of the measurements as they were read.
    #: Equivalent hypotheses, the simplest first; empty if none is decisive.
    hypotheses: tuple[Hypothesis, ...] = ()
    after: Evidence | None = None  #: Evidence with the first hypothesis.
    source: str = ""  #: File that the hypotheses are about; empty for all measurements together.
    #: First and last line of the mistake in this file; None if it is in all of them.
    lines: tuple[int, int] | None = None
    #: Whether each of several measurements fits the robot, but not all of them together.
    fits_separately: bool = False
    #: Zero of a joint that explains the measurements, too; the calibration corrects its small angle.
    zero: Diagnosis | None = None
    #: Evidence of a part of the samples with the first hypothesis, if all of them leave residuals with it.
    part: Evidence | None = None
    #: Joints that are turned around already if joint values come from counts of servos; None if they do not.
    of_servos: tuple[str, ...] | None = None
    gain: float = 0.0  #: Logarithm of the ratio of the evidence with the first hypothesis to that before.

    @property
    def log(self) -> float:
        """Logarithm of the evidence with the first hypothesis, or of the measurements as they were read."""
        return self.before.log + self.gain

    @property
    def is_suspicious(self) -> bool:
        """Whether the measurements, as they were read, need large errors or leave large residuals."""
        return is_suspicious(self.before)

    @property
    def is_certain(self) -> bool:
        """Whether a robot with errors of ordinary size fits the measurements after the change."""
        return self.after is not None and self.after.width < _SUSPICIOUS_WIDTH and is_fitted(self.after)

    @property
    def is_explained(self) -> bool:
        """Whether a robot with errors of any size fits the measurements, if base and tool are free."""
        return not leaves_residuals(self.before)

    @property
    def sentence(self) -> str:
        """What was mixed up and what undoing it would change; only with a hypothesis."""
        first, *others = (hypothesis.description for hypothesis in self.hypotheses)
        assert self.after is not None
        where = [f"lines {self.lines[0]} to {self.lines[1]}"] if self.lines else []
        where += [self.source] if self.source else []
        text = f"In {' of '.join(where)}, {first}" if where else f"{first[0].upper()}{first[1:]}"
        if others:
            text += f" (or {' or '.join(others)})"
        for before, after, unit in (
            (self.before.length_scale, self.after.length_scale, "m"),
            (self.before.angle_scale, self.after.angle_scale, "rad"),
        ):
            # With errors of any size a robot may have fitted these measurements before.
            if leaves_residuals(self.before) and before > _MIN_NAMED_RATIO * after:
                sizes = [format_quantity(v, unit, 0.1 * v, small=True) for v in (before, after)]
                rest = "" if is_fitted(self.after) else " Something else is wrong, too."
                return f"{text}: undoing this reduces the residuals from {sizes[0]} to {sizes[1]}.{rest}"
        return f"{text}: undoing this makes the measurements fit a robot with ordinary errors."

    @property
    def remedy(self) -> str:
        """What to do about it; only with a hypothesis.

        A mistake in the robot file has the same effect as one in all measurements. If only some of them have
        it, the others fit the robot file. A hypothesis about the robot file alone has no key.
        """
        where = f"@{self.source}" if self.source else ""
        first = self.hypotheses[0]
        if not first.key:
            return f"Correct {first.instead}."
        if self.lines:
            if not self.source:
                return "Correct these lines."
            where += f":{self.lines[0]}-{self.lines[1]}"
        if self.of_servos is not None and any(each.changes_joints for each in self.hypotheses):
            return self._remedy_of_servos(self.of_servos)
        add = f"add {' or '.join(f'--mend {each.key}{where}' for each in self.hypotheses)}."
        instead = ", or ".join(dict.fromkeys(each.instead for each in self.hypotheses if each.instead))
        if where or not instead:
            return f"Correct the measurements, or {add}"
        values = "joint values" if all(each.concerns_joints for each in self.hypotheses) else "measurements"
        aim = "To keep the robot's lengths"
        if any(each.changes_joints for each in self.hypotheses):
            aim = "To get a robot for joint values with this change"
        cause = f"Correct the {values}, or {instead}: the data do not show which of them is wrong."
        return f"{cause} {aim}, {add}"

    def for_servos(self, turned: tuple[str, ...]) -> Diagnosis:
        """Return the diagnosis of joint values from counts of servos, of which some were turned around."""
        return replace(self, of_servos=turned, zero=self.zero and self.zero.for_servos(turned))

    def _remedy_of_servos(self, turned: Sequence[str]) -> str:
        """Say what to do about joint values that follow from counts: signs and zeros are those of servos."""
        parts = self.hypotheses[0].parts
        kinds, names = ({part.key.split(":")[i] for part in parts} for i in (0, 1))
        if self.lines:
            return "Correct these lines."
        if kinds == {"sign"} and not self.source and ALL not in names:
            return f"Add --turned {','.join(sorted({*turned} ^ names)) or 'none'}."
        if kinds == {"ratio"} and not self.source:
            # The factor of the joint values is the inverse of that of the counts.
            factors = [(part.key.split(":")[1], 1 / float(part.key.split(":")[2])) for part in parts]
            changes = [f"of {'all joints' if name == ALL else name} by {f:.4g}" for name, f in factors]
            return (
                f"Multiply counts_per_turn {join_names(changes)} in the servo file (where it is not stated, "
                "it is the resolution)."
            )
        if kinds <= {"zero", "ratio"} and not self.source:
            return f"Correct the motors of {join_names(sorted(names))} in the servo file."
        return "Correct the measurements."


def is_suspicious(evidence: Evidence) -> bool:
    """Return whether measurements may be mixed up: they need large errors or leave large residuals."""
    return evidence.width >= _SUSPICIOUS_WIDTH or leaves_residuals(evidence)


def leaves_residuals(evidence: Evidence) -> bool:
    """Return whether no manufactured robot fits the measurements, however large its errors are."""
    return evidence.length_scale > _SUSPICIOUS_LENGTH or evidence.angle_scale > _SUSPICIOUS_ANGLE


def is_fitted(evidence: Evidence) -> bool:
    """Return whether a robot fits measurements after a change, with the residuals that it may leave."""
    factor, (length, angle) = evidence.residual_factor, evidence.stated_noise
    is_far = (
        evidence.length_scale > max(factor * _SUSPICIOUS_LENGTH, _MAX_NOISE_RATIO * length),
        evidence.angle_scale > max(factor * _SUSPICIOUS_ANGLE, _MAX_NOISE_RATIO * angle),
    )
    return not any(is_far)
