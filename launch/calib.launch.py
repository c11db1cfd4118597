"""The node alone: ros2 launch calib_ros calib.launch.py image:=/camera/image_raw points:=/lidar/points"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

TOPICS = ("image", "camera_info", "points", "odom", "imu", "twist")
CONFIG = PathJoinSubstitution([FindPackageShare("calib_ros"), "config"])


def node(context: LaunchContext) -> list[Node]:
    """The state file is a parameter only if the argument is given: an empty one would override that of the parameter file. A
    preset holds where no parameter file does, and the usual one names all parameters."""
    state_file, preset = (LaunchConfiguration(name).perform(context) for name in ("state_file", "preset"))
    params_file = LaunchConfiguration("params_file").perform(context)
    usual = PathJoinSubstitution([CONFIG, "calib_ros.yaml"]).perform(context)
    managed, respawn = (LaunchConfiguration(name).perform(context) == "true" for name in ("managed", "respawn"))
    nice = LaunchConfiguration("nice").perform(context)
    return [
        Node(
            package="calib_ros",
            executable="calib_lifecycle_node" if managed else "calib_node",
            name="calib_ros",
            namespace=LaunchConfiguration("namespace"),
            parameters=[
                *([] if preset and params_file == usual else [params_file]),
                {"use_sim_time": ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)},
                *([{"state_file": state_file}] if state_file else []),
                *([{"preset": preset}] if preset else []),
            ],
            remappings=[(topic, LaunchConfiguration(topic)) for topic in TOPICS],
            ros_arguments=["--log-level", LaunchConfiguration("log_level")],
            respawn=respawn,
            respawn_delay=float(LaunchConfiguration("respawn_delay").perform(context)),
            output="screen",
            **({"prefix": f"nice -n {nice}"} if nice else {}),  # else launch's own argument launch-prefix holds
        )
    ]


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "params_file",
                default_value=PathJoinSubstitution([CONFIG, "calib_ros.yaml"]),
                description="YAML file with the node's parameters",
            ),
            DeclareLaunchArgument("preset", default_value="", description="thesis = the thesis's own system; empty = none"),
            DeclareLaunchArgument("namespace", default_value="", description="namespace of the node"),
            DeclareLaunchArgument(
                "state_file", default_value="", description="keeps the last good extrinsic; empty = params_file's"
            ),
            DeclareLaunchArgument(
                "managed",
                default_value="false",
                choices=["false", "true"],
                description="true: calib_lifecycle_node, which does nothing until it is configured and activated",
            ),
            DeclareLaunchArgument("use_sim_time", default_value="false", description="follow /clock"),
            DeclareLaunchArgument(
                "respawn", default_value="false", choices=["false", "true"], description="start the node again whenever it ends"
            ),
            DeclareLaunchArgument("respawn_delay", default_value="2.0", description="before that, s"),
            DeclareLaunchArgument("log_level", default_value="info", description="debug, info, warn, error or fatal"),
            DeclareLaunchArgument("nice", default_value="", description="niceness of the node, 1 to 19; empty = as launch"),
            *(DeclareLaunchArgument(topic, default_value=topic, description=f"topic to take as {topic}") for topic in TOPICS),
            OpaqueFunction(function=node),
        ]
    )
