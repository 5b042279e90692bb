# SPDX-License-Identifier: Apache-2.0
"""Effects of joints and of the base (contract, section 6).

Zero offset: true angle = reported + offset; gain: true = (1 + gain) reported; with both
(1 + gain) reported + offset.

Misaligned axis: with the turn A of an axis in its parent link, the joint's rotation R(q) becomes
A R(q) A^T: at q = 0 the link is where it should be. Links that are fixed to each other count as one
parent. For the Galen's tilt axis turned about its parent's z,

    R_base_sensor = Rx(roll) Rz(a) Ry(tilt) Rz(a)^T Ry(pi/2).

Inclined base: gravity in base_link is (Rx(a) Ry(b) Rz(c))^T g.

Compliance: the tip deflects by C w with C = sum over springs of J^T J / k, which is linear in 1/k.
A fit therefore works on how much softer than nominal a spring is,

    c = k_nominal / k - 1,

in which the deflection is linear, carriages and rods included: with the square matrix A of the
six rods' rows K_p^-1 = A^-1 (I / k_rod + G G^T / k_q) A^-T (`galen_model.arm.delta`). Of a joint
that is nominally rigid, as all of a robot description are, c = k_ref / k with k_ref = 1e4 N.m/rad
(1e6 N/m), about that of a gear of an arm for 5 kg.

Play in a joint: after each reversal its true value lags by half the gap.

In motion: with x the reported joint and h = gap / 2 the true one is the play operator's

    w_k = min(max(w_(k-1), x_k - h), x_k + h),    w_0 = x_0 + `start` h

(e.g. Brokate and Sprekels, Hysteresis and Phase Transitions, 1996, section 2.2): x - h while it
goes up, x + h while it goes down, and between the two it stays. Its place in the gap before the
first motion of a bag is unknown: `start`, 0 for the middle, is -1 after going up and 1 after going
down.

In a push: a moment M about the axis takes the joint to the side of the gap that it points to, and
there it stays until a moment points the other way. It takes M_s (`seat` times 0.05 N.m, or 0.5 N of
a sliding joint) to move it at all, so that what a sensor's noise makes of no load does nothing, and
(1 + w) M_s, w = `width`, to take it all the way. With u = M / M_s, and clip to -1 ... 1,

    s_k = min(max(s_(k-1), clip(2 (u - 1) / w - 1)), clip(2 (u + 1) / w + 1)),

and the tip moves by s h less where it rested. Rest is where the last motion left the joint: on the
side it came from, s = -1 after going up; `start` before any motion. So the first push moves it by h
from the middle, and by the whole gap or not at all after a motion.

With the crossing `centred` the joint is at s = `start` before the first push after a motion. With
`soft` nothing sticks, and `width` is without effect: gears and bearings give way within the gap,

    s = tanh(u + u_0),    u_0 = 2 `start`,

with rest at tanh(u_0).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field, make_dataclass, replace
from functools import lru_cache
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from galen_common.parameters import param
from galen_model.arm.arm import Arm
from galen_model.arm.galen import GALEN
from galen_model.arrays import Array
from galen_model.load.mounting import inclination, inclination_axes
from galen_model.rotation import rot_x, rot_y, rot_z

from galen_sim_driver.effects.effect import (
    ConfigError,
    Effect,
    Fitted,
    Instants,
    Loading,
    check_choice,
)


@dataclass(frozen=True)
class AtJoint(Effect):
    """An effect at a revolute joint of `nominal`, the arm as it is without effects."""

    of_a_joint = True

    joint: str = param("tilt", "the joint")
    nominal: Arm = field(default=GALEN, kw_only=True, repr=False, compare=False)

    @classmethod
    def of(cls, arm: Arm, joint: str) -> Self:
        """Return the effect at a joint of an arm, changing nothing.

        Args:
            arm: the nominal one.
            joint: name of the joint.

        Returns:
            The effect, with its defaults.

        """
        return cls(joint=joint, nominal=arm)

    @classmethod
    def none_of(cls, arm: Arm) -> Iterable[Effect]:
        """Return the effect at each revolute joint, or at the last one where it is not of a joint.

        Args:
            arm: the nominal one.

        Returns:
            Effects that change nothing.

        """
        joints = (
            arm.turning_names if cls.of_a_joint else (arm.turning_names or arm.joint_names)[-1:]
        )
        return [cls.of(arm, joint) for joint in joints]

    def limit_names(self, arm: Arm) -> tuple[str, ...]:
        """Return all names on an arm under which a specification may limit it.

        Args:
            arm: the nominal one.

        Returns:
            The joints' names, for an effect of a joint; else `limit_parts`.

        """
        return arm.joint_names if self.of_a_joint else self.limit_parts

    @property
    def index(self) -> int:
        """Place of the joint."""
        return self.nominal.joint_names.index(self.joint)

    def validate(self) -> None:
        check_choice(self.name, "joint", self.joint, self.nominal.turning_names)


@dataclass(frozen=True)
class JointZeroOffset(AtJoint):
    """true angle of `joint` = reported + `offset_rad`."""

    name = "joint_zero_offset"
    fitted = (Fitted("offset_rad", "rad", 0.01, -0.5, 0.5),)
    order = 1

    offset_rad: float = param(0.0, "true angle minus the reported one, rad", -0.5, 0.5)

    def true_joints(self, when: Instants, joints: Array) -> Array:
        """Add the offset to the joint's reported angle.

        Args:
            when: not used.
            joints: reported (n, k), m and rad.

        Returns:
            True joints (n, k).

        """
        true = joints.copy()
        true[:, self.index] += self.offset_rad
        return true


@dataclass(frozen=True)
class JointGain(AtJoint):
    """true angle of `joint` = (1 + `gain`) reported."""

    name = "joint_gain"
    fitted = (Fitted("gain", "", 0.02, -0.5, 0.5),)

    gain: float = param(0.0, "true angle over the reported one, minus 1", -0.5, 0.5)

    def true_joints(self, when: Instants, joints: Array) -> Array:
        """Multiply the joint's reported angle by 1 + gain.

        Args:
            when: not used.
            joints: reported (n, k), m and rad.

        Returns:
            True joints (n, k).

        """
        true = joints.copy()
        true[:, self.index] *= 1.0 + self.gain
        return true


@dataclass(frozen=True)
class JointEccentricity(AtJoint):
    """true angle of `joint` = reported + `amplitude_rad` sin(`cycles` reported + `phase_rad`).

    `vector` holds what multiplies sine and cosine of cycles times the reported angle, and cycles.
    """

    name = "joint_eccentricity"
    fitted = (
        Fitted("sine_rad", "rad", 0.005, -0.5, 0.5),
        Fitted("cosine_rad", "rad", 0.005, -0.5, 0.5),
        Fitted("cycles", "", 1.0, 1.0, 1e3),
    )

    amplitude_rad: float = param(0.0, "amplitude of the angle's error, rad", 0.0, 0.75)
    cycles: float = param(1.0, "its periods in a turn of the joint", 1.0, 1e3)
    phase_rad: float = param(0.0, "its phase where the joint reports 0, rad")

    @property
    def limit_parts(self) -> tuple[str, ...]:
        return (self.joint,) * 2

    @property
    def changes_nothing(self) -> bool:
        return self.amplitude_rad == 0.0

    def vector(self) -> Array:
        sine, cosine = np.cos(self.phase_rad), np.sin(self.phase_rad)
        return np.array([self.amplitude_rad * sine, self.amplitude_rad * cosine, self.cycles])

    def with_vector(self, vector: Array) -> Self:
        """Return the same effect with other numbers.

        Args:
            vector: what multiplies sine and cosine, rad, and cycles.

        Returns:
            A new effect with their amplitude and phase.

        """
        sine, cosine, cycles = vector.tolist()
        return replace(
            self,
            amplitude_rad=math.hypot(sine, cosine),
            cycles=cycles,
            phase_rad=math.atan2(cosine, sine),
        )

    def true_joints(self, when: Instants, joints: Array) -> Array:
        """Add the periodic error to the joint's reported angle.

        Args:
            when: not used.
            joints: reported (n, k), m and rad.

        Returns:
            True joints (n, k).

        """
        true = joints.copy()
        turned = self.cycles * joints[:, self.index] + self.phase_rad
        true[:, self.index] += self.amplitude_rad * np.sin(turned)
        return true


_ABOUT = {"x": rot_x, "y": rot_y, "z": rot_z}


@dataclass(frozen=True)
class JointAxisMisalignment(AtJoint):
    """The axis of `joint` is turned by `angle_rad` about an axis of its parent link."""

    name = "joint_axis_misalignment"
    fitted = (Fitted("angle_rad", "rad", 0.02, -0.5, 0.5),)

    about: str = param("z", "axis of the parent link that it is turned about: x y z")
    angle_rad: float = param(0.0, "by how much it is turned, rad", -0.5, 0.5)

    def validate(self) -> None:
        super().validate()
        check_choice(self.name, "about", self.about, _ABOUT)

    @classmethod
    def of(cls, arm: Arm, joint: str) -> Self:
        """Return the effect at a joint, about z of its parent link, or about x where its axis is z.

        Args:
            arm: the nominal one.
            joint: name of the joint.

        Returns:
            The effect, changing nothing.

        """
        own = arm.joints[arm.joint_names.index(joint)]
        axis = own.axis if own.rotation is None else own.rotation @ own.axis
        # Turned about itself an axis stays where it is.
        about = "x" if abs(axis[2]) > 0.9 else "z"
        return replace(super().of(arm, joint), about=about)

    def misaligned(self, arm: Arm) -> Arm:
        """Turn the joint's axis.

        Args:
            arm: as it is without this effect.

        Returns:
            The arm with the other axis.

        """
        joints = list(arm.joints)
        joint = joints[self.index]
        turn = _ABOUT[self.about](self.angle_rad)
        if joint.rotation is not None:  # the axis is written in the joint's own frame
            turn = joint.rotation.T @ turn @ joint.rotation
        joints[self.index] = replace(joint, axis=turn @ joint.axis)
        return replace(arm, joints=tuple(joints))


def _about(axes: str) -> tuple[Fitted, ...]:
    return tuple(Fitted(f"about_{axis}_rad", "rad", 0.01, -0.5, 0.5) for axis in axes)


@dataclass(frozen=True)
class BaseInclination(Effect):
    """Gravity in base_link is (Rx(`about_x_rad`) Ry(`about_y_rad`) Rz(`about_z_rad`))^T g."""

    name = "base_inclination"
    fitted = _about("xy")
    beyond_contract = ("about_z_rad",)

    about_x_rad: float = param(0.0, "the base is inclined so far about its x, rad", -0.5, 0.5)
    about_y_rad: float = param(0.0, "the same about its y, after x, rad", -0.5, 0.5)
    about_z_rad: float = param(0.0, "the same about its z, after y, rad", -0.5, 0.5)

    @classmethod
    def kind_of(cls, arm: Arm) -> type[BaseInclination]:
        """Return the effect as an arm has it: two of its angles are fitted.

        Args:
            arm: the nominal one, whose gravity in the base counts.

        Returns:
            The effect of `base_inclination`.

        """
        return base_inclination(arm.gravity_m_s2)

    @property
    def angles_rad(self) -> Array:
        """About x, y and z (3,)."""
        return np.array([self.about_x_rad, self.about_y_rad, self.about_z_rad])

    @property
    def changes_nothing(self) -> bool:
        return not np.any(self.angles_rad)

    def gravity(self, gravity_base: Array) -> Array:
        """Turn gravity with the inclined base.

        Args:
            gravity_base: (3,), m/s^2, in the base as it should stand.

        Returns:
            (3,), m/s^2, in base_link.

        """
        return inclination(self.angles_rad) @ gravity_base


class _InclinationYZ(BaseInclination):
    fitted = _about("yz")
    beyond_contract = ("about_x_rad",)


class _InclinationXZ(BaseInclination):
    fitted = _about("xz")
    beyond_contract = ("about_y_rad",)


def base_inclination(gravity_m_s2: Array) -> type[BaseInclination]:
    """Return the effect whose two angles show, under a direction of gravity.

    Args:
        gravity_m_s2: nominal (3,) in the base.

    Returns:
        The effect that fits the angles about the two axes across gravity.

    """
    kinds = {"xy": BaseInclination, "yz": _InclinationYZ, "xz": _InclinationXZ}
    return kinds[inclination_axes(gravity_m_s2)]


class _Spring(NamedTuple):
    """What gives: a joint, or what holds a delta's platform; stiffnesses in N/m or Nm/rad."""

    name: str
    what: str
    unit: str
    nominal: float

    @property
    def reference(self) -> float:
        """Stiffness over which softness is counted."""
        if math.isfinite(self.nominal):
            return self.nominal
        return 1e4 if self.unit == "Nm/rad" else 1e6

    @property
    def softest(self) -> float:
        """Softness as nominal is none: 1, or 0 of a rigid joint."""
        return self.reference / self.nominal


