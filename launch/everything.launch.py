"""
Everything at once: live simulation, estimator, recorder, RViz and a page for a browser.

ros2 launch continuum_loc everything.launch.py map:=S0.npz
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

COMMON = PathJoinSubstitution([FindPackageShare('continuum_loc'), 'launch', 'common.launch.py'])
ARGUMENTS = (
    ('bag', 'everything', 'folder of the bag to record; empty records none'),
    ('rviz', 'true', 'start RViz'),
    ('viewer', 'true', 'serve a page to watch in a browser, at http://127.0.0.1:8765/'),
)


def generate_launch_description():
    """`live.launch.py` with recorder, RViz and viewer switched on."""
    declared = [
        DeclareLaunchArgument(name, default_value=value, description=text)
        for name, value, text in ARGUMENTS
    ]
    common = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(COMMON),
        launch_arguments=[
            ('simulate', 'true'),
            ('record', LaunchConfiguration('bag')),
            ('rviz', LaunchConfiguration('rviz')),
            ('viewer', LaunchConfiguration('viewer')),
        ],
    )
    return LaunchDescription([*declared, common])
