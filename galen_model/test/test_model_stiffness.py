# SPDX-License-Identifier: Apache-2.0
"""Nominal deflection: against energy, finite differences of geometry, and published-like values."""

import numpy as np
import pytest
from galen_model.arm.galen import GALEN
from galen_model.rotation import rotvec_to_matrix

TIP = np.array([0.15, 0.0, 0.05])


def test_flange_stiffness_at_home():
    """66, 10.5 and 36 N/mm in x, y, z: computed independently for the study of this arm."""
    compliance = GALEN.tip_compliance(GALEN.home, np.zeros(3))
    np.testing.assert_allclose(1.0 / np.diag(compliance)[:3] / 1e3, [66.0, 10.5, 36.0], rtol=0.01)


def test_compliance_is_symmetric_and_positive():
    rng = np.random.default_rng(1)
    for q in rng.uniform(GALEN.lower, GALEN.upper, (20, 5)):
        compliance = GALEN.tip_compliance(q, TIP)
        np.testing.assert_allclose(compliance, compliance.T, rtol=1e-9, atol=1e-15)
        assert np.linalg.eigvalsh(compliance).min() > 0.0


@pytest.mark.parametrize("platform", [(0.0, 0.0, 0.408), (0.05, -0.03, 0.45), (-0.05, 0.07, 0.35)])
def test_platform_stiffness_equals_the_rods_strain_energy(platform):
    """A second way: minimise the rods' and carriages' energy for a small rigid displacement.

    Each rod's stretch follows from the moved ball joints' geometry, not from the rows [n, B x n].
    """
    rng, p = np.random.default_rng(2), np.array(platform)
    directions = GALEN.delta.rod_directions(p)
    for _ in range(5):
        twist = rng.standard_normal(6) * 1e-6
        turn = rotvec_to_matrix(twist[3:])
        stretch, leg_of = [], []
        for leg, angle in enumerate(GALEN.delta.leg_angles_rad):
            radial = np.array([np.cos(angle), np.sin(angle), 0.0])
            along = np.array([-np.sin(angle), np.cos(angle), 0.0])
            for side in (1, -1):
                ball = 0.050 * radial + side * 0.0552 * along
                foot = p + ball - GALEN.delta.rod_length_m * directions[leg]
                moved = p + twist[:3] + turn @ ball
                stretch.append(np.linalg.norm(moved - foot) - GALEN.delta.rod_length_m)
                leg_of.append(leg)
        stretch, leg_of = np.array(stretch), np.array(leg_of)
        # carriage i yields by s_i along z, taking n_z s_i off its two rods' stretch
        energy = 0.0
        for leg in range(3):
            mine, nz = stretch[leg_of == leg], directions[leg, 2]
            k, kq = GALEN.delta.rod_stiffness, GALEN.delta.carriage_stiffness
            yield_m = k * nz * mine.sum() / (kq + 2 * k * nz**2)
            energy += 0.5 * kq * yield_m**2 + 0.5 * k * np.sum((mine - nz * yield_m) ** 2)
        assert 0.5 * twist @ GALEN.delta.platform_stiffness(p) @ twist == pytest.approx(
            energy, rel=1e-4
        )


def test_roll_spring_alone():
    """With the rest rigid, a moment about the roll axis turns the tip about that axis."""
    stiff = GALEN.with_stiffness({"carriage": 1e15, "rod": 1e15, "tilt": 1e15})
    q = np.array([0.02, 0.01, 0.42, 0.4, -0.3])
    rotation, origin = GALEN.sensor_pose(q)
    _, tip = GALEN.tip_pose(q, TIP)
    points, axes = GALEN.joint_axes(q)
    point, axis = points[3], axes[3]
    force_base = np.array([0.0, 3.0, -1.0])
    wrench = np.concatenate([rotation.T @ force_base, np.zeros(3)])
    angle = axis @ np.cross(origin - point, force_base) / 2000.0
    expected = np.concatenate([np.cross(axis * angle, tip - point), axis * angle])
    np.testing.assert_allclose(stiff.deflection(q, wrench, TIP), expected, rtol=1e-6, atol=1e-12)
