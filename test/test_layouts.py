"""Layouts for RViz and Foxglove show topics that there are, by displays that take their types."""

import json
from pathlib import Path

from msg_tools.topics import OUTPUTS, TOPICS
import pytest
import yaml

ROOT = Path(__file__).resolve().parent.parent
# As rviz_default_plugins' plugins_description.xml (branch jazzy) has them.
DISPLAYS = {
    'rviz_default_plugins/PointCloud2': 'sensor_msgs/msg/PointCloud2',
    'rviz_default_plugins/Path': 'nav_msgs/msg/Path',
    'rviz_default_plugins/PoseArray': 'geometry_msgs/msg/PoseArray',
    'rviz_default_plugins/Odometry': 'nav_msgs/msg/Odometry',
    'rviz_default_plugins/MarkerArray': 'visualization_msgs/msg/MarkerArray',
}
NO_TOPIC = {'rviz_default_plugins/Grid', 'rviz_default_plugins/TF'}
BESIDE = {  # what is no part of the contract that bags keep
    'body': 'visualization_msgs/msg/MarkerArray',
}


def type_of(topic):
    return BESIDE[topic] if topic in BESIDE else TOPICS[topic].type


@pytest.fixture(scope='module')
def rviz():
    return yaml.safe_load((ROOT / 'rviz' / 'continuum_loc.rviz').read_text())


def test_every_display_of_rviz_takes_its_topic_s_type(rviz):
    manager = rviz['Visualization Manager']
    assert manager['Global Options']['Fixed Frame'] == 'map'
    shown = set()
    for display in manager['Displays']:
        kind = display['Class']
        if kind in NO_TOPIC or kind == 'rviz_default_plugins/RobotModel':
            continue
        topic = display['Topic']['Value']
        assert not topic.startswith('/'), topic  # so that a namespace works
        assert type_of(topic) == DISPLAYS[kind], display['Name']
        latched = display['Topic']['Durability Policy'] == 'Transient Local'
        assert latched == (topic in TOPICS and TOPICS[topic].latched)
        shown.add(topic)
    assert {'body', 'prior_map', 'reconstruction', 'poses', 'tip', 'backbone'} <= shown


def test_the_pose_tool_of_rviz_speaks_to_the_estimator(rviz):
    tools = rviz['Visualization Manager']['Tools']
    (pose,) = [tool for tool in tools if tool['Class'].endswith('SetInitialPose')]
    assert pose['Topic']['Value'] == 'initialpose'


def test_the_layout_of_foxglove_names_panels_and_topics_that_there_are():
    layout = json.loads((ROOT / 'foxglove' / 'continuum_loc.json').read_text())
    names = set()

    def walk(node):
        if isinstance(node, str):
            names.add(node)
        else:
            walk(node['first'])
            walk(node['second'])

    walk(layout['layout'])
    assert names == set(layout['configById'])
    scene = layout['configById']['3D!body']
    assert scene['followTf'] == 'map'
    for topic in scene['topics']:
        assert type_of(topic[1:]), topic
    outputs = {*OUTPUTS, 'body', 'ground_truth/poses'}
    assert {topic[1:] for topic in scene['topics']} <= outputs
