"""TF over DDS: two robots in two namespaces make one tree. Where tf2_msgs is installed."""

from dataclasses import replace

from continuum_loc.measurements import nanoseconds
from continuum_loc.nodes.support.frames import FrameTree
from continuum_loc.nodes.support.quality import LATCHED
from continuum_loc.nodes.support.transforms import transform_message
from msg_tools.factory import ros_messages
from msg_tools.geometry import transforms_of
from node_graph import BoxRobot, Client, COMPILING, fresh_domain, Process
import numpy as np
import pytest
from rclpy.qos import QoSProfile

TFMessage = pytest.importorskip('tf2_msgs.msg', reason='tf2_msgs is not installed').TFMessage
pytestmark = pytest.mark.timeout(300)
INPUTS = ('tof/points', 'imu/data_raw', 'strain', 'joint_states')


def estimator(box, folder, domain, name, **chosen):
    node = Process(
        'estimator',
        domain,
        folder,
        '-r',
        f'__ns:=/{name}',
        robot=box.path,
        map=box.map,
        settings='engine',
        frame_prefix=f'{name}_',
        **{'intake.max_backlog': 30.0} | chosen,
    )
    node.await_log('ready:', COMPILING)
    return node


def edges(messages):
    """{child: {parents}} of all that was heard, and the tree of it."""
    parents, tree = {}, FrameTree()
    for message, fixed in messages:
        for one in message.transforms:
            parents.setdefault(one.child_frame_id, set()).add(one.header.frame_id)
            v, q = one.transform.translation, one.transform.rotation
            pose = ros_messages()(
                'geometry_msgs/msg/Pose',
                position=ros_messages()('geometry_msgs/msg/Point', x=v.x, y=v.y, z=v.z),
                orientation=q,
            )
            stamp = one.header.stamp.sec * 10**9 + one.header.stamp.nanosec
            T = transforms_of([pose], 'tf')[0]
            tree.add(one.header.frame_id, one.child_frame_id, T, None if fixed else stamp)
    return parents, tree


def _send(client, prefix, samples):
    for topic, sample in samples:
        named = hasattr(sample, 'sensor')
        client.send(topic, replace(sample, sensor=prefix + sample.sensor) if named else sample)


def test_two_robots_and_an_odometry_make_one_tree(tmp_path):
    """`left` is fixed; `right` is carried by somebody who publishes odom -> base_link."""
    box, domain = BoxRobot(tmp_path), fresh_domain()
    nodes = [
        estimator(box, tmp_path, domain, 'left'),
        estimator(box, tmp_path, domain, 'right', tf='odom'),
    ]
    heard = []
    with Client(domain, namespace='/left') as left, Client(domain, namespace='/right') as right:
        for topic, qos in (('/tf', QoSProfile(depth=100)), ('/tf_static', LATCHED)):
            left.node.create_subscription(
                TFMessage, topic, lambda m, fixed=topic != '/tf': heard.append((m, fixed)), qos
            )
        odometry = right.node.create_publisher(TFMessage, '/tf', QoSProfile(depth=100))
        for client in (left, right):
            for topic in INPUTS:
                client.publisher(topic)
            client.await_listeners(*INPUTS)
        assert left.until(lambda: odometry.get_subscription_count() >= 3)
        T_odom_base = np.eye(4)
        T_odom_base[:3, 3] = 5.0, 1.0, 0.0
        start, due = left.now(), 0

        def complete():
            """Publish what is due, and look: whoever is found late hears what comes later."""
            nonlocal due
            stamp = start + nanoseconds(due / 15)
            if left.now() >= stamp:
                moved = transform_message(
                    ros_messages(), stamp, 'right_odom', 'right_base_link', T_odom_base
                )
                odometry.publish(TFMessage(transforms=[moved]))
                for client, prefix in ((left, 'left_'), (right, 'right_')):
                    _send(client, prefix, box.samples(stamp))
                due += 1
            wanted = {'left_base_link', 'right_odom', 'left_up', 'right_up'}
            return due > 60 and wanted <= set(edges(heard)[0])

        assert left.until(complete), (sorted(edges(heard)[0]), nodes[1].log)
    parents, tree = edges(heard)
    assert all(len(several) == 1 for several in parents.values()), parents
    assert parents['left_base_link'] == {'map'} and parents['right_odom'] == {'map'}
    assert parents['right_base_link'] == {'right_odom'}  # its own, and nobody else's
    for prefix in ('left_', 'right_'):  # both stand at the map's origin, straight
        for ring, s in zip(box.robot.ring_names, box.robot.ring_arclengths, strict=True):
            T = tree.transform('map', prefix + ring)
            np.testing.assert_allclose(T[:3, 3], [s, 0.0, 0.0], atol=0.01)
        sensor = box.robot.tof[0]
        T = tree.transform(f'{prefix}{sensor.ring}', f'{prefix}{sensor.name}')
        np.testing.assert_allclose(T, sensor.mount.T_ring_sensor, atol=1e-6)
    for node in nodes:
        assert node.stop() == 0, node.log
