"""Friction under a load that turns.

Dahl's friction beside the spring of every joint, under a prescribed load.

A joint's spring of nominal stiffness k carries the load u less a friction F that follows the
joint's displacement x (P. R. Dahl, Solid friction damping of mechanical vibrations, AIAA Journal
14 (12), 1976, pp. 1675-1682, with the exponent 1):

    k x + F = u,    dF/dx = sigma (1 - sign(dx) F / F_c)

In units y = sigma x / F_c, phi = F / F_c and a = sigma / k the first is y / a + phi = u / F_c. As
long as the load goes one way, s = sign(du), the friction goes to it exponentially, and the way e
that a change D of u / F_c takes y is Lambert's function W (the lower line follows from the upper):

    phi' = s (1 - g exp(-e)),    g = 1 - s phi,    e / a + g (1 - exp(-e)) = D
    e = c + W(a g exp(-c)),      c = a (D - g)

That is exact for a step of any size, so what comes out depends on where the load turned and not on
how often somebody looked; and not on speed.

A first push to y = Y and back to no load leaves y_0 = a - W(a (2 - exp(-Y)) exp(a - Y)). The
fraction y_0 / Y is small after small pushes (they hardly slide) and after large ones (F_c is all
that holds against the spring) and has one largest value between. That is what is asked for here,
at a load that is asked for; F_c and a follow. Around that load the fraction hardly depends on it: a
fraction of 0.07 is 2 % lower at 0.8 and 1.25 times that load, 16 % at half and 20 % at twice.

The joints are the three carriages, roll and tilt, and the six rods with what slips in the seats of
their balls, which bend the most. What each takes of a wrench is determined without their
stiffness: six rods hold the platform as the square matrix A of their rows [n, B x n] says
(`galen_model.arm.stiffness`), so that a rod that grows by 1 moves it by a column of A^-1, and a
carriage moves it without turning it, since its two rods stay parallel.

Where a load turns: what a friction's state hangs on, and nothing between.

A law without memory of time goes the same way whether it is looked at often or seldom, as long as
the load goes on in one direction. So its state is computed from turn to turn, and every sample from
the turn before it.

Noise makes a measured load turn at every other sample. Small swings wear a friction of Dahl's kind
off, which no real joint knows, and swings below a gate are therefore none.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from galen_model.arm.delta import LinearDelta
from galen_model.arm.galen import ArmParameters
from galen_model.arm.kinematics import tip_jacobian, tip_pose
from galen_model.arrays import Array
from galen_model.wrench import move_twist
from numpy.typing import ArrayLike
from scipy.optimize import brentq, minimize_scalar
from scipy.special import lambertw


def slide(ratio: float, phi: Array, change: Array) -> Array:
    """Friction over F_c after the load over F_c has changed straight; arrays of one shape.

    ratio: a. phi: the friction before.
    """
    sign = np.sign(change)
    gap = 1.0 - sign * phi
    shift = ratio * (np.abs(change) - gap)
    way = shift + lambertw(ratio * gap * np.exp(-shift)).real
    # Without a change the way is nothing but rounding, and there is no sign to go to.
    moved = sign * (1.0 - gap * np.exp(-np.maximum(way, 0.0)))
    return np.where(change == 0.0, phi, moved)


def residual_fraction(ratio: float, way: float) -> float:
    """y_0 / Y of a first push to Y = `way`; `ratio` is a."""
    left = ratio - lambertw(ratio * (2.0 - np.exp(-way)) * np.exp(ratio - way)).real
    return float(left / way)


def load_of(ratio: float, way: float) -> float:
    """Load over F_c that takes a joint without friction to Y = `way`; `ratio` is a."""
    return float(way / ratio - np.expm1(-way))


@cache
def shape(largest_fraction: float) -> tuple[float, float]:
    """The ratio a whose largest residual fraction this is, and the way Y after which it is left."""

    def peak(ratio: float) -> float:
        # Little friction has its peak at Y = 1.26, much friction at Y near a.
        found = minimize_scalar(
            lambda way: -residual_fraction(ratio, way),
            bounds=(0.5, 3.0 + 2.0 * ratio),
            method="bounded",
            options={"xatol": 1e-9},
        )
        return float(found.x)

    # It is 0.41 a for a small a, and less for others.
    ratio = brentq(
        lambda a: residual_fraction(a, peak(a)) - largest_fraction,
        2.0 * largest_fraction,
        100.0 * largest_fraction,
        xtol=1e-12,
    )
    return float(ratio), peak(ratio)


def joint_stiffness(arm: ArmParameters) -> Array:
    """Stiffness (11,) of three carriages, roll, tilt and six rods, N/m and N.m/rad."""
    return np.array(
        [arm.carriage_stiffness_n_m] * 3
        + [arm.roll_stiffness_nm_rad, arm.tilt_stiffness_nm_rad]
        + [arm.rod_stiffness_n_m] * 6
    )


def joint_columns(joints: ArrayLike, tip_m: ArrayLike, arm: ArmParameters) -> Array:
    """Twist of the tip (6, 11) in base_link over what carriages, roll, tilt and rods give.

    joints (5,): m, rad. tip_m (3,): in ft_sensor.
    """
    q = np.asarray(joints, dtype=float)
    delta = LinearDelta(arm)
    columns = np.zeros((6, 11))
    columns[:, :5] = tip_jacobian(q, tip_m, arm)
    columns[:3, :3] = np.linalg.inv(delta.jacobian(q[:3]))
    rods = np.linalg.inv(delta.rod_rows(q[:3]))
    _, tip = tip_pose(q, tip_m, arm)
    columns[:, 5:] = move_twist(rods.T, q[:3], tip).T
    return columns


def turning_points(values: Array, gate: float) -> np.ndarray:
    """Indices, increasing, at which values (n,) turn by more than `gate`; the first is always 0.

    A turn is where the values were farthest, before they came back by more than the gate.
    """
    turns = [0]
    far, since = np.abs(values - values[0]) > gate, np.arange(len(values))
    if not far.any():
        return np.array(turns)
    # The first value that is off by the gate tells the direction that it starts in.
    up = bool(values[int(since[far][0])] > values[0])
    plain = values.tolist()
    farthest, at = plain[0], 0
    for index, value in enumerate(plain):
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
    """States (n, k) of k frictions under loads (n, k), before which they had `before` and `start`.

    before, start (k,): load and state of the last sample. gates (k,). slide(states, changes) gives
    the states after the loads have changed straight by `changes`, for arrays (..., k).
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
