"""fgloc as a lifecycle node, configured and activated; include it, with a namespace for each robot."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, RegisterEventHandler
from launch.conditions import IfCondition
from launch.events import matches_action
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState
from launch_ros.parameter_descriptions import ParameterValue
from lifecycle_msgs.msg import Transition

PARAMETERS = str(Path(get_package_share_directory("fgloc_ros")) / "config" / "defaults.yaml")
ARGUMENTS = {
    "namespace": ("", "of the robot"),
    "params_file": (PARAMETERS, "further parameters, as in config/fgloc.yaml"),
    "config": ("", "robot.yaml of fgloc"),
    "map": ("", "map.yaml with the landmarks"),
    "state": ("", "file that the state is kept in"),
    "use_sim_time": ("false", "time of /clock"),
    "autostart": ("true", "configure and activate; false for a lifecycle manager, such as Nav2's"),
    "respawn": ("true", "start again if the process ends"),
}


def generate_launch_description() -> LaunchDescription:
    """Arguments, the node, and its transitions."""
    given = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    node = LifecycleNode(
        package="fgloc_ros",
        executable="fgloc",
        name="fgloc",
        namespace=given["namespace"],
        parameters=[
            given["params_file"],
            {
                **{name: ParameterValue(given[name], value_type=str) for name in ("config", "map", "state")},
                "use_sim_time": ParameterValue(given["use_sim_time"], value_type=bool),
            },
        ],
        remappings=[("/tf", "tf"), ("/tf_static", "tf_static")],
        respawn=given["respawn"],
        respawn_delay=2.0,
        output="screen",
    )
    autostart = IfCondition(given["autostart"])
    configure = EmitEvent(
        event=ChangeState(lifecycle_node_matcher=matches_action(node), transition_id=Transition.TRANSITION_CONFIGURE),
        condition=autostart,
    )
    activate = EmitEvent(
        event=ChangeState(lifecycle_node_matcher=matches_action(node), transition_id=Transition.TRANSITION_ACTIVATE)
    )
    configured = RegisterEventHandler(
        OnStateTransition(
            target_lifecycle_node=node, start_state="configuring", goal_state="inactive", entities=[activate]
        ),
        condition=autostart,
    )
    declared = [DeclareLaunchArgument(n, default_value=v, description=d) for n, (v, d) in ARGUMENTS.items()]
    return LaunchDescription([*declared, configured, node, configure])
