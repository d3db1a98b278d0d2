"""
Localise a robot from its own drivers, or from a bag with its own clock.

ros2 launch continuum_loc estimator.launch.py robot:=my_robot.yaml map:=engine.ply
ros2 launch continuum_loc estimator.launch.py map:=S0.npz bag:=run1 use_sim_time:=true
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, RegisterEventHandler
from launch.conditions import IfCondition
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
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
    ('robot', 'engine', 'robot description: a bundled name or a YAML file'),
    ('map', '', 'prior map: npz, PLY, PCD, XYZ, CSV or a mesh'),
    ('bag', '', 'bag to play; empty waits for live sensors'),
    ('rate', '1.0', 'speed of the bag relative to the recording'),
    ('rviz', 'false', 'start RViz'),
    ('viewer', 'false', 'serve a page to watch in a browser, at http://127.0.0.1:8765/'),
    (
        'params_file',
        PathJoinSubstitution([SHARE, 'config', 'estimator.yaml']),
        'parameters of the estimator (YAML)',
    ),
    ('use_sim_time', 'false', 'take the time from /clock; set it to true with a bag'),
    ('namespace', '', 'namespace of all nodes and topics, for several robots at once'),
)


def generate_launch_description():
    """Estimator, replayer (with `bag`), RViz (with `rviz:=true`)."""
    arg = LaunchConfiguration
    text = {name: ParameterValue(arg(name), value_type=str) for name in ('robot', 'map', 'bag')}
    common = {'package': 'continuum_loc', 'namespace': arg('namespace'), 'output': 'screen'}
    estimator = Node(
        executable='estimator',
        name='estimator',
        parameters=[
            ParameterFile(arg('params_file')),
            {
                'robot': text['robot'],
                'map': text['map'],
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
        parameters=[
            {
                'bag': text['bag'],
                'rate': ParameterValue(arg('rate'), value_type=float),
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
    end = RegisterEventHandler(
        OnProcessExit(
            target_action=replayer, on_exit=[EmitEvent(event=Shutdown(reason='the bag has ended'))]
        )
    )
    declared = [
        DeclareLaunchArgument(name, default_value=value, description=text)
        for name, value, text in ARGUMENTS
    ]
    return LaunchDescription([*declared, estimator, replayer, viewer, rviz, end])
