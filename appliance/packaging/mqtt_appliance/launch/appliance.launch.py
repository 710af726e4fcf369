"""The appliance as a node: `ros2 launch mqtt_appliance appliance.launch.py robot:=r2d2`."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import EnvironmentVariable, LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "config",
                default_value="/etc/appliance/appliance.yaml",
                description="The appliance's configuration, which `appliance init` writes",
            ),
            DeclareLaunchArgument(
                "robot",
                default_value="",
                description="First level of the robot's MQTT topics; empty: what the file says",
            ),
            DeclareLaunchArgument(
                "domain",
                default_value=EnvironmentVariable("ROS_DOMAIN_ID", default_value="0"),
                description="ROS domain; bridge.domain_id of the file goes before it",
            ),
            # It has no name here, so that bridge.node and bridge.namespace of the file hold.
            Node(
                package="mqtt_appliance",
                executable="appliance",
                output="screen",
                arguments=["--config", LaunchConfiguration("config")],
                additional_env={
                    "APPLIANCE_ROBOT": LaunchConfiguration("robot"),
                    "ROS_DOMAIN_ID": LaunchConfiguration("domain"),
                },
            ),
        ]
    )
