"""TF of the estimator node: which frames, which way round, their stamps, and what is latched."""

from importlib.machinery import ModuleSpec
import sys
from types import ModuleType, SimpleNamespace

from continuum_loc import lie
from continuum_loc.errors import FrameError
from continuum_loc.measurements import nanoseconds
from continuum_loc.nodes.support import transforms
from continuum_loc.nodes.support.frames import FrameTree
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

    def get_logger(self):
        return SimpleNamespace(warning=lambda *_, **__: None)

    def managed_publisher(self, type_, topic, qos):
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
    _broadcast(graph, robot, T_map_ring)
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


def _broadcast(graph, robot, T_map_ring, tree=None, **chosen):
    frames = transforms.Frames(robot, 'arm_', **chosen)
    sender = transforms.Broadcaster(graph, frames, tree or FrameTree())
    sender.send_fixed()
    sender.send(STAMP, T_map_ring)
    return sender


def test_rings_alone_leave_the_base_to_others_and_none_says_nothing(tf2):
    robot = load_robot('engine')
    T_map_ring = np.tile(np.eye(4), (len(robot.ring_names) + 1, 1, 1))
    graph = Graph()
    _broadcast(graph, robot, T_map_ring, tf='rings', base_frame='arm_base')
    parents = {parent for parent, _ in edges(graph.published['/tf'][0])}
    assert parents == {'arm_arm_base'}
    assert len(graph.published['/tf_static']) == 1
    silent = Graph()
    _broadcast(silent, robot, T_map_ring, tf='none')
    assert not silent.published  # no publisher, on /tf_static neither


def test_the_map_is_told_from_odom_at_the_newest_instant_of_which_odometry_has_come(tf2):
    """The base goes 1 m/s along x in `odom`, which lies 2 m to the left in the map."""
    robot, tree, graph = load_robot('engine'), FrameTree(), Graph()
    T_map_odom = lie.exp(np.array([0.0, 2.0, 0.0, 0.0, 0.0, 0.4]))

    def T_odom_base(seconds):
        return lie.exp(np.array([seconds, 0.0, 0.0, 0.0, 0.0, 0.0]))

    def body(seconds):
        T = np.tile(T_map_odom @ T_odom_base(seconds), (len(robot.ring_names) + 1, 1, 1))
        return STAMP + nanoseconds(seconds), T

    sender = transforms.Broadcaster(
        graph, transforms.Frames(robot, 'arm_', tf='odom', odom_frame='world', map='site'), tree
    )
    sender.send(*body(0.05))
    assert ('site', 'arm_world') not in edges(graph.published['/tf'][0])  # nothing is known yet
    for tick in range(3):  # through a footprint, as mobile bases have it
        tree.add(
            'arm_world', 'arm_footprint', T_odom_base(0.1 * tick), STAMP + nanoseconds(0.1 * tick)
        )
    tree.add('arm_footprint', 'arm_base_link', np.eye(4), None)
    sender.send(*body(0.15))
    sender.send(*body(0.25))  # the odometry of which comes later
    for number, message in ((1, 0.15), (2, None)):
        found = edges(graph.published['/tf'][number])
        if message is None:
            assert ('site', 'arm_world') not in found
        else:
            np.testing.assert_allclose(found['site', 'arm_world'], T_map_odom, atol=1e-12)
        assert all(child != 'arm_base_link' for _, child in found)  # somebody else moves it
    tree.add('arm_world', 'arm_footprint', T_odom_base(0.3), STAMP + nanoseconds(0.3))
    sender.send(*body(0.35))
    stamp = graph.published['/tf'][3].transforms[0].header.stamp
    assert stamp.sec * 10**9 + stamp.nanosec == STAMP + nanoseconds(0.25)


