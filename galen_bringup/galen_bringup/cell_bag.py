"""Writes a plant's samples into a bag, as a recorder beside `sim_driver_node` would."""

from __future__ import annotations

from collections.abc import Sequence

from galen_bags.formats.writer import BagWriter
from galen_model.arm.galen import JOINT_NAMES, SENSOR_FRAME, TRACKER_FRAME
from galen_ros.cdr.layout import JointStateBytes, PoseBytes, WrenchBytes
from galen_sim_driver.plant.cell import Sample

# A message is logged this long after its stamp, and each further one of a step so much later:
# made up, of the size that a recorder on the same machine has, so that log times differ from stamps
# and tell the order in which the driver publishes.
DELAY_NS = 200_000
NEXT_MESSAGE_NS = 50_000
# Poses of the tracker are rounded to 1e-7 (m; 1 in a quaternion), three hundred times finer than
# its noise: they alone come unrounded from LAPACK, whose last bits differ between processors.
_POSE_DIGITS = 7


class CellBag:
    """The driver's topics in an open bag; call it with each sample."""

    def __init__(self, bag: BagWriter, *, tracker: bool = False) -> None:
        """`tracker`: with both tracker topics."""
        self._bag = bag
        self._joint_states = bag.add_topic("joint_states", "sensor_msgs/msg/JointState")
        self._wrench_raw = bag.add_topic("wrench_raw", "geometry_msgs/msg/WrenchStamped")
        self._joint_bytes = JointStateBytes(JOINT_NAMES)
        self._wrench_bytes = WrenchBytes(SENSOR_FRAME)
        self._tracker = tracker
        if tracker:
            pose = "geometry_msgs/msg/PoseStamped"
            self._tool_pose = bag.add_topic("tracker/tool_pose", pose)
            self._base_pose = bag.add_topic("tracker/base_pose", pose)
            self._pose_bytes = PoseBytes(TRACKER_FRAME)

    def __call__(self, sample: Sample) -> None:
        """Write what the driver publishes of this sample, in its order."""
        stamp_ns = sample.stamp_ns
        messages = [
            (
                self._joint_states,
                self._joint_bytes.fill(stamp_ns, sample.positions, sample.velocities),
            ),
            (self._wrench_raw, self._wrench_bytes.fill(stamp_ns, sample.wrench)),
        ]
        if self._tracker and sample.tracker is not None:
            for topic, seen in (
                (self._tool_pose, sample.tracker.tool),
                (self._base_pose, sample.tracker.base),
            ):
                if seen is not None:  # there is no tool marker without a tool
                    data = self._pose_bytes.fill(
                        stamp_ns, _rounded(seen.position_m), _rounded(seen.quaternion)
                    )
                    messages.append((topic, data))
        for number, (topic, data) in enumerate(messages):
            self._bag.write(topic, stamp_ns + DELAY_NS + number * NEXT_MESSAGE_NS, data)


def _rounded(values: Sequence[float]) -> list[float]:
    return [round(value, _POSE_DIGITS) for value in values]
