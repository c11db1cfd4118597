r"""Two cameras and one LiDAR, a node for each pair:

    ros2 launch calib_ros two_cameras.launch.py points:=/lidar/points left_image:=/front/image_raw \
        left_camera_info:=/front/camera_info right_image:=/rear/image_raw right_camera_info:=/rear/camera_info

The nodes are /left/calib_ros and /right/calib_ros, and so are the names of their topics and services. Each keeps a state file of
its own in state_dir. params_file, preset, managed, use_sim_time, respawn, respawn_delay, log_level and nice are those of
calib.launch.py, for both nodes.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

CAMERAS = ("left", "right")
CALIB = PathJoinSubstitution([FindPackageShare("calib_ros"), "launch", "calib.launch.py"])


def arguments_of(camera: str) -> list[DeclareLaunchArgument]:
    """Absolute names: a relative one would be looked for in the node's namespace."""
    return [
        DeclareLaunchArgument(
            f"{camera}_{topic}", default_value=f"/{camera}/{name}", description=f"{topic} of the {camera} camera"
        )
        for topic, name in (("image", "image_raw"), ("camera_info", "camera_info"))
    ]


def node_of(camera: str) -> GroupAction:
    """A group keeps one node's arguments from the other."""
    arguments = {
        "namespace": camera,
        "image": LaunchConfiguration(f"{camera}_image"),
        "camera_info": LaunchConfiguration(f"{camera}_camera_info"),
        "points": LaunchConfiguration("points"),
        "state_file": PathJoinSubstitution([LaunchConfiguration("state_dir"), f"{camera}.json"]),
    }
    return GroupAction([IncludeLaunchDescription(PythonLaunchDescriptionSource(CALIB), launch_arguments=arguments.items())])


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            DeclareLaunchArgument("points", default_value="/points", description="cloud of the LiDAR that both cameras share"),
            DeclareLaunchArgument("state_dir", default_value="/var/tmp/calib_ros", description="folder of the two state files"),
            *(argument for camera in CAMERAS for argument in arguments_of(camera)),
            *(node_of(camera) for camera in CAMERAS),
        ]
    )