def test_frames_of_others_are_followed_through_the_tree():
    tree = FrameTree()
    turned = lie.exp(np.array([0.0, 0.0, 1.0, 0.0, 0.0, np.pi / 2]))
    tree.add('map', 'cart', lie.exp(np.array([1.0, 0, 0, 0, 0, 0])), STAMP)
    tree.add('map', 'cart', lie.exp(np.array([3.0, 0, 0, 0, 0, 0])), STAMP + nanoseconds(1.0))
    tree.add('cart', 'camera', turned, None)
    tree.add('map', 'pole', np.eye(4), None)
    halfway = tree.transform('pole', 'camera', STAMP + nanoseconds(0.5))
    np.testing.assert_allclose(halfway[:3, 3], [2.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(halfway[:3, 0], [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(
        tree.transform('camera', 'pole'), lie.inverse(tree.transform('pole', 'camera'))
    )
    np.testing.assert_allclose(tree.transform('cart', 'cart'), np.eye(4))
    with pytest.raises(
        FrameError, match="no way from frame 'nobody' to 'map'.*camera, cart, map, pole"
    ):
        tree.transform('map', 'nobody')
    with pytest.raises(FrameError, match="'cart' is known from .* not at"):
        tree.transform('map', 'camera', STAMP + nanoseconds(1.5))


def test_a_tree_forgets_what_is_old_and_follows_time_that_starts_again():
    tree = FrameTree()
    for second in range(30):
        tree.add('map', 'cart', np.eye(4), STAMP + nanoseconds(float(second)))
    with pytest.raises(FrameError):
        tree.transform('map', 'cart', STAMP + nanoseconds(15.0))
    tree.add('map', 'cart', 2.0 * np.eye(4), STAMP - nanoseconds(1000.0))
    assert tree.transform('map', 'cart')[0, 0] == 2.0
    tree.add('odom', 'cart', np.eye(4), None)  # another parent: the old one is none any more
    with pytest.raises(FrameError):
        tree.transform('map', 'cart')


def test_the_newest_stamp_of_a_way_is_that_of_its_oldest_link():
    tree = FrameTree()
    tree.add('map', 'rail', np.eye(4), STAMP)
    tree.add('map', 'rail', np.eye(4), STAMP + nanoseconds(0.3))
    tree.add('rail', 'tool0', np.eye(4), STAMP + nanoseconds(0.1))
    tree.add('tool0', 'flange', np.eye(4), None)
    assert tree.latest('map', 'flange') == STAMP + nanoseconds(0.1)
    assert tree.latest('tool0', 'flange') == STAMP + nanoseconds(0.1)
    assert FrameTree().latest('map', 'nobody') is None


def test_odometry_that_the_filter_knows_needs_no_other_frames(tf2):
    """Where map -> odom is part of the estimate, it is what is sent, whatever /tf has."""
    robot, graph = load_robot('engine'), Graph()
    T = np.tile(np.eye(4), (len(robot.ring_names) + 1, 1, 1))
    frames = transforms.Frames(robot, tf='odom')
    T_map_odom = lie.exp(np.array([0.1, 0.2, 0.3, 0.1, 0.2, 0.3]))
    transforms.Broadcaster(graph, frames, FrameTree()).send(STAMP, T, T_map_odom)
    (moving,) = graph.published['/tf']
    np.testing.assert_allclose(edges(moving)['map', 'odom'], T_map_odom, atol=1e-12)


def test_two_robots_and_a_mobile_base_make_one_tree(tf2):
    """Every frame has one parent, whatever each robot publishes."""
    robot = load_robot('engine')
    T = np.tile(np.eye(4), (len(robot.ring_names) + 1, 1, 1))
    parents = {}
    for prefix, chosen in (('left_', 'base'), ('right_', 'odom')):
        graph, tree = Graph(), FrameTree()
        tree.add(f'{prefix}odom', f'{prefix}base_link', np.eye(4), None)
        if chosen == 'odom':
            parents[f'{prefix}base_link'] = {f'{prefix}odom'}
        sender = transforms.Broadcaster(graph, transforms.Frames(robot, prefix, tf=chosen), tree)
        sender.send_fixed()
        sender.send(STAMP, T)
        for message in graph.published['/tf'] + graph.published['/tf_static']:
            for parent, child in edges(message):
                parents.setdefault(child, set()).add(parent)
    assert all(len(several) == 1 for several in parents.values())
    assert 'map' not in parents and {'left_base_link', 'right_odom'} <= set(parents)
