"""Messages of the driver to and from the plant's own types."""

from __future__ import annotations

from galen_ros.conversions import fill_stamp, stamp_to_ns
from geometry_msgs.msg import PoseStamped
from trajectory_msgs.msg import JointTrajectory

from galen_msgs.srv import PushTool
from galen_sim_driver.plant.config import HandPush
from galen_sim_driver.plant.tracker import MarkerPose
from galen_sim_driver.plant.trajectory import Trajectory, TrajectoryPoint


def trajectory_from_message(message: JointTrajectory) -> Trajectory:
    """Return the trajectory that a message asks for, unchecked."""
    return Trajectory(
        list(message.joint_names),
        [
            TrajectoryPoint(
                point.time_from_start.sec + point.time_from_start.nanosec * 1e-9,
                list(point.positions),
                list(point.velocities),
                list(point.accelerations),
            )
            for point in message.points
        ],
        stamp_to_ns(message.header.stamp),
    )


def push_from_request(request: PushTool.Request) -> HandPush:
    """Return the push that a request asks for, unchecked."""
    fx, fy, fz = (float(value) for value in request.force_n)
    tx, ty, tz = (float(value) for value in request.torque_nm)
    return HandPush(
        start_s=0.0,
        # In this order, for rise and fall to be within the sum whatever is rounded.
        duration_s=(request.rise_s + request.fall_s) + request.hold_s,
        force_n=(fx, fy, fz),
        torque_nm=(tx, ty, tz),
        frame="base",
        ramp_s=request.rise_s,
        fall_s=request.fall_s,
    )


def fill_pose(message: PoseStamped, stamp_ns: int, pose: MarkerPose) -> None:
    """Write stamp and pose into `message`."""
    fill_stamp(message.header.stamp, stamp_ns)
    position, orientation = message.pose.position, message.pose.orientation
    position.x, position.y, position.z = pose.position_m
    orientation.x, orientation.y, orientation.z, orientation.w = pose.quaternion