def _springs(arm: Arm) -> tuple[_Spring, ...]:
    """Return what gives: of a delta's arm what has a stiffness, of another one every joint."""
    units = {"m": "N/m", "rad": "Nm/rad"}
    joints = {
        joint.name: _Spring(
            joint.name, f"the {joint.name} joint", units[joint.unit], joint.stiffness
        )
        for joint in arm.joints
    }
    if arm.delta is None:
        return tuple(joints.values())
    return tuple(
        joints.get(name) or _Spring(name, f"a {name}", "N/m", nominal)
        for name, nominal in arm.stiffness.items()
    )


@dataclass(frozen=True)
class _Compliance(Effect):
    """Stiffnesses of the true arm, SI; 0 for one that is as nominal.

    `vector` holds the softness of each spring. A field is a spring's name after "k_".
    """

    name = "joint_compliance"
    springs: ClassVar[tuple[_Spring, ...]]

    @classmethod
    def kind_of(cls, arm: Arm) -> type[Effect]:
        return compliance(arm)

    def _given(self) -> list[float]:
        return [getattr(self, stiffness_field(spring.name)) for spring in self.springs]

    @property
    def changes_nothing(self) -> bool:
        return not self.vector().any()

    def vector(self) -> Array:
        return np.array(
            [
                spring.reference / k - spring.softest if k > 0.0 else 0.0
                for spring, k in zip(self.springs, self._given(), strict=True)
            ]
        )

    def with_vector(self, vector: Array) -> Self:
        return replace(
            self,
            **{
                stiffness_field(spring.name): spring.reference / (spring.softest + float(softer))
                if softer != 0.0
                else 0.0
                for spring, softer in zip(self.springs, vector, strict=True)
            },
        )

    def arm(self, arm: Arm) -> Arm:
        given = zip(self.springs, self._given(), strict=True)
        return arm.with_stiffness({spring.name: k for spring, k in given if k > 0.0})


