# SPDX-License-Identifier: Apache-2.0
"""Hysteresis of the deflection (contract, section 6): friction under a load that turns.

Dahl's friction beside the spring of every joint: a joint's spring of nominal stiffness k carries
the load u less a friction F that follows the joint's displacement x (P. R. Dahl, Solid friction
damping of mechanical vibrations, AIAA Journal 14 (12), 1976, pp. 1675-1682, with the exponent 1):

    k x + F = u,    dF/dx = sigma (1 - sign(dx) F / F_c)

In units y = sigma x / F_c, phi = F / F_c and a = sigma / k the first is y / a + phi = u / F_c. As
long as the load goes one way, s = sign(du), the friction goes to it exponentially, and the way e
that a change D of u / F_c takes y is Lambert's function W (the lower line follows from the upper):

    phi' = s (1 - g exp(-e)),    g = 1 - s phi,    e / a + g (1 - exp(-e)) = D
    e = c + W(a g exp(-c)),      c = a (D - g)

That is exact for a step of any size, so what comes out depends on where the load turned and not on
how often it is sampled; and not on speed.

A first push to y = Y and back to no load leaves y_0 = a - W(a (2 - exp(-Y)) exp(a - Y)). The
fraction y_0 / Y is small after small pushes (they hardly slide) and after large ones (F_c is all
that holds against the spring) and has one largest value between. That is what is asked for here,
at a load that is asked for; F_c and a follow. Around that load the fraction hardly depends on it: a
fraction of 0.07 is 2 % lower at 0.8 and 1.25 times that load, 16 % at half and 20 % at twice.

The joints are the three carriages, roll and tilt, and the six rods with what slips in the seats of
their balls, which bend the most. What each takes of a wrench is determined without their
stiffness: six rods hold the platform as the square matrix A of their rows [n, B x n] says
(`galen_model.arm.delta`), so that a rod that grows by 1 moves it by a column of A^-1, and a
carriage moves it without turning it, since its two rods stay parallel.

The state is computed from turn to turn of the load, and every sample from the turn before it. Noise
makes a measured load turn at every other sample, and small swings reduce a friction of Dahl's kind,
which no real joint shows: swings below 2 % of the largest load are therefore none.

`residual_fraction` is the deflection at no load after the largest load, over that at the largest
load. Two models, by `form`:

"tip": a state z beside each of the six components e of the tip's elastic displacement in base_link,
in units of its largest, P:

    dz = (de / P - |de / P| z) / knee,    so that going from e_0 in the direction s = +-1
    z = s - (s - z_0) exp(-|e - e_0| / (knee P)).

This is the model of Bouc and Wen with the exponent 1 and without their gamma (Y.-K. Wen, Method for
random vibration of hysteretic systems, J. Eng. Mech. Div. ASCE 102 (2), 1976, pp. 249-263). The tip
stands at e - side c P z: with side 1 it lags the load, as friction makes it; with side -1 it runs
ahead of it and comes back too far. With a = 1 - exp(-1 / knee) a first push to P takes z to a, and
back to -a^2 at no load. `softness` b adds that part of e. c P a^2 over the deflection at P, that is
(1 + b) P - side c P a, is the fraction:

    residual_fraction = c a^2 / (1 + b - side c a),
    c = residual_fraction (1 + b) / (a^2 + side residual_fraction a).

Why a softness: a spring with friction that doesn't slide yet is stiffer than one whose friction
does, and the nominal stiffness may be either's.

"joints": Dahl's friction beside the spring of every joint that has one, of the Galen's carriages
and rods as well, each with the fraction at its own largest load (over its deflection with the
friction, there). With side -1 what
friction takes is added.

With `restarts` a move of the arm removes what loads have left, and largest loads are those of a
place: joints that move shake their friction out. Without, all of it stays.

The largest loads are those of the samples. A driver knows one sample at a time: it takes loads of
about 10 N at the tip, where the arm is; on a delta, at home and at the retractor's tip.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import ClassVar, Self

import numpy as np
import scipy  # its parts are loaded when they are used
from galen_common.parameters import param
from galen_model.arm.arm import Arm
from galen_model.arrays import Array
from galen_model.load.model import TOOLS
from galen_model.registration import move_twist
from numpy.typing import ArrayLike

from galen_sim_driver.effects.effect import (
    ConfigError,
    Effect,
    Fitted,
    Instants,
    Loading,
    check_choice,
)


def slide(ratio: float, phi: Array, change: Array) -> Array:
    """Return friction over F_c after a straight change of the load over F_c.

    Args:
        ratio: a.
        phi: friction over F_c before, any shape.
        change: of the load over F_c, the same shape.

    Returns:
        Friction over F_c, -1 to 1, the same shape.

    """
    sign = np.sign(change)
    gap = 1.0 - sign * phi
    shift = ratio * (np.abs(change) - gap)
    way = shift + scipy.special.lambertw(ratio * gap * np.exp(-shift)).real
    # Without a change the way is nothing but rounding, and there is no sign to go to.
    moved = sign * (1.0 - gap * np.exp(-np.maximum(way, 0.0)))
    return np.where(change == 0.0, phi, moved)


def residual_fraction(ratio: float, way: float) -> float:
    """Return y_0 / Y of a first push and back to no load.

    Args:
        ratio: a.
        way: Y, at the push's largest load.

    Returns:
        The residual fraction.

    """
    left = ratio - scipy.special.lambertw(ratio * (2.0 - np.exp(-way)) * np.exp(ratio - way)).real
    return float(left / way)


def load_of(ratio: float, way: float) -> float:
    """Return the load over F_c that takes a joint without friction before to Y.

    Args:
        ratio: a.
        way: Y.

    Returns:
        The load u / F_c.

    """
    return float(way / ratio - np.expm1(-way))


@cache
def shape(largest_fraction: float) -> tuple[float, float]:
    """Find the friction whose largest residual fraction is as asked for.

    Args:
        largest_fraction: y_0 / Y at the load where it is largest; above 0.

    Returns:
        The ratio a, and the way Y of that load.

    """

    def peak(ratio: float) -> float:
        # Little friction has its peak at Y = 1.26, much friction at Y near a.
        found = scipy.optimize.minimize_scalar(
            lambda way: -residual_fraction(ratio, way),
            bounds=(0.5, 3.0 + 2.0 * ratio),
            method="bounded",
            options={"xatol": 1e-9},
        )
        return float(found.x)

    # It is 0.41 a for a small a, and less for others.
    ratio = scipy.optimize.brentq(
        lambda a: residual_fraction(a, peak(a)) - largest_fraction,
        2.0 * largest_fraction,
        100.0 * largest_fraction,
        xtol=1e-12,
    )
    return float(ratio), peak(ratio)


def joint_stiffness(arm: Arm) -> Array:
    """Return the stiffness of the joints.

    Args:
        arm: with its stiffness as it is.

    Returns:
        (k,), N/m and N.m/rad, inf of a rigid joint. The three carriages of a delta are its first
        joints, and its six rods come last.

    """
    k = [joint.stiffness for joint in arm.joints]
    if arm.delta is not None:
        k = [arm.delta.carriage_stiffness] * 3 + k[3:] + [arm.delta.rod_stiffness] * 6
    return np.array(k)


def joint_columns(joints: ArrayLike, tip_m: ArrayLike, arm: Arm) -> Array:
    """Return the tip's twist over what each joint gives.

    Args:
        joints: of the arm, m and rad.
        tip_m: (3,) in ft_sensor, m.
        arm: whose joints they are.

    Returns:
        Twists (6, k) in base_link, a column for each of the joints as `joint_stiffness` has them.

    """
    q = np.asarray(joints, dtype=float)
    columns, delta = arm.tip_jacobian(q, tip_m), arm.delta
    if delta is None:
        return columns
    columns[:3, :3] = np.linalg.inv(delta.jacobian(q[:3]))
    rods = np.linalg.inv(delta.rod_rows(q[:3]))
    _, tip = arm.tip_pose(q, tip_m)
    return np.hstack([columns, move_twist(rods.T, q[:3], tip).T])


def turning_points(values: Array, gate: float) -> np.ndarray:
    """Find where values turn.

    A turn is where the values were farthest, before they came back by more than the gate.

    Args:
        values: (n,), in the order of time; n at least 1.
        gate: least way back that is a turn, in the unit of the values.

    Returns:
        Increasing indices; the first is 0.

    """
    turns = [0]
    far, since = np.abs(values - values[0]) > gate, np.arange(len(values))
    if not far.any():
        return np.array(turns)
    # The first value that is off by the gate tells the direction that it starts in.
    up = bool(values[int(since[far][0])] > values[0])
    # Only where values go back, and the last, can be a turn.
    steps = np.diff(values)
    moves = np.flatnonzero(steps)
    back = moves[1:][np.diff(np.sign(steps[moves])) != 0.0]
    ends = np.concatenate([[0], back, [len(values) - 1]])
    farthest, at = float(values[0]), 0
    for index, value in zip(ends.tolist(), values[ends].tolist(), strict=True):
        if up:
            if value >= farthest:
                farthest, at = value, index
            elif farthest - value > gate:
                turns.append(at)
                farthest, at, up = value, index, False
        elif value <= farthest:
            farthest, at = value, index
        elif value - farthest > gate:
            turns.append(at)
            farthest, at, up = value, index, True
    return np.array(turns)


def along_turns(
    loads: Array,
    gates: Array,
    slide: Callable[[Array, Array], Array],
    before: Array,
    start: Array,
) -> Array:
    """Return the states of k frictions along their loads.

    Args:
        loads: (n, k).
        gates: (k,), in the loads' units: swings below are none.
        slide: gives the states after the loads have changed straight, of states and changes (...,
            k).
        before: (k,) loads of the sample before the first.
        start: (k,) states of the sample before the first.

    Returns:
        States (n, k).

    """
    path = np.concatenate([before[None], loads])
    turns = [turning_points(column, gate) for column, gate in zip(path.T, gates, strict=True)]
    legs = max(map(len, turns)) - 1
    # One with fewer turns than others stays at its last.
    at = np.stack([np.pad(t, (0, legs + 1 - len(t)), mode="edge") for t in turns], axis=1)
    at_turns = np.take_along_axis(path, at, axis=0)
    states = np.empty_like(at_turns)
    states[0] = start
    for leg in range(legs):
        states[leg + 1] = slide(states[leg], at_turns[leg + 1] - at_turns[leg])
    samples = np.arange(1, len(path))
    last = np.stack([np.searchsorted(t, samples, side="right") - 1 for t in turns], axis=1)
    since = loads - np.take_along_axis(at_turns, last, axis=0)
    return slide(np.take_along_axis(states, last, axis=0), since)


FORMS = ("tip", "joints")

GATE = 0.02
"""Of the largest load: swings below it are none."""
_LEAST_FRACTION = 1e-4
_STILL_POSE_M = 2e-4
_TYPICAL_FORCE_N = 10.0
_MOVED = {"m": 1e-3, "rad": 5e-3}
"""By how much joints change, m or rad, where the arm has moved to another place."""


class _Memory:
    """Loads (k,) and states (k,) of k frictions at the last sample."""

    def __init__(self) -> None:
        self._peak: Array | None = None
        self._load: Array | None = None
        self._state: Array | None = None
        self.place: Array | None = None

    def clear(self) -> None:
        """Nothing was loaded yet."""
        self._peak = self._load = self._state = None

    def states(
        self,
        loads: Array,
        typical: Callable[[], Array],
        slider: Callable[[Array], Callable[[Array, Array], Array]],
    ) -> tuple[Array, Array]:
        """States (n, k) under loads (n, k), and the largest loads (k,).

        typical: loads to take for the largest where there is but one sample; slider(peak): how
        the states follow the load, for all that have that peak (k,).
        """
        if self._peak is None or self._load is None or self._state is None:
            self._peak = np.abs(loads).max(axis=0) if len(loads) > 1 else typical()
            self._load = self._state = np.zeros(loads.shape[1])
        peak = self._peak
        slide = slider(peak)
        if len(loads) == 1:
            states = slide(self._state, loads[0] - self._load)[None]
        else:
            states = along_turns(loads, GATE * peak, slide, self._load, self._state)
        self._load, self._state = loads[-1], states[-1]
        return states, peak


@dataclass(frozen=True)
class DeflectionHysteresis(Effect):
    """`residual_fraction` of the deflection is left, on the load's side or on the other.

    `vector` holds the fraction with its side's sign, the knee and the softness.
    """

    name = "deflection_hysteresis"
    fitted = (
        Fitted("signed_fraction", "", 0.05, -0.5, 0.5),
        Fitted("knee", "", 0.15, 0.02, 2.0),
        Fitted("softness", "", 0.1, -0.5, 2.0),
    )
    beyond_contract = ("side", "form", "knee", "softness", "restarts")

    residual_fraction: float = param(
        0.0, "deflection left after the largest load, over that at that load", 0.0, 0.5
    )
    side: float = param(
        1.0, "1: it is left on the load's side, as by friction; -1: on the other", -1.0, 1.0
    )
    form: str = param("tip", "model: tip (the whole displacement) or joints (friction in each)")
    knee: float = param(
        0.2, "form tip: load over which the state turns, over the largest load", 0.02, 2.0
    )

    softness: float = param(
        0.0, "form tip: by how much more the tip deflects than the springs, all along", -0.5, 2.0
    )
    restarts: bool = param(
        True, "whether moving the arm to another place takes away what loads have left"
    )

    _memory: ClassVar[_Memory | None] = None

    def validate(self) -> None:
        check_choice(self.name, "form", self.form, FORMS)
        if self.side not in (1.0, -1.0):
            raise ConfigError(f"{self.name}: side is {self.side}, but must be 1 or -1")
        most = -np.expm1(-1.0 / self.knee)
        if self.form == "tip" and self.side < 0.0 and self.residual_fraction >= most:
            raise ConfigError(
                f"{self.name}: residual_fraction is {self.residual_fraction:g}, but with side -1 "
                f"and knee {self.knee:g} it stays below {most:.3g}"
            )

    @property
    def changes_nothing(self) -> bool:
        return self.residual_fraction == 0.0 and self.softness == 0.0

    def vector(self) -> Array:
        return np.array([self.side * self.residual_fraction, self.knee, self.softness])

    def with_vector(self, vector: Array) -> Self:
        """Return the same effect with other numbers.

        Args:
            vector: signed fraction, knee and softness.

        Returns:
            A new effect with the side of the fraction's sign.

        """
        signed = float(vector[0])
        return replace(
            self,
            residual_fraction=abs(signed),
            side=-1.0 if signed < 0.0 else 1.0,
            knee=float(vector[1]),
            softness=float(vector[2]),
        )

    def fresh(self) -> Self:
        new = replace(self)
        # A dataclass's own way into its frozen fields; the memory is none of its numbers.
        object.__setattr__(new, "_memory", _Memory())
        return new

    def deflect(self, when: Instants, loading: Loading) -> Array | None:
        """Return what friction takes from the elastic displacement, or adds to it.

        Args:
            when: times of the n samples.
            loading: joints, and the wrench that bends the arm.

        Returns:
            Translation and rotation vector (n, 6) in base_link, m and rad; None for nothing.

        """
        if self.changes_nothing or not len(when):
            return None
        memory = self._memory or _Memory()
        more = self._in_joints if self.form == "joints" else self._at_tip
        out = np.empty_like(loading.elastic)
        moved = [_MOVED[unit] for unit in loading.arm.units]
        for rows in self._places(memory, loading.joints, np.array(moved)):
            here = replace(
                loading,
                joints=loading.joints[rows],
                wrench=loading.wrench[rows],
                elastic=loading.elastic[rows],
            )
            out[rows] = -self.side * more(memory, here)
        return out

    def _places(self, memory: _Memory, joints: Array, moved: Array) -> Iterator[slice]:
        if not self.restarts:
            yield slice(0, len(joints))
            return
        first = 0
        while first < len(joints):
            if memory.place is None:
                memory.place = joints[first]
            gone = np.flatnonzero((np.abs(joints[first:] - memory.place) > moved).any(axis=1))
            last = first + int(gone[0]) if len(gone) else len(joints)
            if last > first:
                yield slice(first, last)
            if len(gone):
                memory.clear()
                memory.place = joints[last]
            first = last

    def _at_tip(self, memory: _Memory, loading: Loading) -> Array:
        slider = partial(_bouc_wen, self.knee)
        states, peak = memory.states(loading.elastic, partial(_typical_tip, loading), slider)
        turned = -np.expm1(-1.0 / self.knee)
        fraction, soft = self.residual_fraction, 1.0 + self.softness
        size = fraction * soft / (turned**2 + self.side * fraction * turned)
        softer = self.side * self.softness * loading.elastic
        return np.asarray(size * peak * states - softer)

    def _in_joints(self, memory: _Memory, loading: Loading) -> Array:
        arm = loading.arm
        columns = columns_at(loading)
        loads = np.einsum("nij,ni->nj", columns, loading.wrench)
        # Below the least fraction the deflection is taken for proportional to it.
        fraction = max(self.residual_fraction, _LEAST_FRACTION)
        ratio, way = shape(fraction)
        unit = load_of(ratio, way)

        def dahl(peak: Array) -> Callable[[Array, Array], Array]:
            level = np.where(peak > 0.0, peak, 1.0) / unit
            return lambda phi, change: slide(ratio, phi, change / level)

        phi, peak = memory.states(loads, partial(_typical_joints, loading, columns[0]), dahl)
        slack = phi * peak / unit / joint_stiffness(arm)
        taken = np.einsum("nij,nj->ni", columns, slack)
        return np.asarray(self.residual_fraction / fraction * taken)


def columns_at(loading: Loading) -> Array:
    """Return the twist of the tip over what each joint gives, at every sample.

    Args:
        loading: n samples; places nearer than 0.2 mm and mrad share their twists.

    Returns:
        Twists (n, 6, k) in base_link, as `joint_columns` has them.

    """
    # The arm stands most of the time.
    keys = np.round(loading.joints / _STILL_POSE_M).astype(np.int64)
    new = np.concatenate([[True], np.any(np.diff(keys, axis=0) != 0, axis=1)])
    places, which = np.unique(keys[new], axis=0, return_inverse=True)
    each = [joint_columns(place * _STILL_POSE_M, loading.tip_m, loading.arm) for place in places]
    return np.array(each)[which.ravel()[np.cumsum(new) - 1]]


def _bouc_wen(knee: float, peak: Array) -> Callable[[Array, Array], Array]:
    length = knee * np.where(peak > 0.0, peak, 1.0)

    def slide_tip(state: Array, change: Array) -> Array:
        sign = np.sign(change)
        gone = sign - (sign - state) * np.exp(-np.abs(change) / length)
        return np.where(change == 0.0, state, gone)

    return slide_tip


def _typical_tip(loading: Loading) -> Array:
    joints, tip_m, arm = loading.joints[0], loading.tip_m, loading.arm
    if arm.delta is not None:
        joints, tip_m = arm.home, TOOLS["retractor"].tip_m
    compliance = arm.tip_compliance(joints, tip_m)
    return _TYPICAL_FORCE_N * np.abs(compliance[:, :3]).max(axis=1)


def _typical_joints(loading: Loading, columns: Array) -> Array:
    arm = loading.arm
    if arm.delta is not None:
        return np.array([15.0] * 3 + [1.5] * (len(arm.joints) - 3) + [60.0] * 6)
    return np.asarray(_TYPICAL_FORCE_N * np.linalg.norm(columns[:3], axis=0))


class _Crept:
    """Time, elastic displacement (6,) and what has crept (6,) at the last sample."""

    def __init__(self) -> None:
        self.session_s: float | None = None
        self.elastic = np.zeros(6)
        self.state = np.zeros(6)


@dataclass(frozen=True)
class DeflectionCreep(Effect):
    """Under a load the deflection goes on by `fraction` of the elastic one, over `tau_s`.

    To the elastic displacement e of the tip comes c with tau dc/dt = fraction e - c, exact where e
    goes straight from sample to sample.
    """

    name = "deflection_creep"
    fitted = (
        Fitted("fraction", "", 0.1, -0.9, 5.0),
        Fitted("tau_s", "s", 3.0, 0.02, 1e3),
    )
    limit_parts = ("",)

    fraction: float = param(
        0.0, "what the deflection goes on by under a constant load, over the elastic one", -0.9, 5.0
    )
    tau_s: float = param(3.0, "time in which it does by 63 % of that, s", 0.02, 1e3)

    _memory: ClassVar[_Crept | None] = None

    @property
    def changes_nothing(self) -> bool:
        return self.fraction == 0.0

    def fresh(self) -> Self:
        new = replace(self)
        # A dataclass's own way into its frozen fields; the memory is none of its numbers.
        object.__setattr__(new, "_memory", _Crept())
        return new

    def deflect(self, when: Instants, loading: Loading) -> Array | None:
        """Return what has crept until each sample.

        Args:
            when: times of the n samples; those of the session count.
            loading: of which the elastic displacement counts.

        Returns:
            Translation and rotation vector (n, 6) in base_link, m and rad; None for nothing.

        """
        if self.fraction == 0.0 or not len(when):
            return None
        memory = self._memory or _Crept()
        if memory.session_s is None:
            memory.session_s = float(when.session_s[0])
        steps = np.diff(when.session_s, prepend=memory.session_s) / self.tau_s
        keep = np.exp(-steps)
        # Share of the step's end, of 1 - keep, in what is added over a straight step.
        with np.errstate(divide="ignore", invalid="ignore"):
            late = np.where(steps > 1e-6, 1.0 - (1.0 - keep) / steps, 0.5 * steps)
        before = np.concatenate([memory.elastic[None], loading.elastic[:-1]])
        more = late[:, None] * loading.elastic + (1.0 - keep - late)[:, None] * before
        out, state = np.empty_like(more), memory.state
        for row, (share, added) in enumerate(zip(keep.tolist(), more, strict=True)):
            state = share * state + added
            out[row] = state
        memory.session_s, memory.elastic = float(when.session_s[-1]), loading.elastic[-1]
        memory.state = state
        return self.fraction * out
