"""
Node `estimator` as a process, over real DDS.

A robot at rest in a box whose distances are exact.
"""

import json
from pathlib import Path
import signal
import time

from continuum_loc.mapping.map_files import load_map
from continuum_loc.measurements import nanoseconds, TofFrame
from geometry_msgs.msg import PoseWithCovarianceStamped
from msg_tools.convert import tracker_message
from msg_tools.factory import ros_messages
from msg_tools.records import CloudRecord
from node_graph import BoxRobot, Client, COMPILING, fresh_domain, Process, wait_until
import numpy as np
import pytest
from rcl_interfaces.srv import DescribeParameters, SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_srvs.srv import Trigger

pytestmark = pytest.mark.timeout(300)
INPUTS = ('tof/points', 'imu/data_raw', 'strain', 'joint_states')
RINGS = ('ring_pose/ring2', 'ring_twist/ring2', 'ring_pose/base')
OUTPUTS = ('poses', 'backbone', 'tip', 'reconstruction', '/diagnostics', *RINGS)


@pytest.fixture(scope='module')
def box(tmp_path_factory):
    return BoxRobot(tmp_path_factory.mktemp('box'))


def start(box, folder, domain, *arguments, **parameters):
    # A test's machine may be slow without that being an overload to be relieved.
    node = Process(
        'estimator',
        domain,
        folder,
        *arguments,
        robot=box.path,
        map=box.map,
        settings='engine',
        diagnostics_rate=5.0,
        **{'intake.max_backlog': 30.0},
        **parameters,
    )
    node.await_log('ready:', COMPILING)
    return node


@pytest.fixture(scope='module')
def graph(box, tmp_path_factory):
    """One estimator for the tests which do not stop it."""
    folder, domain = tmp_path_factory.mktemp('estimator'), fresh_domain()
    node = start(box, folder, domain, output_folder=folder / 'saved', reconstruction_rate=5.0)
    with Client(domain) as client:
        for topic in INPUTS:
            client.publisher(topic)
        client.await_listeners(*INPUTS)
        for topic in OUTPUTS:
            client.hear(topic)
        client.await_speakers()
        yield client, node, folder
    assert node.stop() == 0, node.log


@pytest.fixture
def fresh(graph):
    """Return the graph with the estimate begun anew and nothing heard yet."""
    client, node, _ = graph
    assert client.call(Trigger, 'estimator/reset', Trigger.Request()).success
    for items in client.heard.values():
        items.clear()
    return graph


def test_every_output_comes_and_is_right(fresh, box):
    client, node, _ = fresh
    stamps = box.play(client, 2.0)
    assert client.until(lambda: all(client.heard[topic] for topic in OUTPUTS)), {
        t: len(h) for t, h in client.heard.items()
    }
    poses = client.heard['poses']
    assert client.until(lambda: len(poses) >= 25)  # of 30 frames
    error = np.linalg.norm(poses[-1].T_map_body[:, :3, 3] - box.T_map_ring[:, :3, 3], axis=1)
    assert error.max() < 0.01, error
    tip = client.heard['tip'][-1]
    np.testing.assert_allclose(tip.T_map_tip, poses[-1].T_map_body[-1], atol=1e-6)
    assert np.linalg.eigvalsh(tip.covariance).min() > 0.0 and np.abs(tip.velocity).max() < 0.1
    stamps_of_poses = [pose.stamp for pose in poses]
    for topic in RINGS:  # one for each of `poses`
        assert [item.stamp for item in client.heard[topic]] == stamps_of_poses
    alone = client.heard['ring_pose/ring2'][-1]
    np.testing.assert_allclose(alone.T_map_sensor, tip.T_map_tip, atol=1e-9)
    np.testing.assert_allclose(alone.covariance, tip.covariance, atol=1e-12)
    backbone = client.heard['backbone'][-1].T_map_backbone[:, :3, 3]
    steps = np.linalg.norm(np.diff(backbone, axis=0), axis=1)
    # Evenly spaced.
    np.testing.assert_allclose(steps, box.robot.length / (len(backbone) - 1), rtol=0.02)
    points = client.heard['reconstruction'][-1].points
    assert len(points) >= 64 and _distance_to_box(points).max() < 0.02
    sigma, anomaly = (client.heard['reconstruction'][-1].fields[n] for n in ('sigma', 'anomaly'))
    assert (sigma > 0.001).all() and 0.0 < np.median(anomaly) < 3.0
    assert {pose.stamp for pose in poses} <= set(stamps)  # the sensors' stamps, never the arrival


