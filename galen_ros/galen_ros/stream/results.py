"""What becomes of a wrench, and what is noticed on the way."""

from enum import Enum
from typing import NamedTuple

from galen_model.arrays import Array


class Rejection(Enum):
    """Why a wrench was not used."""

    DISABLED = "disabled"
    NO_TOOL = "no_tool"
    WRONG_FRAME = "wrong_frame"
    SEVERAL_PUBLISHERS = "several_publishers"  # whose of them is it?
    FROZEN = "frozen_wrench"  # the sensor hangs
    UNREADABLE = "unreadable"  # not even a message
    UNSTAMPED = "unstamped"
    DUPLICATE = "duplicate_stamp"
    NONFINITE_WRENCH = "nonfinite_wrench"
    NO_JOINTS = "no_joints"
    STALE_JOINTS = "stale_joints"
    BAD_JOINTS = "bad_joints"  # only unusable joint messages came, e.g. with unknown names
    NONFINITE_JOINTS = "nonfinite_joints"
    JUMPING_JOINTS = "jumping_joints"  # faster than any arm turns
    QUEUE_FULL = "queue_full"
    NO_MOTION = "no_motion"  # inertial forces are asked for and not known at the stamp
    RESTART = "restart"  # was waiting for joints when the driver restarted


class Notice(Enum):
    """What was noticed without a rejection of the wrench."""

    OUT_OF_ORDER_WRENCH = "out_of_order_wrench"
    OUT_OF_ORDER_JOINTS = "out_of_order_joints"
    DUPLICATE_JOINTS = "duplicate_joints"
    NONFINITE_JOINTS = "nonfinite_joint_samples"
    BAD_JOINTS = "bad_joint_messages"
    JOINT_JUMP = "joint_jumps"
    BEYOND_RANGE = "beyond_sensor_range"
    TORQUE_UNIT = "torque_looks_like_N_mm"
    ANGLE_UNIT = "angles_look_like_degrees"
    RESTART = "restarts"


class Compensated(NamedTuple):
    """A compensated wrench (6,), N and N.m in the sensor's frame, at the stamp of its input."""

    stamp_ns: int
    wrench: Array
    tag: object
    number: int  # of the wrench in the order of arrival, from 0
    angles: tuple[float, float]  # roll and tilt at the stamp, rad


class Rejected(NamedTuple):
    """A wrench that was not used, and why; `detail` is a sentence for a person.

    reason: a `Rejection`, or another enumeration's where another node adds reasons of its own.
    """

    stamp_ns: int
    reason: Enum
    detail: str
    number: int  # as above


Result = Compensated | Rejected
