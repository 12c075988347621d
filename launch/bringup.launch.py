"""Start the nodes for a bag that is replayed, or for a live robot, and RViz if it is wanted.

ros2 launch bnirl_ros bringup.launch.py bag:=/path/to/bag rate:=10.0 rviz:=true
ros2 launch bnirl_ros bringup.launch.py config:=nav2_robot
ros2 launch bnirl_ros bringup.launch.py config:=nav2_robot bag:=/path/to/bag map:=/path/to/map.yaml
ros2 launch bnirl_ros bringup.launch.py --show-args
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import (
    AndSubstitution,
    IfElseSubstitution,
    LaunchConfiguration,
    NotEqualsSubstitution,
    NotSubstitution,
    PathJoinSubstitution,
)
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

PACKAGE = "bnirl_ros"

# Names that are absolute, in a bag and in tf, are taken into the namespace, as Nav2 does it.
TRANSFORMS = [("/tf", "tf"), ("/tf_static", "tf_static")]
DEMONSTRATION = [("/pose", "pose"), ("/action", "action"), ("/map", "map")]


def generate_launch_description() -> LaunchDescription:
    """Describe the arguments, and the nodes that are started for them."""
    share = FindPackageShare(PACKAGE)
    config = LaunchConfiguration("config")
    bag = LaunchConfiguration("bag")
    map_file = LaunchConfiguration("map")
    discretise = LaunchConfiguration("discretise")
    namespace = LaunchConfiguration("namespace")
    use_sim_time = LaunchConfiguration("use_sim_time")
    managed = {
        "package": PACKAGE,
        "namespace": namespace,
        "output": "screen",
        "parameters": [
            LaunchConfiguration("params_file"),
            {"autostart": LaunchConfiguration("autostart"), "use_sim_time": use_sim_time},
        ],
    }
    with_bag = NotEqualsSubstitution(bag, "")
    with_map = NotEqualsSubstitution(map_file, "")

    def replay_node(options: list, condition: AndSubstitution) -> Node:
        return Node(
            package=PACKAGE,
            executable="replay_node",
            namespace=namespace,
            output="screen",
            arguments=[bag, "--rate", LaunchConfiguration("rate"), *options],
            remappings=[*DEMONSTRATION, *TRANSFORMS],
            condition=IfCondition(condition),
        )

    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "config",
                default_value="replay_demo",
                choices=["replay_demo", "nav2_robot", "turtlesim"],
                description="Which file of the package's folder config has the parameters.",
            ),
            DeclareLaunchArgument(
                "params_file",
                default_value=[share, "/config/", config, ".yaml"],
                description="File with the nodes' parameters; that of config unless given.",
            ),
            DeclareLaunchArgument(
                "discretise",
                default_value=NotEqualsSubstitution(config, "replay_demo"),
                description="Whether discretiser_node makes poses and actions of what the robot "
                "publishes; false where they are published already, as by the package's bags.",
            ),
            DeclareLaunchArgument(
                "bag",
                default_value="",
                description="Bag to replay, a folder or an .mcap file; empty: a live robot.",
            ),
            DeclareLaunchArgument(
                "rate", default_value="1.0", description="Factor on the bag's pace, above 0."
            ),
            DeclareLaunchArgument(
                "map",
                default_value="",
                description="Map file to publish for a bag that has no map; empty: none.",
            ),
            DeclareLaunchArgument(
                "rviz",
                default_value="false",
                description="Whether to show it in RViz, if that is installed.",
            ),
            DeclareLaunchArgument(
                "namespace",
                default_value="",
                description="Namespace of the nodes, and of the topics with relative names.",
            ),
            DeclareLaunchArgument(
                "autostart",
                default_value="true",
                description="Whether the nodes configure and activate themselves; false where a "
                "lifecycle manager does.",
            ),
            DeclareLaunchArgument(
                "use_sim_time",
                default_value="false",
                description="Whether time is that of /clock, as with a simulated robot.",
            ),
            Node(
                **managed,
                executable="discretiser_node",
                remappings=TRANSFORMS,
                condition=IfCondition(discretise),
            ),
            Node(
                **managed,
                executable="subgoal_node",
                remappings=[("map", IfElseSubstitution(discretise, "planning_map", "map"))],
            ),
            replay_node([], AndSubstitution(with_bag, NotSubstitution(with_map))),
            replay_node(["--map", map_file], AndSubstitution(with_bag, with_map)),
            Node(
                package="rviz2",
                executable="rviz2",
                namespace=namespace,
                arguments=["-d", PathJoinSubstitution([share, "rviz", "subgoals.rviz"])],
                parameters=[{"use_sim_time": use_sim_time}],
                remappings=TRANSFORMS,
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
        ]
    )