def _distance_to_box(points):
    from node_graph import BOX

    return np.abs(points[:, :, None] - BOX.T[None]).min(axis=(1, 2))


def test_diagnostics_say_what_goes_on(fresh, box):
    client, _, _ = fresh
    box.play(client, 2.0)
    (name, level, message, values) = client.heard['/diagnostics'][-1].statuses[0]
    assert 'estimator' in name and 'stub' in name
    assert level in (0, 1) and values['status'] == 'tracking', (level, message, values)
    assert {'received', 'used', 'dropped', 'consistency', 'inliers', 'queue'} <= set(values)
    client.heard['/diagnostics'].clear()
    assert client.until(
        lambda: any(
            'no data for' in record.statuses[0][2] and record.statuses[0][1] == 2
            for record in client.heard['/diagnostics']
        )
    )


def test_a_late_joiner_gets_the_latched_map(graph, box):
    _, node, _ = graph
    with Client(int(_domain(graph))) as late:
        maps = late.hear('prior_map')
        assert late.until(lambda: maps)
        assert isinstance(maps[0], CloudRecord)
        assert _distance_to_box(maps[0].points).max() < 1e-4
        assert {'normal_x', 'normal_y', 'normal_z', 'planarity'} <= set(maps[0].fields)


def _domain(graph):
    return graph[0].context.get_domain_id()


def test_services_save_what_was_estimated(fresh, box):
    client, _, folder = fresh
    answer = client.call(Trigger, 'estimator/save_trajectory', Trigger.Request())
    box.play(client, 1.5)
    assert client.until(lambda: client.heard['reconstruction'])
    answer = client.call(Trigger, 'estimator/save_trajectory', Trigger.Request())
    assert answer.success, answer.message
    files = sorted(path.name for path in Path(answer.message).glob('*.tum'))
    assert files == ['estimate_base.tum', 'estimate_ring1.tum', 'estimate_ring2.tum']
    answer = client.call(Trigger, 'estimator/save_map', Trigger.Request())
    assert answer.success, answer.message
    assert _distance_to_box(load_map(answer.message).points).max() < 0.02


def test_initialpose_moves_the_base(fresh, box):
    """The estimate starts at the base that it is given, 3 cm to the side, known to 0.5 mm."""
    client, node, _ = fresh
    publisher = client.node.create_publisher(PoseWithCovarianceStamped, 'initialpose', 1)
    assert client.until(lambda: publisher.get_subscription_count() > 0)
    from continuum_loc.measurements import TrackedPose

    T = np.eye(4)
    T[1, 3] = 0.03
    publisher.publish(tracker_message(ros_messages(), TrackedPose(client.now(), 'base', T)))
    node.await_log('initialpose: the estimate starts anew')
    for items in client.heard.values():
        items.clear()
    box.play(client, 0.5)
    assert client.until(lambda: client.heard['poses'])
    moved = client.heard['poses'][-1].T_map_body[0, 1, 3]
    publisher.publish(
        tracker_message(ros_messages(), TrackedPose(client.now(), 'base', np.eye(4)))
    )
    assert wait_until(lambda: node.log.count('initialpose: the estimate starts anew') >= 2)
    assert moved == pytest.approx(0.03, abs=1e-3)


