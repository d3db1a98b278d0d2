"""
The shape of a Hall + IMU arm, from its drivers, from a bag, or simulated.

ros2 launch continuum_loc shape.launch.py simulate:=true
ros2 launch continuum_loc shape.launch.py bag:=arm1 use_sim_time:=true
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

COMMON = PathJoinSubstitution([FindPackageShare('continuum_loc'), 'launch', 'common.launch.py'])
ARGUMENTS = (
    ('robot', 'hall_arm', 'robot description: a bundled name or a YAML file'),
    ('bag', '', 'bag to play; empty waits for live sensors'),
    ('trajectory', 'free1', 'named motion of the simulated arm'),
)


def generate_launch_description():
    """Node `shape`, with a bag or a simulated arm where asked for."""
    declared = [
        DeclareLaunchArgument(name, default_value=value, description=text)
        for name, value, text in ARGUMENTS
    ]
    common = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(COMMON),
        launch_arguments=[
            ('estimate', 'shape'),
            ('scene', 'none'),
            ('play', LaunchConfiguration('bag')),
            ('robot', LaunchConfiguration('robot')),
            ('trajectory', LaunchConfiguration('trajectory')),
        ],
    )
    return LaunchDescription([*declared, common])
