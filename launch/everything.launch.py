"""
Everything at once: live simulation, estimator, recorder, RViz and a page for a browser.

ros2 launch continuum_loc everything.launch.py map:=S0.npz
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

SHARE = FindPackageShare('continuum_loc')
ARGUMENTS = (
    ('robot', 'engine', 'robot description: a bundled name or a YAML file'),
    ('scene', 'S0', 'scene to simulate: S0-S9, R0-R4, or a mesh file'),
    ('trajectory', 't1', 'named motion of the robot'),
    ('map', '', 'prior map for the estimator: npz, PLY, PCD, XYZ, CSV or a mesh'),
    ('bag', 'everything', 'folder of the bag to record; empty records none'),
    ('rviz', 'true', 'start RViz'),
    ('viewer', 'true', 'serve a page to watch in a browser, at http://127.0.0.1:8765/'),
    (
        'params_file',
        PathJoinSubstitution([SHARE, 'config', 'estimator.yaml']),
        'parameters of the estimator (YAML)',
    ),
    ('use_sim_time', 'false', 'take the time from /clock; a live simulation keeps the wall clock'),
)


def generate_launch_description():
    """`live.launch.py` with recorder, RViz and viewer switched on."""
    declared = [
        DeclareLaunchArgument(name, default_value=value, description=text)
        for name, value, text in ARGUMENTS
    ]
    live = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(PathJoinSubstitution([SHARE, 'launch', 'live.launch.py'])),
        launch_arguments={name: LaunchConfiguration(name) for name, _, _ in ARGUMENTS}.items(),
    )
    return LaunchDescription([*declared, live])
