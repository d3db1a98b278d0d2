"""
Localise a robot from its own drivers, or from a bag with its own clock.

ros2 launch continuum_loc estimator.launch.py robot:=my_robot.yaml map:=engine.ply
ros2 launch continuum_loc estimator.launch.py map:=S0.npz bag:=run1 use_sim_time:=true
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

COMMON = PathJoinSubstitution([FindPackageShare('continuum_loc'), 'launch', 'common.launch.py'])
ARGUMENTS = (('bag', '', 'bag to play; empty waits for live sensors'),)


def generate_launch_description():
    """Estimator, replayer (with `bag`); more by the arguments of common.launch.py."""
    declared = [
        DeclareLaunchArgument(name, default_value=value, description=text)
        for name, value, text in ARGUMENTS
    ]
    common = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(COMMON),
        launch_arguments=[
            ('play', LaunchConfiguration('bag')),
        ],
    )
    return LaunchDescription([*declared, common])