def stiffness_field(spring: str) -> str:
    """Return the field of a compliance that holds the stiffness of a joint, carriage or rod.

    Args:
        spring: name of the joint, or "carriage" or "rod".

    Returns:
        The field's name, after "k_".

    """
    return "k_" + as_word(spring)


def as_word(name: str) -> str:
    """Return a joint's name with nothing in it but letters, digits and underscores.

    Args:
        name: as the robot description has it.

    Returns:
        The name with "_" for all other signs.

    """
    return re.sub(r"\W", "_", name, flags=re.ASCII)


def compliance(arm: Arm) -> type[Any]:
    """Return the effect `joint_compliance` of an arm, with a field for each stiffness.

    Args:
        arm: the nominal one.

    Returns:
        A class of effects, the same one for arms with the same springs.

    Raises:
        ConfigError: two joints have names that make the same field.

    """
    springs = _springs(arm)
    fields = [stiffness_field(spring.name) for spring in springs]
    for name in fields:
        if fields.count(name) > 1:
            raise ConfigError(f"two joints of {arm.name} make the parameter '{name}': rename one")
    return _compliance(springs)


@lru_cache
def _compliance(springs: tuple[_Spring, ...]) -> type[Any]:
    numbers, fitted = [], []
    for spring in springs:
        rigid = math.isinf(spring.nominal)
        usual = "a rigid one" if rigid else "the nominal one"
        meaning = param(0.0, f"stiffness of {spring.what}, 0 for {usual}, {spring.unit}", 0.0)
        numbers.append((stiffness_field(spring.name), float, meaning))
        softness = (1.0, 0.0) if rigid else (0.3, -0.9)
        fitted.append(Fitted(f"softness_{spring.name}", "", *softness, 20.0))
    return make_dataclass(
        "JointCompliance",
        numbers,
        bases=(_Compliance,),
        frozen=True,
        namespace={
            "__module__": __name__,
            "springs": springs,
            "fitted": tuple(fitted),
            "contract_names": {
                stiffness_field(spring.name): f"stiffness.{spring.name}" for spring in springs
            },
        },
    )


