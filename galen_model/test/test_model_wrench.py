# SPDX-License-Identifier: Apache-2.0
"""Wrench algebra: power is the same in every frame, and forces act where they act."""

import numpy as np
from galen_model.registration import move_twist, move_wrench
from galen_model.rotation import rotvec_to_matrix


def test_power_does_not_depend_on_the_frame():
    rng = np.random.default_rng(1)
    for _ in range(20):
        rotation, origin = rotvec_to_matrix(rng.standard_normal(3)), rng.standard_normal(3)
        twist_b, wrench_b = rng.standard_normal((2, 6))
        turned = np.concatenate([rotation @ twist_b[:3], rotation @ twist_b[3:]])
        twist_a = move_twist(turned, origin, np.zeros(3))
        wrench_a = move_wrench(wrench_b, rotation, origin)
        np.testing.assert_allclose(twist_a @ wrench_a, twist_b @ wrench_b, atol=1e-12)


def test_levers():
    # 2 N along y, 0.3 m out along x: 0.6 N.m about z; and a body that turns about z
    moved = move_wrench([0, 2, 0, 0, 0, 0], np.eye(3), [0.3, 0, 0])
    np.testing.assert_allclose(moved, [0, 2, 0, 0, 0, 0.6], atol=1e-15)
    moved = move_twist([0, 0, 0, 0, 0, 2.0], [0, 0, 0], [0.5, 0, 0])
    np.testing.assert_allclose(moved, [0, 1.0, 0, 0, 0, 2.0], atol=1e-15)
