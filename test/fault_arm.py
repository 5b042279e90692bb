# SPDX-License-Identifier: Apache-2.0
"""An arm by the contract's numbers, and a driver that publishes what it is told."""

import numpy as np
from galen_common.cdr import joint_state_bytes, wrench_bytes
from galen_ros.messages import STREAM
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState

MS, S = 1_000_000, 1_000_000_000
PERIOD_NS = 10 * MS
JOINTS = ("delta_x", "delta_y", "delta_z", "roll", "tilt")
HOME = (0.0, 0.0, 0.408)
MASS_KG, COM_M = 0.2, np.array([0.07, -0.01, 0.055])
ADAPTER_KG, ADAPTER_COM_M = 0.1, np.array([0.0, 0.0, 0.02])


def weight(roll, tilt, mass_kg=MASS_KG):
    """Tool's weight by the contract, section 2, from its numbers alone: (6,), N and N.m.

    Sensor's axes in base_link: Rx(roll) Ry(tilt) Ry(pi/2). The adapter was zeroed at home.
    """
    f, torque = np.zeros(3), np.zeros(3)
    loads = [(mass_kg, COM_M, roll, tilt, 1), (ADAPTER_KG, ADAPTER_COM_M, roll, tilt, 1)]
    for mass, com, r, t, sign in [*loads, (ADAPTER_KG, ADAPTER_COM_M, 0.0, 0.0, -1)]:
        turned = t + np.pi / 2
        x = np.array([[1, 0, 0], [0, np.cos(r), -np.sin(r)], [0, np.sin(r), np.cos(r)]])
        c, s = np.cos(turned), np.sin(turned)
        y = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        pull = sign * mass * (x @ y).T @ np.array([0.0, 0.0, -9.80665])
        f, torque = f + pull, torque + np.cross(com, pull)
    return np.concatenate([f, torque])


class Source(Node):
    """A driver that publishes what it is told, and nothing by itself."""

    def __init__(self, name, **options):
        super().__init__(name, **options)
        self.joints_out = self.create_publisher(JointState, "joint_states", STREAM)
        self.wrench_out = self.create_publisher(WrenchStamped, "wrench_raw", STREAM)

    def joints(self, stamp_ns, roll, tilt, names=JOINTS):
        values = dict(zip(JOINTS, (*HOME, roll, tilt), strict=True))
        positions = [values.get(name, 9.0) for name in names]
        data = joint_state_bytes(names).fill(stamp_ns, positions, [0.0] * len(names))
        self.joints_out.publish(data)

    def wrench(self, stamp_ns, wrench, frame_id="ft_sensor"):
        self.wrench_out.publish(wrench_bytes(frame_id).fill(stamp_ns, list(wrench)))
