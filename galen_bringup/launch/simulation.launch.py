"""Simulated arm, calibration and compensation; deflection if a model is given, panel if asked for.

ros2 launch galen_bringup simulation.launch.py speed_factor:=5 tool:=pointer panel:=true
ros2 launch galen_bringup simulation.launch.py urdf:=arm.urdf sensor_frame:=tool0
"""

from galen_bringup.launch_arguments import COMMON, arm_parameters, declare, enclave
from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
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
            *declare(
                {
                    "config": (
                        PathJoinSubstitution([share, "config", "simulation.yaml"]),
                        "parameters of all nodes",
                    ),
                    **COMMON,
                    "speed_factor": ("1.0", "simulated over wall time"),
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
                    **{name: LaunchConfiguration(name) for name in COMMON},
                }.items(),
            ),
        ]
    )
