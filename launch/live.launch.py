"""
Simulate a robot and localise it live.

ros2 launch continuum_loc live.launch.py map:=S0.npz trajectory:=t2 bag:=run1 rviz:=true
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
    PythonExpression,
)
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue
from launch_ros.substitutions import FindPackageShare

SHARE = FindPackageShare('continuum_loc')
ARGUMENTS = (
    ('robot', 'engine', 'robot description: a bundled name or a YAML file'),
    ('scene', 'S0', 'scene to simulate: S0-S9, R0-R4, or a mesh file'),
    ('trajectory', 't1', 'named motion of the robot'),
    ('duration', '0.0', 'seconds of data; 0 for the whole trajectory'),
    ('map', '', 'prior map for the estimator: npz, PLY, PCD, XYZ, CSV or a mesh'),
    ('bag', '', 'folder of a bag to record; empty records none'),
    ('rviz', 'false', 'start RViz'),
    ('viewer', 'false', 'serve a page to watch in a browser, at http://127.0.0.1:8765/'),
    (
        'params_file',
        PathJoinSubstitution([SHARE, 'config', 'estimator.yaml']),
        'parameters of the estimator (YAML)',
    ),
    ('use_sim_time', 'false', 'take the time from /clock; a live simulation keeps the wall clock'),
    ('namespace', '', 'namespace of all nodes and topics, for several robots at once'),
)


def generate_launch_description():
    """Launch simulator, estimator, recorder (with `bag`), RViz (with `rviz:=true`)."""
    arg = LaunchConfiguration
    text = {
        name: ParameterValue(arg(name), value_type=str)
        for name in ('robot', 'scene', 'trajectory', 'map', 'bag')
    }
    sim_time = ParameterValue(arg('use_sim_time'), value_type=bool)
    # The estimator, and the recorder where there is one: the data begins when both listen.
    listeners = ParameterValue(
        PythonExpression(["2 if '", arg('bag'), "' else 1"]), value_type=int
    )
    common = {'package': 'continuum_loc', 'namespace': arg('namespace'), 'output': 'screen'}
    simulator = Node(
        executable='simulator',
        name='simulator',
        parameters=[
            {
                'robot': text['robot'],
                'scene': text['scene'],
                'trajectory': text['trajectory'],
                'duration': ParameterValue(arg('duration'), value_type=float),
                'use_sim_time': sim_time,
                'wait_for': listeners,
            }
        ],
        **common,
    )
    estimator = Node(
        executable='estimator',
        name='estimator',
        parameters=[
            ParameterFile(arg('params_file')),
            {'robot': text['robot'], 'map': text['map'], 'use_sim_time': sim_time},
        ],
        **common,
    )
    recorder = Node(
        executable='recorder',
        name='recorder',
        parameters=[{'bag': text['bag']}],
        condition=IfCondition(NotSubstitution(EqualsSubstitution(arg('bag'), ''))),
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
            target_action=simulator,
            on_exit=[EmitEvent(event=Shutdown(reason='the simulation has ended'))],
        )
    )
    declared = [
        DeclareLaunchArgument(name, default_value=value, description=text)
        for name, value, text in ARGUMENTS
    ]
    return LaunchDescription([*declared, recorder, estimator, simulator, viewer, rviz, end])
