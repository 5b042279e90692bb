"""The Galen's numbers: geometry, limits, stiffness, sensor and tracker.

Source: the 2019 report and public Galen/REMS material; what is not published is estimated.
Units are SI; angles in rad.
"""

from dataclasses import dataclass, field

import numpy as np

from galen_model.arm.arm import Arm, Joint
from galen_model.arm.arm import constant as _vector
from galen_model.arm.delta import LinearDelta
from galen_model.arrays import Array

GRAVITY_M_S2 = np.array([0.0, 0.0, -9.80665])
GRAVITY_M_S2.setflags(write=False)
"""Gravity in base_link."""

BASE_FRAME = "base_link"
SENSOR_FRAME = "ft_sensor"
TIP_FRAME = "tool_tip"
TRACKER_FRAME = "tracker"

WRENCH_AXES = ("fx", "fy", "fz", "tx", "ty", "tz")
"""Order of a wrench everywhere: force (N), then torque about the sensor's origin (N.m)."""


_X, _Y, _Z, _HERE = _vector(1, 0, 0), _vector(0, 1, 0), _vector(0, 0, 1), _vector(0, 0, 0)

# The platform's box is the usable volume published for the arm. At home's height the carriages
# stay within their travel all over it; in its upper part they don't (`LinearDelta.carriages`
# raises): the highest z is 0.658 m on the axis, but 0.503 m at the worst corner, less than the
# box's 0.618 m.
GALEN = Arm(
    name="galen",
    joints=(
        Joint("delta_x", "prismatic", _X, _HERE, -0.14, 0.14, link="delta_x_link"),
        Joint("delta_y", "prismatic", _Y, _HERE, -0.14, 0.14, link="delta_y_link"),
        Joint(
            "delta_z",
            "prismatic",
            _Z,
            _HERE,
            0.408 - 0.21,
            0.408 + 0.21,
            home=0.408,
            link="delta_platform",
        ),
        Joint(
            "roll",
            "revolute",
            _X,
            _vector(0, 0, 0.07614),
            -1.57,
            1.57,
            stiffness=2000.0,
            link="roll_link",
        ),
        Joint(
            "tilt",
            "revolute",
            _Y,
            _vector(0.6085, 0, 0.013),
            -1.04,
            0.96,
            stiffness=1500.0,
            link="tilt_link",
        ),
    ),
    sensor_origin_m=_vector(0.031248, 0.0, 0.025),
    sensor_rotation=np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]),  # Ry(pi/2)
    delta=LinearDelta(
        rod_length_m=0.440,
        rail_radius_m=0.215,
        platform_radius_m=0.050,
        rod_half_spacing_m=0.0552,
        leg_angles_rad=(-np.pi / 3, np.pi / 3, np.pi),
        carriage_travel_m=0.25,
        carriage_stiffness=3e5,
        rod_stiffness=2e6,
        home_m=(0.0, 0.0, 0.408),
    ),
)
"""The nominal arm: a linear delta carries a roll joint, then a tilt joint, then the sensor."""


@dataclass(frozen=True)
class SensorParameters:
    """Noise (one sample), quantum and range of the six axes, shape (6,), N and N.m."""

    noise_std: Array = field(
        default_factory=lambda: _vector(0.02, 0.02, 0.03, 0.4e-3, 0.4e-3, 0.4e-3)
    )
    quantum: Array = field(default_factory=lambda: _vector(*[0.005] * 3, *[0.1e-3] * 3))
    range: Array = field(default_factory=lambda: _vector(125.0, 125.0, 500.0, 3.0, 3.0, 3.0))


SENSOR = SensorParameters()

ENCODER_QUANTUM = _vector(5e-6, 5e-6, 5e-6, 5e-5, 5e-5)
"""Step of each joint's encoder, shape (5,), m and rad."""

TRACKER_POSITION_NOISE_M = 0.03e-3
TRACKER_ROTATION_NOISE_RAD = 0.1e-3
