"""TF of the estimator node: which frames, which way round, their stamps, and what is latched."""

from importlib.machinery import ModuleSpec
import sys
from types import ModuleType, SimpleNamespace

from continuum_loc import lie
from continuum_loc.nodes.support import transforms
from continuum_loc.robot import load_robot
from msg_tools.factory import ros_messages
import numpy as np
import pytest
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from scipy.spatial.transform import Rotation

STAMP = 1_700_000_000_123_456_789


class TFMessage:
    """Stands in for tf2_msgs/msg/TFMessage, which not every installation has."""

    def __init__(self, transforms):
        self.transforms = list(transforms)


class Graph:
    """A node that only notes what is published, by topic, and each publisher's type and QoS."""

    def __init__(self):
        self.published, self.publishers = {}, {}

    def now(self):
        return STAMP

    def create_publisher(self, type_, topic, qos):
        self.publishers[topic] = (type_, qos)
        self.published[topic] = []
        return SimpleNamespace(publish=self.published[topic].append)


@pytest.fixture
def tf2(monkeypatch):
    package, messages = ModuleType('tf2_msgs'), ModuleType('tf2_msgs.msg')
    package.__spec__ = ModuleSpec('tf2_msgs', None)
    messages.TFMessage = TFMessage
    monkeypatch.setitem(sys.modules, 'tf2_msgs', package)
    monkeypatch.setitem(sys.modules, 'tf2_msgs.msg', messages)
    ros_messages.cache_clear()  # it remembers the types that it has found
    yield
    ros_messages.cache_clear()


@pytest.fixture
def sent(tf2):
    """Send one estimate of the engine robot at random poses; robot, graph and poses."""
    robot, graph = load_robot('engine'), Graph()
    T_map_ring = lie.exp(np.random.default_rng(3).normal(size=(len(robot.ring_names) + 1, 6)))
    transforms.broadcaster(graph, robot, 'arm_').send(STAMP, T_map_ring)
    return robot, graph, T_map_ring


def matrix(message):
    v, q = message.transform.translation, message.transform.rotation
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    T[:3, 3] = v.x, v.y, v.z
    return T


def edges(message):
    """(parent, child) -> (4, 4) by which the parent sees what the child sees."""
    return {(t.header.frame_id, t.child_frame_id): matrix(t) for t in message.transforms}


def test_the_frames_are_map_base_link_rings_and_sensors_with_their_prefix(sent):
    robot, graph, _ = sent
    (moving,), (static,) = graph.published['/tf'], graph.published['/tf_static']
    rings = [f'arm_{name}' for name in robot.ring_names]
    assert list(edges(moving)) == [
        ('map', 'arm_base_link'),
        *(('arm_base_link', ring) for ring in rings),
    ]
    assert set(edges(static)) == {(f'arm_{s.ring}', f'arm_{s.name}') for s in robot.sensors}
    children = [child for message in (moving, static) for _, child in edges(message)]
    assert len(children) == len(set(children))  # a tree: nobody has two parents


def test_a_point_that_a_sensor_sees_goes_through_the_tree_to_its_place_in_the_map(sent):
    robot, graph, T_map_ring = sent
    moving, static = edges(graph.published['/tf'][0]), edges(graph.published['/tf_static'][0])
    point = np.array([0.4, 0.05, -0.02, 1.0])
    for sensor in robot.sensors:
        ring, name = f'arm_{sensor.ring}', f'arm_{sensor.name}'
        through = (
            moving['map', 'arm_base_link'] @ moving['arm_base_link', ring] @ static[ring, name]
        )
        direct = T_map_ring[1 + robot.ring_names.index(sensor.ring)] @ sensor.mount.T_ring_sensor
        np.testing.assert_allclose(through @ point, direct @ point, atol=1e-9)


def test_stamps_are_the_estimate_s_and_static_frames_are_latched(sent):
    _, graph, _ = sent
    for message in graph.published['/tf'] + graph.published['/tf_static']:
        for transform in message.transforms:
            stamp = transform.header.stamp
            assert stamp.sec * 10**9 + stamp.nanosec == STAMP
    type_, latched = graph.publishers['/tf_static']
    assert type_ is TFMessage and latched.depth == 1
    assert latched.durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert latched.reliability == ReliabilityPolicy.RELIABLE
    assert graph.publishers['/tf'][1].durability == DurabilityPolicy.VOLATILE


def test_without_tf2_there_is_no_broadcaster(monkeypatch):
    monkeypatch.setitem(sys.modules, 'tf2_msgs', None)
    monkeypatch.setattr(transforms.importlib.util, 'find_spec', lambda name: None)
    graph = Graph()
    assert transforms.broadcaster(graph, load_robot('engine'), '') is None
    assert not graph.published
