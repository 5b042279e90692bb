# SPDX-License-Identifier: Apache-2.0
"""Calibration and compensation on an arm that is already up; deflection and panel if asked for.

    ros2 launch galen_bringup robot.launch.py tool:=pointer wrench_raw:=/ft_sensor/wrench
    ros2 launch galen_bringup robot.launch.py tool:=pointer deflection_model:=pointer_model.json
    ros2 launch galen_bringup robot.launch.py panel:=true
    ros2 launch galen_bringup robot.launch.py use_robot_description:=true sensor_frame:=tool0

`crtk:=true` takes the names of JHU's Collaborative Robotics Toolkit as input instead: the measured
wrench `measured_cf` and the joints `measured_js`, under `crtk_namespace`.
"""

from galen_bringup.launch_arguments import COMMON, arm_parameters, declare, enclave
from launch import LaunchDescription
from launch.conditions import IfCondition
from launch.substitutions import (
    IfElseSubstitution,
    LaunchConfiguration,
    NotEqualsSubstitution,
    PathJoinSubstitution,
)
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

_TOPICS = (
    "wrench_raw",
    "joint_states",
    "imu",
    "temperature",
    "wrench_compensated",
    "joint_trajectory",
    "robot_description",
)
_SERVICES = ("zero_ft_sensor", "attach_tool")
_ACTION = "follow_joint_trajectory"
# A remap of an action's name alone does not reach what it is made of.
_ACTION_PARTS = (
    "/_action/send_goal",
    "/_action/cancel_goal",
    "/_action/get_result",
    "/_action/feedback",
    "/_action/status",
)
_CRTK = {"wrench_raw": "measured_cf", "joint_states": "measured_js"}


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments; start the nodes with the topics' remaps."""
    share = FindPackageShare("galen_bringup")
    crtk = LaunchConfiguration("crtk")
    remaps = []
    for topic in _TOPICS:
        name = LaunchConfiguration(topic)
        if topic in _CRTK:
            crtk_name = [LaunchConfiguration("crtk_namespace"), "/", _CRTK[topic]]
            name = IfElseSubstitution(crtk, if_value=crtk_name, else_value=name)
        remaps.append((topic, name))
    remaps += [(service, LaunchConfiguration(service)) for service in _SERVICES]
    action = LaunchConfiguration(_ACTION)
    remaps += [(f"{_ACTION}{part}", [action, part]) for part in _ACTION_PARTS]
    common = {
        "namespace": LaunchConfiguration("namespace"),
        "remappings": remaps,
        "output": "screen",
    }
    config = LaunchConfiguration("config")
    model = LaunchConfiguration("deflection_model")
    arm = {
        **arm_parameters(),
        "use_robot_description": ParameterValue(
            LaunchConfiguration("use_robot_description"), value_type=bool
        ),
    }
    overrides = {
        **arm,
        "use_sim_time": ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool),
        "tools_dir": ParameterValue(LaunchConfiguration("tools_dir"), value_type=str),
    }
    return LaunchDescription(
        [
            *declare(
                {
                    "config": (
                        PathJoinSubstitution([share, "config", "robot.yaml"]),
                        "parameters of all nodes",
                    ),
                    **COMMON,
                    "use_sim_time": ("false", "follow /clock"),
                    "use_robot_description": ("false", "the arm is that of robot_description"),
                    "crtk": ("false", "inputs by their CRTK names"),
                    "crtk_namespace": ("/REMS/Research", "where they are"),
                    "require_collision_shapes": (
                        "true",
                        "calibrate only an arm whose description has collision shapes",
                    ),
                    **{
                        name: (name, f"{name} on this arm")
                        for name in (*_TOPICS, *_SERVICES, _ACTION)
                    },
                }
            ),
            Node(
                package="galen_gravcomp",
                executable="gravcomp_node",
                name="gravcomp",
                ros_arguments=enclave("gravcomp"),
                parameters=[
                    config,
                    overrides,
                    {"tool": ParameterValue(LaunchConfiguration("tool"), value_type=str)},
                ],
                **common,
            ),
            Node(
                package="galen_calibration_behavior",
                executable="calibration_node",
                name="calibration",
                ros_arguments=enclave("calibration"),
                parameters=[
                    config,
                    overrides,
                    {
                        "require_collision_shapes": ParameterValue(
                            LaunchConfiguration("require_collision_shapes"), value_type=bool
                        )
                    },
                ],
                **common,
            ),
            Node(
                package="galen_deflection",
                executable="deflection_node",
                name="deflection",
                ros_arguments=enclave("deflection"),
                condition=IfCondition(NotEqualsSubstitution(model, "")),
                parameters=[
                    config,
                    {**arm, "use_sim_time": overrides["use_sim_time"]},
                    {"model_file": ParameterValue(model, value_type=str)},
                ],
                **common,
            ),
            Node(
                package="galen_panel",
                executable="panel",
                # No name: it would be that of both nodes in the panel's process.
                ros_arguments=enclave("panel"),
                arguments=[
                    *("--host", LaunchConfiguration("panel_host")),
                    *("--port", LaunchConfiguration("panel_port")),
                    *("--tools-dir", LaunchConfiguration("tools_dir")),
                    *("--bags-dir", LaunchConfiguration("bags_dir")),
                ],
                parameters=[arm],
                condition=IfCondition(LaunchConfiguration("panel")),
                # Plots may wait, wrenches may not; but a cancel must get through on a busy machine.
                prefix="nice -n 5",
                exec_name="panel",  # else the log calls it nice
                **common,
            ),
        ]
    )
