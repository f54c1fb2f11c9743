"""Localization for Nav2: map_server, robot_localization and fgloc in place of amcl, with config/nav2.yaml."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode, Node, PushRosNamespace, SetRemap


def generate_launch_description() -> LaunchDescription:
    """Arguments and nodes."""
    default = str(Path(get_package_share_directory("fgloc_ros")) / "config" / "nav2.yaml")
    names = {"namespace": "", "params_file": default, "grid": "", "config": "", "map": "", "state": ""}
    given = {name: LaunchConfiguration(name) for name in names}
    parameters = given["params_file"]
    nodes = GroupAction(
        [
            PushRosNamespace(given["namespace"]),
            SetRemap("/tf", "tf"),
            SetRemap("/tf_static", "tf_static"),
            Node(package="robot_localization", executable="ekf_node", name="ekf_filter_node", parameters=[parameters]),
            LifecycleNode(
                package="nav2_map_server",
                executable="map_server",
                name="map_server",
                namespace="",
                parameters=[parameters, {"yaml_filename": given["grid"]}],
            ),
            LifecycleNode(
                package="fgloc_ros",
                executable="fgloc",
                name="fgloc",
                namespace="",
                parameters=[parameters, {name: given[name] for name in ("config", "map", "state")}],
            ),
            Node(
                package="nav2_lifecycle_manager",
                executable="lifecycle_manager",
                name="lifecycle_manager_localization",
                parameters=[parameters],
            ),
        ]
    )
    return LaunchDescription([*(DeclareLaunchArgument(n, default_value=v) for n, v in names.items()), nodes])
