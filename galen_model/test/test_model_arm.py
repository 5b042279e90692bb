# SPDX-License-Identifier: Apache-2.0
"""The arm's numbers, written down a second time, and readings worked out by hand.

Other tests take the numbers from the package on both sides, and would follow a typing error. The
geometry is in test_model_kinematics.py, the stiffness in test_model_stiffness.py.
"""

import numpy as np
import pytest
from galen_model.arm.galen import (
    ENCODER_QUANTUM,
    GALEN,
    SENSOR,
    TRACKER_POSITION_NOISE_M,
    TRACKER_ROTATION_NOISE_RAD,
)
from galen_model.load.model import ADAPTER, TOOLS, nominal_reading


def test_sensor_encoders_and_tracker():
    assert SENSOR.noise_std.tolist() == [0.02, 0.02, 0.03, 0.0004, 0.0004, 0.0004]
    assert SENSOR.quantum.tolist() == [0.005, 0.005, 0.005, 0.0001, 0.0001, 0.0001]
    assert SENSOR.range.tolist() == [125.0, 125.0, 500.0, 3.0, 3.0, 3.0]
    assert ENCODER_QUANTUM.tolist() == [5e-6, 5e-6, 5e-6, 5e-5, 5e-5]
    assert (TRACKER_POSITION_NOISE_M, TRACKER_ROTATION_NOISE_RAD) == (0.03e-3, 0.1e-3)


def test_loads():
    loads = {"adapter": ADAPTER, **{name: tool.load for name, tool in TOOLS.items()}}
    assert {name: [load.mass_kg, *load.com_m] for name, load in loads.items()} == {
        "adapter": [0.100, 0.0, 0.0, 0.020],
        "pointer": [0.060, 0.055, 0.002, 0.045],
        "retractor": [0.200, 0.070, -0.010, 0.055],
    }
    assert TOOLS["pointer"].tip_m.tolist() == [0.150, 0.0, 0.050]
    assert TOOLS["retractor"].tip_m.tolist() == [0.180, 0.010, 0.050]


@pytest.mark.parametrize(
    ("roll_deg", "tilt_deg", "gravity"),
    [
        # level: the sensor's z looks forward, its x down
        (0.0, 0.0, (1.0, 0.0, 0.0)),
        # a quarter turn about x: the sensor's y looks up
        (90.0, 0.0, (0.0, -1.0, 0.0)),
        # nose down: the sensor's z looks down
        (0.0, 90.0, (0.0, 0.0, 1.0)),
        (0.0, -90.0, (0.0, 0.0, -1.0)),
    ],
)
def test_a_reading_worked_out_by_hand(roll_deg, tilt_deg, gravity):
    x, y, z = 9.80665 * np.array(gravity)
    reading = nominal_reading(
        np.radians([roll_deg, tilt_deg]),
        TOOLS["pointer"].load,
        ADAPTER,
        arm=GALEN,
    )
    # tool: 60 g at (55, 2, 45) mm; adapter: 100 g at (0, 0, 20) mm; zeroed level with it
    force = [0.160 * x - 0.980665, 0.160 * y, 0.160 * z]
    torque = [
        0.060 * (0.002 * z - 0.045 * y) - 0.100 * 0.020 * y,
        0.060 * (0.045 * x - 0.055 * z) + 0.100 * 0.020 * x - 0.0196133,
        0.060 * (0.055 * y - 0.002 * x),
    ]
    np.testing.assert_allclose(reading, [*force, *torque], atol=1e-12)


def test_carriages_worked_out_by_hand():
    """Platform at (100, 0) mm: two feet stand ahead at (82.5, +-142.9) mm, one behind at -165."""
    near = np.sqrt(0.440**2 - ((0.100 - 0.0825) ** 2 + 0.165**2 * 0.75))
    far = np.sqrt(0.440**2 - 0.265**2)
    home = np.sqrt(0.440**2 - 0.165**2)
    q = GALEN.delta.carriages([0.1, 0.0, 0.408])
    np.testing.assert_allclose(q, [home - near, home - near, home - far], atol=1e-12)
    assert q[0] < 0.0 < q[2]