def test_a_map_is_changed_while_the_node_runs_and_the_body_stays(fresh, box, tmp_path):
    """Half of the points, in another order: what is in the window is matched anew."""
    client, node, _ = fresh
    box.play(client, 1.0)
    assert client.until(lambda: client.heard['poses'])
    head, *rows = box.map.read_text().splitlines()
    order = np.random.default_rng(1).permutation(len(rows))[: len(rows) // 2]
    other = tmp_path / 'other.csv'
    other.write_text('\n'.join([head, *(rows[i] for i in order)]) + '\n')

    def change(path):
        request = SetParameters.Request(
            parameters=[Parameter('map', value=str(path)).to_parameter_msg()]
        )
        return client.call(SetParameters, 'estimator/set_parameters', request).results[0]

    result = change(tmp_path / 'absent.ply')
    assert not result.successful and 'absent.ply' in result.reason
    assert not change('').successful
    result = change(other)
    assert result.successful, result.reason
    node.await_log(f'another map: {len(order)} points; shape and biases stay')
    for items in client.heard.values():
        items.clear()
    box.play(client, 1.0)
    assert client.until(lambda: len(client.heard['poses']) >= 10)
    for pose in client.heard['poses']:
        error = pose.T_map_body[:, :3, 3] - box.T_map_ring[:, :3, 3]
        assert np.linalg.norm(error, axis=1).max() < 0.01
    said = [record.statuses[0][3].get('status') for record in client.heard['/diagnostics']]
    assert said and set(said) == {'tracking'}  # it did not start anew
    assert change(box.map).successful
    answer = client.call(Trigger, 'estimator/clear_faults', Trigger.Request())
    assert answer.success and 'believed again' in answer.message


def test_parameters_are_described_and_guarded(graph):
    client, _, _ = graph
    name = 'estimator/describe_parameters'
    request = DescribeParameters.Request(
        names=['lag_warning', 'filter.tof.gate', 'robot', 'intake.queue_capacity']
    )
    lag, gate, robot, capacity = client.call(DescribeParameters, name, request).descriptors
    assert '[s]' in lag.description and lag.floating_point_range[0].from_value == 0.0
    assert '[m]' in gate.description and '> 0' in gate.additional_constraints
    assert robot.description and capacity.integer_range[0].from_value == 100

    def change(parameter, value):
        request = SetParameters.Request(
            parameters=[Parameter(parameter, value=value).to_parameter_msg()]
        )
        return client.call(SetParameters, 'estimator/set_parameters', request).results[0]

    assert change('lag_warning', 0.2).successful
    assert change('filter.tof.gate', 0.11).successful
    for parameter, value, reason in (
        ('robot', 'other', 'read-only'),
        ('lag_warning', 0.0, 'lag_warning'),
        ('lag_warning', 'text', 'type'),
        ('filter.tof.gate', -1.0, 'gate'),
    ):
        result = change(parameter, value)
        assert not result.successful and reason in result.reason.lower(), result


def test_best_effort_and_reliable_publishers_are_both_heard(fresh, box):
    client, _, _ = fresh
    with Client(int(_domain(fresh))) as driver:
        for topic in INPUTS:
            driver.publisher(
                topic, QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)
            )
        driver.await_listeners(*INPUTS)
        box.play(driver, 1.0)
    assert client.until(lambda: len(client.heard['poses']) >= 5)


def test_a_looped_bag_starts_anew(fresh, box):
    client, node, _ = fresh
    origin = client.now() - nanoseconds(100.0)
    box.play(client, 1.0, start=origin, rate=30.0)
    assert client.until(lambda: client.heard['poses'])
    box.play(client, 1.5, start=origin - nanoseconds(50.0), rate=30.0)
    node.await_log('time went backward')
    assert client.until(lambda: client.heard['poses'][-1].stamp < origin)
    error = client.heard['poses'][-1].T_map_body[:, :3, 3] - box.T_map_ring[:, :3, 3]
    assert np.linalg.norm(error, axis=1).max() < 0.01


