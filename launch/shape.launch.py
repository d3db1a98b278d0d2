"""
The shape of a Hall + IMU arm, from its drivers, from a bag, or simulated.

ros2 launch continuum_loc shape.launch.py simulate:=true
ros2 launch continuum_loc shape.launch.py bag:=arm1 use_sim_time:=true
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import (
    EqualsSubstitution,
    LaunchConfiguration,
    NotSubstitution,
    PathJoinSubstitution,
)
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue
from launch_ros.substitutions import FindPackageShare

SHARE = FindPackageShare('continuum_loc')
ARGUMENTS = (
    ('robot', 'hall_arm', 'robot description: a bundled name or a YAML file'),
    ('bag', '', 'bag to play; empty waits for live sensors'),
    ('simulate', 'false', 'simulate the arm'),
    ('trajectory', 'free1', 'named motion of the simulated arm'),
    ('rviz', 'false', 'start RViz'),
    ('viewer', 'false', 'serve a page to watch in a browser, at http://127.0.0.1:8765/'),
    (
        'params_file',
        PathJoinSubstitution([SHARE, 'config', 'shape.yaml']),
        'parameters of node `shape` (YAML)',
    ),
    ('use_sim_time', 'false', 'take the time from /clock; set it to true with a bag'),
    ('namespace', '', 'namespace of all nodes and topics, for several robots at once'),
)


def generate_launch_description():
    """Node `shape`, with a bag or a simulated arm where asked for."""
    arg = LaunchConfiguration
    text = {
        name: ParameterValue(arg(name), value_type=str) for name in ('robot', 'bag', 'trajectory')
    }
    common = {'package': 'continuum_loc', 'namespace': arg('namespace'), 'output': 'screen'}
    shape = Node(
        executable='shape',
        name='shape',
        parameters=[
            ParameterFile(arg('params_file')),
            {
                'robot': text['robot'],
                'use_sim_time': ParameterValue(arg('use_sim_time'), value_type=bool),
            },
        ],
        **common,
    )
    with_bag = IfCondition(NotSubstitution(EqualsSubstitution(arg('bag'), '')))
    replayer = Node(
        executable='replayer',
        name='replayer',
        condition=with_bag,
        parameters=[{'bag': text['bag'], 'wait_for': 1}],
        **common,
    )
    simulator = Node(
        executable='simulator',
        name='simulator',
        condition=IfCondition(arg('simulate')),
        parameters=[
            {
                'robot': text['robot'],
                'scene': 'none',
                'trajectory': text['trajectory'],
                'wait_for': 1,
            }
        ],
        **common,
    )
    viewer = Node(
        executable='viewer', name='viewer', condition=IfCondition(arg('viewer')), **common
    )
    rviz = Node(
        package='rviz2',
        executable='rviz2',
        namespace=arg('namespace'),
        condition=IfCondition(arg('rviz')),
        arguments=['-d', PathJoinSubstitution([SHARE, 'rviz', 'continuum_loc.rviz'])],
    )
    declared = [
        DeclareLaunchArgument(name, default_value=value, description=text)
        for name, value, text in ARGUMENTS
    ]
    return LaunchDescription([*declared, shape, replayer, simulator, viewer, rviz])
