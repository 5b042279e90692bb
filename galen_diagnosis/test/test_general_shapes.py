# SPDX-License-Identifier: Apache-2.0
"""Effects of a general shape against their definitions."""

import numpy as np
import pytest
from galen_diagnosis.effects.general_shapes import ForceField, FrictionInJoints, SoftSaturation
from galen_model.arm.galen import GALEN
from galen_sim_driver.effects.effect import Instants, Loading

TIP_M = np.array([0.15, 0.0, 0.05])


def instants(count):
    return Instants("push", np.arange(float(count)), np.arange(float(count)))


def test_a_force_field_is_the_gradient_of_a_potential():
    """A field without friction has no curl: its Jacobian is symmetric, by finite differences."""
    generator = np.random.default_rng(1)
    one = ForceField(
        force_n=(1.0, 2.0, 3.0),
        stiffness_n_m=tuple(generator.normal(size=6)),
        cubic_n_m2=tuple(generator.normal(size=10)),
    )
    at, step = generator.normal(size=3), 1e-5
    ways = step * np.eye(3)
    here = np.eye(3)[None]
    jacobian = np.array(
        [(one.force(here, (at + way)[None]) - one.force(here, (at - way)[None]))[0] for way in ways]
    ) / (2.0 * step)
    np.testing.assert_allclose(jacobian, jacobian.T, atol=1e-8)
    assert np.linalg.norm(jacobian) > 1.0
    np.testing.assert_allclose(one.force(here, np.zeros((1, 3)))[0], one.force_n)


def loading(forces, joints=GALEN.home):
    wrench = np.concatenate([forces, np.zeros_like(forces)], axis=1)
    elastic = wrench @ GALEN.tip_compliance(joints, TIP_M).T
    return Loading(np.tile(joints, (len(forces), 1)), wrench, elastic, TIP_M, GALEN)


def test_friction_in_a_joint_holds_its_threshold_back():
    """After a load beyond twice its threshold F a joint stands F / k behind, and F / k ahead."""
    none = FrictionInJoints.of(GALEN, TIP_M)
    assert none.deflect(instants(2), loading(np.zeros((2, 3)))) is None
    tilt = GALEN.joint_names.index("tilt")
    joint = none.joined().of_numbers(
        [float(joints == (tilt,)) for joints in dict.fromkeys(j for j, _ in none.plays)],
        np.full(len(none.joined().plays), 0.1),
    )
    up = np.array([[0.0, 0.0, push] for push in (0.0, 10.0, 0.0, -10.0, 0.0)])
    behind = joint.deflect(instants(5), loading(up))
    np.testing.assert_allclose(behind[1], -behind[2], atol=1e-15)
    np.testing.assert_allclose(behind[2], -behind[4], atol=1e-15)
    column = GALEN.tip_jacobian(GALEN.home, TIP_M)[:, tilt]
    np.testing.assert_allclose(
        np.abs(behind[2]), np.abs(column) * 0.1 / GALEN.joints[tilt].stiffness
    )
    rubs = joint.of_numbers(np.linspace(0.5, 0.9, len(joint.plays)), np.full(len(joint.plays), 0.2))
    moved = []
    for push in 10.0 * np.eye(3):
        there = loading(np.stack([push, np.zeros(3)]))
        moved.append((there.elastic + rubs.deflect(instants(2), there))[:, :3])
    pushed, stayed = np.sum(np.square(moved), axis=(0, 2))
    told = rubs.residual_fraction(GALEN.home, TIP_M, GALEN)
    assert 0.01 < told == pytest.approx(np.sqrt(stayed / pushed), rel=1e-3)
    assert none.residual_fraction(GALEN.home, TIP_M, GALEN) == 0.0


def test_a_soft_limit_is_undone_up_to_near_its_limit():
    one = SoftSaturation(np.log(5.0), np.log(15.0), "fz")
    true = np.zeros((7, 6))
    true[:, 2] = [-4.9, -3.0, 0.0, 1.0, 4.0, 4.9, 100.0]
    true[:, 0] = 50.0
    read = one.read(instants(7), true)
    np.testing.assert_allclose(one.unread(instants(7), read)[:6], true[:6], rtol=1e-9)
    assert read[6, 2] == pytest.approx(5.0, rel=1e-6)
    assert np.all(read[:, 0] == 50.0)
    assert read[4, 2] == pytest.approx(4.0 / (1.0 + 0.8**15) ** (1 / 15))