def test_zero_and_future_stamps_and_strangers_are_refused_and_named(fresh, box):
    client, node, _ = fresh
    now = client.now()
    frame = box.frame(box.robot.tof[0], now)
    for stamp, sensor in (
        (0, frame.sensor),
        (now + nanoseconds(60.0), frame.sensor),
        (now, 'nobody'),
    ):
        client.send(
            'tof/points',
            TofFrame(stamp, sensor, frame.points, frame.ranges, frame.sigma, frame.status),
        )
    for text in ('zero stamp', 'future stamp', "no such sensor 'nobody'; valid: up, down, tip"):
        node.await_log(text)


@pytest.mark.parametrize('how', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_node_cleanly_in_the_middle_of_data(box, tmp_path, how):
    """It may come several times: a terminal and a launch file each send theirs."""
    domain, summary = fresh_domain(), tmp_path / 'summary.json'
    node = start(box, tmp_path, domain, summary_file=summary)
    with Client(domain) as client:
        for topic in INPUTS:
            client.publisher(topic)
        client.await_listeners(*INPUTS)
        poses = client.hear('poses')
        stamp = client.now()
        for tick in range(600):
            for topic, sample in box.samples(stamp + nanoseconds(tick / 100)):
                client.send(topic, sample)
            client.spin(0.005)
            if len(poses) >= 5:
                break
        assert client.until(lambda: poses), node.log
        for _ in range(3):
            node.popen.send_signal(how)
            time.sleep(0.02)
        assert node.wait() == 0, node.log
    assert 'Traceback' not in node.log, node.log
    data = json.loads(summary.read_text())
    assert data['counts']['received']['tof/points'] > 0 and data['step_ms']['count'] >= 1


def test_either_side_may_be_restarted(box, tmp_path):
    """Two estimators, one after the other, and two drivers: data flows again each time."""
    domain = fresh_domain()
    node = start(box, tmp_path, domain)
    with Client(domain) as watcher:
        poses = watcher.hear('poses')
        for _ in range(2):
            with Client(domain) as driver:
                for topic in INPUTS:
                    driver.publisher(topic)
                driver.await_listeners(*INPUTS)
                watcher.await_speakers()
                poses.clear()
                box.play(driver, 1.0)
                assert watcher.until(lambda: poses), node.log
        assert node.stop() == 0
        node = start(box, tmp_path, domain)
        with Client(domain) as driver:
            for topic in INPUTS:
                driver.publisher(topic)
            driver.await_listeners(*INPUTS)
            watcher.await_speakers()
            poses.clear()
            box.play(driver, 1.0)
            assert watcher.until(lambda: poses), node.log
    assert node.stop() == 0


def test_bad_input_ends_in_one_clear_line(box, tmp_path):
    cases = (
        ({'robot': 'nobody'}, "no robot 'nobody'"),
        ({'map': tmp_path / 'absent.ply'}, 'absent.ply'),
        (
            {'robot': box.path, 'lag_warnin': 1.0},
            "unknown parameter 'lag_warnin'; did you mean 'lag_warning'",
        ),
        ({'robot': box.path, 'settings': 'engine', 'filter.window': -1.0}, 'filter.window'),
    )
    nodes = [
        Process('estimator', fresh_domain(), tmp_path, **parameters) for parameters, _ in cases
    ]
    for node, (_, text) in zip(nodes, cases, strict=True):
        assert wait_until(lambda node=node: node.popen.poll() is not None)
        assert node.popen.returncode == 2 and text in node.log and 'Traceback' not in node.log, (
            node.log
        )


def test_two_robots_in_namespaces(box, tmp_path):
    domain = fresh_domain()
    nodes = [start(box, tmp_path, domain, '-r', f'__ns:=/arm{i}', warm_up='false') for i in (1, 2)]
    with Client(domain, namespace='/arm2') as client, Client(domain, namespace='/arm1') as other:
        for topic in INPUTS:
            client.publisher(topic)
        client.await_listeners(*INPUTS)
        mine, others = client.hear('poses'), other.hear('poses')
        client.await_speakers()
        box.play(client, 1.0)
        assert client.until(lambda: mine)
        other.spin(0.2)
        assert not others
    for node in nodes:
        assert node.stop() == 0, node.log
