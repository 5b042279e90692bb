"""A cable that pulls at the tool: from a point on it to an anchor in base_link.

    T(d) = T_0 g(kappa (d - d_0)),   g(x) = c ln(1 + exp((x_1 + x) / c)),   c = 1/4

is the tension at a distance d from attachment to anchor, T_0 that at the distance d_0: a spring of
stiffness kappa T_0 where the cable is taut, nothing where it is slack, with a rounded corner
between, as a sagging cord has it; x_1 is such that g(0) = 1. It is smooth in all its numbers, and
for a given kappa proportional to T_0.

The cord is bent where it leaves the tool: at home it lies straight, and where its direction l in
ft_sensor is another than n at home, it turns the tool back to it by M = B n x l. A cable without
weight, free to turn at its anchor, passes that moment on as a force across itself, so that all of
it together has no moment about the anchor:

    f = T l + (M x l) / d,    tau = r x f + M     about the sensor's origin, r to the attachment.

Cables on real arms have weight and friction and lie against things as well. None of that is here.
"""

from __future__ import annotations

import numpy as np
from galen_model.arrays import Array
from galen_model.rotation import skew
from numpy.typing import ArrayLike

_CORNER = 0.25
_TAUT = _CORNER * float(np.log(np.expm1(1.0 / _CORNER)))
_NEAREST_M = 0.01
"""Nearer than this the line has no direction any more; the cable is slack there."""


def cable_line(
    rotation: ArrayLike, origin: ArrayLike, anchor_m: ArrayLike, attachment_m: ArrayLike
) -> tuple[Array, Array]:
    """Distance (...,), m, from attachment to anchor, and the direction there (..., 3) in ft_sensor.

    rotation (..., 3, 3) R_base_sensor; origin (..., 3) of the sensor and anchor (3,) in base_link;
    attachment (3,) in ft_sensor, m.
    """
    to_anchor = np.asarray(anchor_m, dtype=float) - np.asarray(origin, dtype=float)
    line = np.einsum("...ji,...j->...i", np.asarray(rotation), to_anchor)
    line = line - np.asarray(attachment_m, dtype=float)
    distance_m = np.linalg.norm(line, axis=-1)
    return distance_m, line / np.maximum(distance_m, 1e-9)[..., None]


def relative_tension(farther: ArrayLike) -> Array:
    """g(x): the tension over T_0, for x = kappa (d - d_0)."""
    return _CORNER * np.logaddexp(0.0, (_TAUT + np.asarray(farther, dtype=float)) / _CORNER)


def cable_wrench(
    tension_n: ArrayLike,
    bending_nm: float,
    distance_m: Array,
    direction: Array,
    home_direction: Array,
    attachment_m: ArrayLike,
) -> Array:
    """Force and torque (..., 6) about the sensor's origin in ft_sensor, N and N.m.

    tension, distance (...,); direction (..., 3) and home_direction (3,) in ft_sensor.
    """
    force = np.asarray(tension_n)[..., None] * direction
    # r x f as a product: numpy's cross takes longer than all the rest of one sample.
    torque_of = skew(attachment_m).T
    if not bending_nm:
        return np.concatenate([force, force @ torque_of], axis=-1)
    moment = bending_nm * direction @ skew(home_direction).T
    span_m = np.maximum(distance_m, _NEAREST_M)[..., None]
    # (n x l) x l = l (n.l) - n
    across = bending_nm * (direction * (direction @ home_direction)[..., None] - home_direction)
    force = force + across / span_m
    return np.concatenate([force, force @ torque_of + moment], axis=-1)