JointCompliance = compliance(GALEN)
"""That of the Galen: of roll, tilt, carriages and rods, in this order."""


SEAT = {"m": 0.5, "rad": 0.05}
"""What moves a joint through its gap at `seat` 1, N or N.m."""
_STILL = {"m": 5e-5, "rad": 5e-4}
"""Joints that move by less, m or rad, stand: some ten quanta of the encoders."""


class _Memory:
    """What a joint in its gap knows of before."""

    def __init__(self, start: float) -> None:
        self.true: float | None = None
        self.at: float | None = None
        self.rest = self.side = start


CROSSINGS = ("stiction", "centred", "soft")


@dataclass(frozen=True)
class Backlash(AtJoint):
    """`joint` has a gap of `gap_rad`; of a sliding joint, in m."""

    name = "backlash"
    fitted = (
        Fitted("gap_rad", "rad", 0.002, 0.0, 0.2),
        Fitted("start", "", 1.0, -1.0, 1.0),
        Fitted("seat", "", 2.0, 0.1, 30.0),
        Fitted("width", "", 0.5, 0.02, 4.0),
    )
    beyond_contract = ("start", "seat", "width", "crossing")

    of_a_joint = False

    joint: str = param("tilt", "the joint with the gap, a sliding one as well")
    gap_rad: float = param(0.0, "the gap, rad; of a sliding joint in m", 0.0, 0.2)
    start: float = param(
        0.0, "where in its gap it starts, -1 to 1, as after going up or down", -1.0, 1.0
    )
    seat: float = param(
        1.0, "moment that moves it through its gap, over 0.05 Nm, or force over 0.5 N", 0.1, 30.0
    )
    width: float = param(
        2.0, "further moment that takes it through all of its gap, over that of the seat", 0.02, 4.0
    )
    crossing: str = param("stiction", "how it crosses its gap: stiction, centred or soft")

    _memory: ClassVar[_Memory | None] = None

    @property
    def changes_nothing(self) -> bool:
        return self.gap_rad == 0.0

    def validate(self) -> None:
        check_choice(self.name, "joint", self.joint, self.nominal.joint_names)
        check_choice(self.name, "crossing", self.crossing, CROSSINGS)

    def fresh(self) -> Self:
        new = replace(self)
        # A dataclass's own way into its frozen fields; the memory is none of its numbers.
        object.__setattr__(new, "_memory", _Memory(self.start))
        return new

    def true_joints(self, when: Instants, joints: Array) -> Array:
        """Let the joint lag by half its gap after each reversal.

        Args:
            when: not used.
            joints: reported (n, k), m and rad.

        Returns:
            True joints (n, k).

        """
        if not len(joints) or self.gap_rad == 0.0:
            return joints
        memory = self._memory or _Memory(self.start)
        half, reported = 0.5 * self.gap_rad, joints[:, self.index]
        # Where the reported joint stays, so does the true one; an arm stands most of the time.
        new = np.concatenate([[True], np.diff(reported) != 0.0])
        places = reported[new].tolist()
        now = places[0] + self.start * half if memory.true is None else memory.true
        path = []
        for value in places:
            now = min(max(now, value - half), value + half)
            path.append(now)
        memory.true = now
        true = joints.copy()
        true[:, self.index] = np.array(path)[np.cumsum(new) - 1]
        return true

    def deflect(self, when: Instants, loading: Loading) -> Array | None:
        """Return by how much a push moves the tip within the joint's gap.

        Args:
            when: of which only the number of samples counts.
            loading: joints, and the wrench that bends the arm.

        Returns:
            Translation and rotation vector (n, 6) in base_link, m and rad; None for nothing.

        """
        if not len(when) or self.gap_rad == 0.0:
            return None
        memory = self._memory or _Memory(self.start)
        index, unit = self.index, self.nominal.units[self.index]
        # Twist of the tip (n, 6) over the joint's rate; the arm stands most of the time.
        joints = loading.joints
        new = np.concatenate([[True], np.any(np.diff(joints, axis=0) != 0.0, axis=1)])
        columns = loading.arm.tip_jacobian(joints[new], loading.tip_m)[..., index]
        column = columns[np.cumsum(new) - 1]
        loads = np.einsum("ni,ni->n", column, loading.wrench) / (self.seat * SEAT[unit])
        if self.crossing == "soft":
            rest = 2.0 * self.start
            shifted = np.tanh(loads + rest) - np.tanh(rest)
            return 0.5 * self.gap_rad * shifted[:, None] * column
        slope = 2.0 / self.width
        at = memory.at
        moved = []
        lows, highs = (
            np.clip(slope * loads + way, -1.0, 1.0).tolist() for way in (-slope - 1.0, slope + 1.0)
        )
        for place, low, high in zip(joints[:, index].tolist(), lows, highs, strict=True):
            if at is None:
                at = place
            elif abs(place - at) > _STILL[unit]:
                side = -1.0 if place > at else 1.0
                memory.rest = memory.side = side if self.crossing == "stiction" else self.start
                at = place
            memory.side = min(max(memory.side, low), high)
            moved.append(memory.side - memory.rest)
        memory.at = at
        return 0.5 * self.gap_rad * np.array(moved)[:, None] * column
