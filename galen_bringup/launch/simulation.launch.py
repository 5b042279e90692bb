"""Simulated arm, calibration and compensation; deflection if a model is given, panel if asked for.

ros2 launch galen_bringup simulation.launch.py speed_factor:=5 tool:=pointer panel:=true
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.substitutions import (
    LaunchConfiguration,
    NotEqualsSubstitution,
    PathJoinSubstitution,
    PythonExpression,
)
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

_HANDED_ON = (
    *("namespace", "enclaves", "tool", "tools_dir", "deflection_model"),
    *("panel", "panel_host", "panel_port", "bags_dir"),
)


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments; start the driver, then what runs on a real arm, too."""
    share = FindPackageShare("galen_bringup")
    speed = LaunchConfiguration("speed_factor")
    # Only at real time does the driver stamp with system time and leave /clock to others.
    sim_time = NotEqualsSubstitution(PythonExpression(["str(float(", speed, "))"]), "1.0")
    config = LaunchConfiguration("config")
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "config",
                default_value=PathJoinSubstitution([share, "config", "simulation.yaml"]),
                description="parameters of all nodes",
            ),
            DeclareLaunchArgument("namespace", default_value="", description="of all nodes"),
            DeclareLaunchArgument(
                "enclaves",
                default_value="/galen",
                description="where SROS 2 has the nodes' enclaves",
            ),
            DeclareLaunchArgument(
                "speed_factor", default_value="1.0", description="simulated over wall time"
            ),
            DeclareLaunchArgument(
                "tool",
                default_value="",
                description="tool on the simulated arm, whose file gravcomp loads; empty: none",
            ),
            DeclareLaunchArgument(
                "deflection_model",
                default_value="",
                description="model's file for the deflection; empty: its node is not started",
            ),
            DeclareLaunchArgument(
                "tools_dir", default_value="~/.ros/galen/tools", description="the calibration files"
            ),
            DeclareLaunchArgument(
                "panel", default_value="false", description="start the operator's panel, too"
            ),
            DeclareLaunchArgument(
                "panel_host",
                default_value="127.0.0.1",
                description="where the panel listens; not this machine alone: it prints a token",
            ),
            DeclareLaunchArgument(
                "panel_port", default_value="8080", description="the panel's port"
            ),
            DeclareLaunchArgument(
                "bags_dir", default_value=".", description="where the panel looks for recordings"
            ),
            Node(
                package="galen_sim_driver",
                executable="sim_driver_node",
                name="sim_driver",
                ros_arguments=["--enclave", [LaunchConfiguration("enclaves"), "/sim_driver"]],
                namespace=LaunchConfiguration("namespace"),
                parameters=[
                    config,
                    {
                        "speed_factor": ParameterValue(speed, value_type=float),
                        "initial_tool": ParameterValue(LaunchConfiguration("tool"), value_type=str),
                    },
                ],
                output="screen",
            ),
            IncludeLaunchDescription(
                PathJoinSubstitution([share, "launch", "robot.launch.py"]),
                launch_arguments={
                    "config": config,
                    "use_sim_time": sim_time,
                    **{name: LaunchConfiguration(name) for name in _HANDED_ON},
                }.items(),
            ),
        ]
    )
