# SPDX-License-Identifier: Apache-2.0
"""Hysteresis of the deflection: Dahl's law itself, and the joints that it is in."""

import numpy as np
import pytest
from galen_model.arm.galen import GALEN
from galen_model.load.model import TOOLS
from galen_sim_driver.effects.hysteresis import (
    joint_columns,
    load_of,
    residual_fraction,
    shape,
    slide,
)
from scipy.optimize import brentq

RETRACTOR = TOOLS["retractor"].tip_m
TURNED = (0.03, -0.05, 0.45, 0.8, -0.6)


class DahlFriction:
    """Friction of several joints, each beside a spring of 1, from the first load on."""

    def __init__(self, ratio, level):
        self.ratio, self.level = ratio, level
        self.at = np.zeros(len(level))
        self.phi = np.zeros(len(level))

    @property
    def friction(self):
        return self.level * self.phi

    def load(self, load):
        self.phi = slide(self.ratio, self.phi, (load - self.at) / self.level)
        self.at = load


# --- the law ------------------------------------------------------------------------------------


def by_small_steps(ratio, loads, step=1e-4):
    """phi after each load (over F_c): Dahl's equation by the midpoint rule, in steps of y."""
    y = phi = 0.0
    out = []
    for load in loads:
        sign = np.sign(load - (y / ratio + phi))
        while sign * (load - (y / ratio + phi)) > 0.0:
            middle = phi + 0.5 * step * sign * (1.0 - sign * phi)
            phi += step * sign * (1.0 - sign * middle)
            y += step * sign
        out.append(phi)
    return np.array(out)


@pytest.mark.parametrize("ratio", [0.05, 0.3, 2.0])
def test_the_friction_solves_dahls_equation(ratio):
    loads = np.array([1.5, 0.2, 0.9, -4.0, -4.0, 0.0, 0.3, -0.3])
    joint = DahlFriction(ratio, np.array([1.0]))
    phi = []
    for load in loads:
        joint.load(np.array([load]))
        phi.append(joint.friction[0])
    # One step too many at a turn is up to 2e-4 of phi.
    assert np.abs(phi - by_small_steps(ratio, loads)).max() < 5e-4
    assert 0.1 < np.ptp(phi) < 2.0


def test_a_loop_keeps_the_energy_that_the_law_takes():
    # In a steady loop between -Y and Y friction runs between -tanh(Y) and tanh(Y) F_c, and keeps
    # the integral of F over x: 4 (F_c^2 / sigma) (Y - tanh(Y)). Here F_c and k are 1.
    ratio, amplitude, a_turn = 0.5, 2.0, 2000
    joint = DahlFriction(ratio, np.array([1.0]))
    loads = amplitude * np.sin(2.0 * np.pi * np.arange(8 * a_turn + 1) / a_turn)
    friction = []
    for load in loads:
        joint.load(np.array([load]))
        friction.append(joint.friction[0])
    displacement = loads - np.array(friction)
    work = np.cumsum(0.5 * (loads[1:] + loads[:-1]) * np.diff(displacement))
    way = brentq(lambda y: y / ratio + np.tanh(y) - amplitude, 0.0, 10.0)
    expected = 4.0 / ratio * (way - np.tanh(way))
    assert work[-1] - work[-1 - a_turn] == pytest.approx(expected, rel=1e-4)
    assert work.min() >= 0.0


@pytest.mark.parametrize("wanted", [1e-4, 0.01, 0.0742, 0.2, 0.5])
def test_the_largest_residual_fraction_is_what_was_asked_for(wanted):
    ratio, way = shape(wanted)
    reference = load_of(ratio, way)

    def left(times):
        joint = DahlFriction(ratio, np.array([1.0]))
        joint.load(np.array([times * reference]))
        pushed = times * reference - joint.friction[0]
        joint.load(np.array([0.0]))
        return -joint.friction[0] / pushed

    assert left(1.0) == pytest.approx(wanted, rel=1e-6)
    others = [left(times) for times in np.geomspace(0.05, 20.0, 60)]
    assert max(others) <= wanted * (1.0 + 1e-9)
    # As the module says of how it depends on the load, and the formula agrees with the walk.
    for times in (0.5, 0.8, 1.25, 2.0):
        y = brentq(lambda y, t=times: load_of(ratio, y) - t * reference, 1e-9, 100.0 * way)
        assert left(times) == pytest.approx(residual_fraction(ratio, y), rel=1e-6)
    if wanted == 0.0742:
        lower = [left(times) / wanted for times in (0.8, 1.25, 0.5, 2.0)]
        assert lower == pytest.approx([0.98, 0.978, 0.839, 0.80], abs=1e-3)


# --- in the joints ------------------------------------------------------------------------------


# Which columns are of one kind, and what the arm calls their stiffness.
KINDS = {
    "carriage": (slice(0, 3), "carriage"),
    "roll": (slice(3, 4), "roll"),
    "tilt": (slice(4, 5), "tilt"),
    "rod": (slice(5, 11), "rod"),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("joints", [GALEN.home.tolist(), TURNED])
def test_the_joints_are_those_of_the_nominal_compliance(kind, joints):
    # By the six-rod formula with and without that kind's give; the columns don't come from it.
    which, stiffness = KINDS[kind]
    rigid = GALEN.with_stiffness({stiffness: 1e15})
    expected = GALEN.tip_compliance(joints, RETRACTOR) - rigid.tip_compliance(joints, RETRACTOR)
    column = joint_columns(joints, RETRACTOR, GALEN)[:, which]
    found = column @ column.T / GALEN.stiffness[stiffness]
    assert np.abs(found - expected).max() < 1e-8 * np.abs(expected).max()
