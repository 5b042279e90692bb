# SPDX-License-Identifier: Apache-2.0
"""Programs that stand beside the nodes in the tests of faults: python fault_processes.py WHICH.

driver: an arm in motion, pushed by PUSH; every sample is a function of its stamp.
relay: a bad network: takes true/joint_states and true/wrench_raw, and passes them on repeated,
late, out of order, or not at all; its chances come from a fixed seed.
pass: a good one.
subscriber: hears wrench_compensated, and does nothing with it.
"""

import sys
import time

import numpy as np
from fault_arm import PERIOD_NS, Source, weight
from galen_ros.messages import STREAM
from galen_ros.node.spin import run
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState

PUSH = np.array([1.0, -2.0, 3.0, 0.1, -0.2, 0.3])


class Driver(Source):
    def __init__(self):
        super().__init__("fault_driver")
        self.next_ns = time.time_ns() // PERIOD_NS * PERIOD_NS
        self.create_timer(PERIOD_NS * 1e-9, self.on_timer)

    def on_timer(self):
        while self.next_ns <= time.time_ns():
            time_s = (self.next_ns % 10**12) * 1e-9
            roll, tilt = 0.5 * np.sin(time_s), 0.4 * np.cos(0.7 * time_s)
            self.joints(self.next_ns, roll, tilt)
            # No noise, so that what must go out is known to the last digit.
            self.wrench(self.next_ns, weight(roll, tilt) + PUSH)
            self.next_ns += PERIOD_NS


class Relay(Node):
    """Of 100 messages 5 are lost, 5 repeated, 10 late by up to 30 ms, so that others overtake.

    With `faulty` false none is.
    """

    def __init__(self, faulty=True):
        super().__init__("relay")
        self.faulty = faulty
        self.rng = np.random.default_rng(11)
        self.late = []
        for kind, topic in ((JointState, "joint_states"), (WrenchStamped, "wrench_raw")):
            out = self.create_publisher(kind, topic, STREAM)
            self.create_subscription(
                kind,
                f"true/{topic}",
                lambda data, out=out: self.pass_on(out, data),
                STREAM,
                raw=True,
            )
        self.create_timer(0.001, self.send_late)

    def pass_on(self, out, data):
        chance = self.rng.random() if self.faulty else 1.0
        if chance < 0.05:
            return
        if chance < 0.15:
            self.late.append((time.monotonic() + self.rng.uniform(0.011, 0.03), data, out))
            return
        for _ in range(2 if chance < 0.20 else 1):
            out.publish(data)

    def send_late(self):
        now_s = time.monotonic()
        due = [one for one in self.late if one[0] <= now_s]
        self.late = [one for one in self.late if one[0] > now_s]
        for _, data, out in due:
            out.publish(data)


class Subscriber(Node):
    def __init__(self):
        super().__init__("slow_subscriber")
        self.create_subscription(WrenchStamped, "wrench_compensated", lambda _: None, STREAM)


if __name__ == "__main__":
    kinds = {
        "driver": Driver,
        "relay": Relay,
        "pass": lambda: Relay(faulty=False),
        "subscriber": Subscriber,
    }
    run(kinds[sys.argv[1]], sys.argv)
