"""
Parameters: declared from the typed settings, described, with ranges.

Files are checked, and the YAML of every node is in step.
"""

import contextlib
from pathlib import Path

from config.write import config_text, NODES
from continuum_loc.errors import SettingsError
from continuum_loc.estimator import EstimatorSettings
from continuum_loc.nodes.support import parameters
from continuum_loc.nodes.support.managed import PackageNode
from continuum_loc.nodes.support.settings import EstimatorNodeSettings
from continuum_loc.offline.domain import Domain
import pytest
from rcl_interfaces.msg import ParameterType
import rclpy
from rclpy.context import Context
from rclpy.parameter import Parameter
import yaml

CONFIG = Path(__file__).resolve().parent.parent / 'config'


@contextlib.contextmanager
def node_of(defaults, *arguments, name='estimator'):
    context, node = Context(), None
    with Domain() as domain:
        rclpy.init(context=context, domain_id=domain.number, args=['--ros-args', *arguments])
        try:
            node = PackageNode(name, defaults, context=context)
            yield node
        finally:
            if node is not None:
                node.destroy_node()
            rclpy.try_shutdown(context=context)


@pytest.mark.parametrize('name', NODES)
def test_every_parameter_has_a_description_a_type_and_its_default(name):
    with node_of(NODES[name], name=name) as node:
        assert node.settings == NODES[name]
        names = [leaf for leaf, _, _ in parameters.leaves(NODES[name], '')]
        for descriptor in node.describe_parameters(names):
            assert descriptor.description, descriptor.name
            assert descriptor.type != ParameterType.PARAMETER_NOT_SET, descriptor.name


def test_filter_settings_are_parameters_too_with_units_and_ranges():
    with node_of(EstimatorNodeSettings()) as node:
        preset = EstimatorSettings()
        assert parameters.declare(node, preset, 'filter.') == preset
        gate, cosine = node.describe_parameters(['filter.tof.gate', 'filter.tof.min_cosine'])
        assert '[m]' in gate.description and gate.additional_constraints == '> 0'
        bounds = cosine.floating_point_range[0]
        assert (bounds.from_value, bounds.to_value) == (0.0, 1.0)


def test_values_given_at_the_start_are_taken_and_whole_numbers_serve_as_floats():
    with node_of(
        EstimatorNodeSettings(),
        '-p',
        'lag_warning:=2',
        '-p',
        'robot:=soft_arm',
        '-p',
        'intake.queue_capacity:=500',
    ) as node:
        assert node.settings.lag_warning == 2.0
        assert node.settings.robot == 'soft_arm' and node.settings.intake.queue_capacity == 500


@pytest.mark.parametrize(
    ('argument', 'text'),
    [
        ('lag_warning:=-1.0', 'lag_warning'),
        ('lag_warning:=text', 'lag_warning'),
        ('lag_warning:=0.0', 'lag_warning'),
        ('intake.queue_capacity:=5', 'intake.queue_capacity'),
        ('warm_up:=7', 'warm_up'),
        ('tf:=somehow', 'tf'),
    ],
)
def test_values_out_of_range_or_of_another_type_are_refused_by_name(argument, text):
    with (
        pytest.raises(SettingsError, match=text),
        node_of(EstimatorNodeSettings(), '-p', argument),
    ):
        pass


def test_unknown_parameters_are_refused_with_the_nearest_name(tmp_path):
    file = tmp_path / 'mine.yaml'
    file.write_text('/**:\n  ros__parameters:\n    intake:\n      max_backlogg: 0.1\n')
    with (
        node_of(EstimatorNodeSettings(), '--params-file', str(file)) as node,
        pytest.raises(
            SettingsError, match=r"'intake.max_backlogg'; did you mean 'intake.max_backlog'\?"
        ),
    ):
        node.check_parameters()


def test_ros_own_parameters_are_no_strangers():
    with node_of(EstimatorNodeSettings(), '-p', 'use_sim_time:=true') as node:
        node.check_parameters()


def test_changes_at_run_time_are_asked_about():
    asked = []

    def apply(values):
        asked.append(values)
        return 'not now' if 'output_folder' in values else None

    with node_of(EstimatorNodeSettings()) as node:
        parameters.guard(node, apply)
        assert node.set_parameters([Parameter('lag_warning', value=0.5)])[0].successful
        refused = node.set_parameters([Parameter('output_folder', value='x')])[0]
        assert not refused.successful and refused.reason == 'not now'
        assert asked == [{'lag_warning': 0.5}, {'output_folder': 'x'}]
        assert parameters.read(node, EstimatorNodeSettings).lag_warning == 0.5


@pytest.mark.parametrize('name', NODES)
def test_the_yaml_of_every_node_is_in_step_with_its_settings(name):
    """Else run `python -m continuum_loc.nodes.support.write_config config`."""
    text = (CONFIG / f'{name}.yaml').read_text()
    assert text == config_text(name)
    given = yaml.safe_load(text)['/**']['ros__parameters']
    assert set(given) == {leaf for leaf, _, _ in parameters.leaves(NODES[name], '')}
    with node_of(NODES[name], '--params-file', str(CONFIG / f'{name}.yaml'), name=name) as node:
        node.check_parameters()
        assert node.settings == NODES[name]


def test_what_may_not_change_is_read_only_and_may_be_set_to_what_it_is():
    """So that `ros2 param load` of the node's own dump is accepted, and restarts nothing."""
    asked = []
    with node_of(EstimatorNodeSettings()) as node:
        parameters.declare(node, EstimatorSettings(), 'filter.', live=True)
        parameters.guard(node, lambda values: asked.append(values))
        names = list(node._parameters)
        fixed, changeable = node.describe_parameters(['robot', 'filter.tof.gate'])
        assert fixed.read_only and not changeable.read_only
        dump = [Parameter(name, value=node.get_parameter(name).value) for name in names]
        assert len(dump) > 80
        for result in node.set_parameters(dump):
            assert result.successful, result.reason
        assert asked == []
        refused = node.set_parameters([Parameter('robot', value='soft_arm')])[0]
        assert not refused.successful and 'read-only' in refused.reason


@pytest.mark.parametrize(
    ('given', 'meant'),
    [
        ('gate', 'filter.tof.gate'),
        ('tof.gate', 'filter.tof.gate'),
        ('max_backlogg', 'intake.max_backlog'),
        ('filter.windw', 'filter.window'),
        ('warmup', 'warm_up'),
    ],
)
def test_the_nearest_name_may_lie_deeper(given, meant):
    with node_of(EstimatorNodeSettings()) as node:
        parameters.declare(node, EstimatorSettings(), 'filter.', live=True)
        assert parameters.nearest(given, list(node._parameters)) == meant


def test_quality_of_service_may_be_overridden():
    depth = 'qos_overrides./poses.publisher.depth'
    with node_of(EstimatorNodeSettings(), '-p', f'{depth}:=33') as node:
        node.check_parameters()
        node.publisher('poses')
        assert node.get_parameter(depth).value == 33
        assert node.get_publishers_info_by_topic('/poses')
