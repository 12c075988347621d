"""Start subgoal_node and, given a bag, replay_node with it.

ros2 launch bnirl_ros subgoals.launch.py
ros2 launch bnirl_ros subgoals.launch.py bag:=/path/to/bag rate:=10.0
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import (
    LaunchConfiguration,
    NotEqualsSubstitution,
    PathJoinSubstitution,
)
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Describe the two nodes; without a bag there is no replay_node."""
    params_file = PathJoinSubstitution(
        [FindPackageShare("bnirl_ros"), "config", "subgoal_node.yaml"]
    )
    bag = LaunchConfiguration("bag")
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "params_file",
                default_value=params_file,
                description="Parameters of subgoal_node.",
            ),
            DeclareLaunchArgument(
                "bag",
                default_value="",
                description="Bag to replay, a folder or an .mcap file; empty: none.",
            ),
            DeclareLaunchArgument(
                "rate", default_value="1.0", description="Factor on the recorded pace, above 0."
            ),
            Node(
                package="bnirl_ros",
                executable="subgoal_node",
                output="screen",
                parameters=[LaunchConfiguration("params_file")],
            ),
            Node(
                package="bnirl_ros",
                executable="replay_node",
                output="screen",
                arguments=[bag, "--rate", LaunchConfiguration("rate")],
                condition=IfCondition(NotEqualsSubstitution(bag, "")),
            ),
        ]
    )
