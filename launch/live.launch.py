"""
Simulate a robot and localise it live.

ros2 launch continuum_loc live.launch.py map:=S0.npz trajectory:=t2 bag:=run1 rviz:=true
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

COMMON = PathJoinSubstitution([FindPackageShare('continuum_loc'), 'launch', 'common.launch.py'])
ARGUMENTS = (('bag', '', 'folder of a bag to record; empty records none'),)


def generate_launch_description():
    """Launch simulator, estimator and recorder; more by the arguments of common.launch.py."""
    declared = [
        DeclareLaunchArgument(name, default_value=value, description=text)
        for name, value, text in ARGUMENTS
    ]
    common = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(COMMON),
        launch_arguments=[
            ('simulate', 'true'),
            ('record', LaunchConfiguration('bag')),
        ],
    )
    return LaunchDescription([*declared, common])
