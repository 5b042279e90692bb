"""Simulated arm, calibration and compensation, and the deflection if a model is given.

ros2 launch galen_bringup simulation.launch.py speed_factor:=5 tool:=pointer
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
                "tool", default_value="", description="tool whose file gravcomp loads at start"
            ),
            DeclareLaunchArgument(
                "deflection_model",
                default_value="",
                description="model's file for the deflection; empty: its node is not started",
            ),
            DeclareLaunchArgument(
                "tools_dir", default_value="~/.ros/galen/tools", description="the tools' files"
            ),
            Node(
                package="galen_sim_driver",
                executable="sim_driver_node",
                name="sim_driver",
                ros_arguments=["--enclave", [LaunchConfiguration("enclaves"), "/sim_driver"]],
                namespace=LaunchConfiguration("namespace"),
                parameters=[config, {"speed_factor": ParameterValue(speed, value_type=float)}],
                # A busy machine must slow the simulation down, not the nodes that it feeds.
                prefix="nice -n 10",
                output="screen",
            ),
            IncludeLaunchDescription(
                PathJoinSubstitution([share, "launch", "robot.launch.py"]),
                launch_arguments={
                    "config": config,
                    "namespace": LaunchConfiguration("namespace"),
                    "enclaves": LaunchConfiguration("enclaves"),
                    "tool": LaunchConfiguration("tool"),
                    "tools_dir": LaunchConfiguration("tools_dir"),
                    "deflection_model": LaunchConfiguration("deflection_model"),
                    "use_sim_time": sim_time,
                }.items(),
            ),
        ]
    )
