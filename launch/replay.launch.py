"""The node fed from a bag: ros2 launch calib_ros replay.launch.py bag:=DRIVE

Takes the arguments of calib.launch.py as well.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import ExecutableInPackage, FindPackageShare


def generate_launch_description() -> LaunchDescription:
    calib = PathJoinSubstitution([FindPackageShare("calib_ros"), "launch", "calib.launch.py"])
    return LaunchDescription(
        [
            DeclareLaunchArgument("bag", description="ROS 2 bag to play"),
            DeclareLaunchArgument("rate", default_value="1.0", description="speed of the playback"),
            IncludeLaunchDescription(PythonLaunchDescriptionSource(calib), launch_arguments={"use_sim_time": "true"}.items()),
            # Not a Node: launch would append --ros-args, which this command line does not know.
            ExecuteProcess(
                cmd=[
                    ExecutableInPackage(package="calib_ros", executable="calib-ros"),
                    "play",
                    LaunchConfiguration("bag"),
                    "--rate",
                    LaunchConfiguration("rate"),
                    "--clock",
                ],
                name="player",
                output="screen",
            ),
        ]
    )
