"""
What the other launch files start: one robot's nodes, in its namespace and with its frames.

`estimate` is the node that estimates (`estimator` or `shape`); its data come from a simulation
(`simulate`), from a bag (`play`), or from the robot's own drivers.
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

COMPILING = 900.0  # s; what the first start on a busy machine may take
SHARE = FindPackageShare('continuum_loc')
ARGUMENTS = (
    ('estimate', 'estimator', 'node that estimates: `estimator` or `shape`'),
    ('simulate', 'false', 'simulate the robot'),
    ('play', '', 'bag to play; empty for none'),
    ('record', '', 'folder of a bag to record; empty records none'),
    ('robot', 'engine', 'robot description: a bundled name or a YAML file'),
    ('map', '', 'prior map: npz, PLY, PCD, XYZ, CSV or a mesh'),
    ('scene', 'S0', 'scene to simulate: S0-S9, R0-R4, a mesh file, or `none`'),
    ('trajectory', 't1', 'named motion of the simulated robot'),
    ('duration', '0.0', 'seconds of simulated data; 0 for the whole trajectory'),
    ('rate', '1.0', 'speed of the bag relative to the recording'),
    ('params_file', '', 'parameters of the node that estimates (YAML); empty for the defaults'),
    ('tf', 'base', 'frames that are published: base, odom, rings or none'),
    ('rviz', 'false', 'start RViz'),
    ('viewer', 'false', 'serve a page to watch in a browser, at http://127.0.0.1:8765/'),
    ('use_sim_time', 'false', 'take the time from /clock; set it to true with a bag'),
    ('autostart', 'true', 'false leaves configuring and activating to a manager of lifecycles'),
    ('namespace', '', 'namespace of all nodes and topics, for several robots at once'),
    (
        'frame_prefix',
        PythonExpression(
            [
                "'",
                LaunchConfiguration('namespace'),
                "'.strip('/').replace('/', '_') + '_' if '",
                LaunchConfiguration('namespace'),
                "'.strip('/') else ''",
            ]
        ),
        'put before the names of the frames; by default the namespace and `_`',
    ),
)


def generate_launch_description():
    """Source, estimate, recorder, and what shows them."""
    common = {
        'package': 'continuum_loc',
        'namespace': LaunchConfiguration('namespace'),
        'output': 'screen',
    }
    declared = [
        DeclareLaunchArgument(name, default_value=value, description=text)
        for name, value, text in ARGUMENTS
    ]
    simulator, replayer = _simulator(common), _replayer(common)
    return LaunchDescription(
        [
            *declared,
            _recorder(common),
            *_estimating(common),
            simulator,
            replayer,
            Node(
                executable='viewer',
                name='viewer',
                condition=IfCondition(LaunchConfiguration('viewer')),
                **common,
            ),
            _rviz(),
            _ends_with(simulator, 'the simulation has ended'),
            _ends_with(replayer, 'the bag has ended'),
        ]
    )


def _value(name, kind=str):
    return ParameterValue(LaunchConfiguration(name), value_type=kind)


def _is(name, value):
    return EqualsSubstitution(LaunchConfiguration(name), value)


def _estimating(common):
    """One of the two; `shape` knows neither maps nor TF."""
    chosen = LaunchConfiguration('params_file')
    configs = PathJoinSubstitution([SHARE, 'config'])
    default = [configs, '/', LaunchConfiguration('estimate'), '.yaml']
    file = ParameterFile(PythonExpression(["'", chosen, "' or '", *default, "'"]))
    shared = {
        'robot': _value('robot'),
        'frame_prefix': _value('frame_prefix'),
        'use_sim_time': _value('use_sim_time', bool),
        'autostart': _value('autostart', bool),
    }
    more = {'estimator': {'map': _value('map'), 'tf': _value('tf')}, 'shape': {}}
    return [
        Node(
            executable=name,
            name=name,
            condition=IfCondition(_is('estimate', name)),
            parameters=[file, shared | own],
            **common,
        )
        for name, own in more.items()
    ]


def _simulator(common):
    # The estimator, and the recorder where there is one: the data begins when both listen.
    listeners = PythonExpression(["2 if '", LaunchConfiguration('record'), "' else 1"])
    return Node(
        executable='simulator',
        name='simulator',
        condition=IfCondition(LaunchConfiguration('simulate')),
        parameters=[
            {
                'robot': _value('robot'),
                'scene': _value('scene'),
                'trajectory': _value('trajectory'),
                'duration': _value('duration', float),
                'frame_prefix': _value('frame_prefix'),
                'use_sim_time': _value('use_sim_time', bool),
                'autostart': _value('autostart', bool),
                'wait_for': ParameterValue(listeners, value_type=int),
                'wait_timeout': COMPILING,
            }
        ],
        **common,
    )


def _replayer(common):
    return Node(
        executable='replayer',
        name='replayer',
        condition=IfCondition(NotSubstitution(_is('play', ''))),
        parameters=[
            {
                'bag': _value('play'),
                'rate': _value('rate', float),
                'autostart': _value('autostart', bool),
                'wait_for': 1,
                'wait_timeout': COMPILING,
            }
        ],
        **common,
    )


def _recorder(common):
    return Node(
        executable='recorder',
        name='recorder',
        condition=IfCondition(NotSubstitution(_is('record', ''))),
        parameters=[{'bag': _value('record'), 'autostart': _value('autostart', bool)}],
        **common,
    )


def _rviz():
    return Node(
        package='rviz2',
        executable='rviz2',
        namespace=LaunchConfiguration('namespace'),
        condition=IfCondition(LaunchConfiguration('rviz')),
        arguments=['-d', PathJoinSubstitution([SHARE, 'rviz', 'continuum_loc.rviz'])],
    )


def _ends_with(node, reason):
    return RegisterEventHandler(
        OnProcessExit(target_action=node, on_exit=[EmitEvent(event=Shutdown(reason=reason))])
    )
