# SPDX-License-Identifier: Apache-2.0
"""Simulated arm, calibration and compensation; deflection if a model is given, panel if asked for.

ros2 launch galen_bringup simulation.launch.py speed_factor:=5 tool:=pointer panel:=true
ros2 launch galen_bringup simulation.launch.py urdf:=arm.urdf sensor_frame:=tool0

`rviz:=true` shows model and compensated wrench, where robot_state_publisher and RViz are installed.
"""

from typing import Any, List  # noqa: UP035

from ament_index_python.packages import get_packages_with_prefixes
from galen_bringup.launch_arguments import COMMON, arm_parameters, declare, enclave
from galen_common.arm import ArmParameters
from launch import LaunchContext, LaunchDescription
from launch.actions import IncludeLaunchDescription, LogInfo, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import (
    LaunchConfiguration,
    NotEqualsSubstitution,
    PathJoinSubstitution,
    PythonExpression,
)
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

_SHARE = FindPackageShare("galen_bringup")
_SPEED = LaunchConfiguration("speed_factor")
# Only at real time does the driver stamp with system time and leave /clock to others.
_SIM_TIME = NotEqualsSubstitution(PythonExpression(["str(float(", _SPEED, "))"]), "1.0")
_SHOWN_BY = ("robot_state_publisher", "rviz2")


def _show(context: LaunchContext) -> list[Any]:
    """Start robot_state_publisher and RViz, or say what to install."""
    if not get_packages_with_prefixes().keys() >= set(_SHOWN_BY):
        names = " ".join(f"ros-jazzy-{name.replace('_', '-')}" for name in _SHOWN_BY)
        return [LogInfo(msg=f"rviz:=true shows nothing: sudo apt install {names}, and source anew")]
    names = ("urdf", "base_frame", "sensor_frame")
    urdf, base, sensor = (LaunchConfiguration(name).perform(context) for name in names)
    arm = ArmParameters(urdf_file=urdf, base_frame=base, sensor_frame=sensor).arm()
    namespace = LaunchConfiguration("namespace")
    sim_time = {"use_sim_time": ParameterValue(_SIM_TIME, value_type=bool)}
    topics = ("robot_description", "wrench_compensated")
    return [
        Node(
            package="robot_state_publisher",
            executable="robot_state_publisher",
            namespace=namespace,
            parameters=[
                sim_time,
                {"robot_description": ParameterValue(arm.urdf, value_type=str)},
            ],
            # The driver publishes the description, with the tool's tip.
            remappings=[("robot_description", "robot_description_of_tf")],
        ),
        Node(
            package="rviz2",
            executable="rviz2",
            namespace=namespace,
            arguments=["-d", PathJoinSubstitution([_SHARE, "config", "arm.rviz"])]
            + ["-f", arm.base_frame],
            parameters=[sim_time],
            remappings=[(f"/{topic}", topic) for topic in topics],
        ),
    ]


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments; start the driver, then what runs on a real arm, too."""
    config = LaunchConfiguration("config")
    return LaunchDescription(
        [
            *declare(
                {
                    "config": (
                        PathJoinSubstitution([_SHARE, "config", "simulation.yaml"]),
                        "parameters of all nodes",
                    ),
                    **COMMON,
                    "speed_factor": ("1.0", "simulated over wall time"),
                    "start_joints": ("[]", "m and rad, as in [0.0, 1.5]; empty: home"),
                    "rviz": ("false", "show the arm in RViz, too"),
                }
            ),
            Node(
                package="galen_sim_driver",
                executable="sim_driver_node",
                name="sim_driver",
                ros_arguments=enclave("sim_driver"),
                namespace=LaunchConfiguration("namespace"),
                parameters=[
                    config,
                    {
                        **arm_parameters(),
                        "speed_factor": ParameterValue(_SPEED, value_type=float),
                        "start_joints": ParameterValue(
                            LaunchConfiguration("start_joints"),
                            value_type=List[float],  # noqa: UP006 - launch knows no `list[float]`
                        ),
                        "initial_tool": ParameterValue(LaunchConfiguration("tool"), value_type=str),
                    },
                ],
                output="screen",
            ),
            OpaqueFunction(function=_show, condition=IfCondition(LaunchConfiguration("rviz"))),
            IncludeLaunchDescription(
                PathJoinSubstitution([_SHARE, "launch", "robot.launch.py"]),
                launch_arguments={
                    "config": config,
                    "use_sim_time": _SIM_TIME,
                    **{name: LaunchConfiguration(name) for name in COMMON},
                }.items(),
            ),
        ]
    )
