"""Several robots, bags and clocks on one graph: nodes as processes, over real DDS."""

from dataclasses import replace
import json
import signal

from continuum_loc.measurements import FieldSample, ImuSample, nanoseconds, TrackedPose
from msg_tools.bag import BagWriter
from msg_tools.factory import ros_messages
from msg_tools.geometry import time_message
from node_graph import BoxRobot, Client, COMPILING, fresh_domain, Process, wait_until
import numpy as np
import pytest
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock

pytestmark = pytest.mark.timeout(300)
INPUTS = ('tof/points', 'imu/data_raw', 'strain', 'joint_states')
YESTERDAY = 1_600_000_000 * 10**9
TRACKED = """
name: tracked
length: 0.3
radius: 0.01
rings: [{name: ring1, s: 0.15}, {name: ring2, s: 0.3}]
base: {sigma_position: 0.02, insertion: {mode: fixed}}
imu_model: {rate: 50.0}
imu: [{name: imu1, ring: ring1}, {name: imu2, ring: ring2}]
hall: [{name: hall1, ring: ring1}]
trackers: [{name: root, ring: ring1}, {name: em, ring: ring2}]
"""


@pytest.fixture(scope='module')
def box(tmp_path_factory):
    return BoxRobot(tmp_path_factory.mktemp('box'))


def estimator(folder, domain, *arguments, **parameters):
    node = Process(
        'estimator',
        domain,
        folder,
        *arguments,
        settings='engine',
        **{'warm_up': 'false', 'intake.max_backlog': 30.0} | parameters,
    )
    node.await_log('ready:', COMPILING)
    return node


def test_a_looped_bag_with_its_own_clock_is_estimated_anew_each_time_round(box, tmp_path):
    """Data of years ago, with use_sim_time and /clock: poses carry the bag's stamps, twice."""
    stamps = [YESTERDAY + nanoseconds(tick / 15) for tick in range(45)]
    with BagWriter(tmp_path / 'bag') as bag:
        for stamp in stamps:
            for topic, sample in box.samples(stamp):
                bag.write(topic, sample)
    domain = fresh_domain()
    node = estimator(
        tmp_path, domain, robot=box.path, map=box.map, use_sim_time='true', diagnostics_rate=5.0
    )
    with Client(domain) as client:
        poses, diagnostics = client.hear('poses'), client.hear('/diagnostics')
        client.await_speakers()
        replayer = Process(
            'replayer', domain, tmp_path, bag=tmp_path / 'bag', loop='true', wait_for=1
        )
        assert client.until(lambda: 'time went backward' in node.log), node.log
        before = len(poses)
        assert client.until(lambda: len(poses) > before + 15), node.log
        assert replayer.stop(signal.SIGINT) == 0, replayer.log
    assert 'Traceback' not in node.log + replayer.log
    assert {pose.stamp for pose in poses} <= set(stamps)
    again = [pose.stamp for pose in poses[before:]]
    assert min(again) < stamps[30] and (np.diff(again) > 0).sum() >= len(again) - 2
    error = poses[-1].T_map_body[:, :3, 3] - box.T_map_ring[:, :3, 3]
    assert np.linalg.norm(error, axis=1).max() < 0.01
    clock = [record.stamp for record in diagnostics if record.stamp]
    assert clock and all(stamps[0] <= t <= stamps[-1] + 10**9 for t in clock)
    assert node.stop() == 0, node.log


def test_data_that_overtake_their_clock_wait_for_it(box, tmp_path):
    """As of a fast player: two seconds of data come while the clock still stands."""
    stamps = [YESTERDAY + nanoseconds(tick / 15) for tick in range(1, 31)]
    latest = YESTERDAY + nanoseconds(0.5)  # of what the tolerance lets pass
    domain, summary = fresh_domain(), tmp_path / 'summary.json'
    node = estimator(
        tmp_path,
        domain,
        robot=box.path,
        map=box.map,
        use_sim_time='true',
        diagnostics_rate=5.0,
        summary_file=summary,
        warm_up='true',  # nothing is to take the time that the clock is waited for
        **{'intake.reliable_inputs': 'true'},
    )
    with Client(domain) as client:
        clock = client.node.create_publisher(Clock, '/clock', 10)

        def at(stamp):
            clock.publish(Clock(clock=time_message(ros_messages(), stamp)))

        poses, diagnostics = client.hear('poses'), client.hear('/diagnostics')
        client.await_listeners(*INPUTS)
        client.await_speakers()
        at(YESTERDAY)
        assert client.until(lambda: diagnostics and diagnostics[-1].stamp == YESTERDAY), node.log
        sent = [(topic, sample) for stamp in stamps for topic, sample in box.samples(stamp)]
        for topic, sample in sent:
            client.send(topic, sample)
        held = sum(sample.stamp > latest for _, sample in sent)

        def standing():
            values = diagnostics[-1].statuses[0][3]
            return (values['received'], values['queue']) == (str(len(sent)), str(held))

        assert client.until(standing), (diagnostics[-1], held, node.log)
        assert all(pose.stamp <= latest for pose in poses)
        at(stamps[-1])
        assert client.until(lambda: poses and poses[-1].stamp == stamps[-1]), node.log
    assert node.stop() == 0, node.log
    counts = json.loads(summary.read_text())['counts']
    assert counts['refused'] == {}, node.log
    assert counts['used']['tof/points'] == len(stamps) * len(box.robot.tof)


def test_two_robots_at_once_keep_to_themselves(box, tmp_path):
    """
    One looks at a box, the other is led by trackers and carries a Hall sensor; both at one time.

    Frame names of the first have a prefix. Each hears its own namespace alone.
    """
    domain, path = fresh_domain(), tmp_path / 'tracked.yaml'
    path.write_text(TRACKED)
    looking = estimator(
        tmp_path, domain, '-r', '__ns:=/one', robot=box.path, map=box.map, frame_prefix='one_'
    )
    led = estimator(tmp_path, domain, '-r', '__ns:=/two', robot=path)
    led_inputs = ('imu/data_raw', 'imu/mag', 'tracker/root', 'tracker/em')
    with Client(domain, namespace='/one') as one, Client(domain, namespace='/two') as two:
        heard = [client.hear('poses') for client in (one, two)]
        for client, topics in ((one, INPUTS), (two, led_inputs)):
            client.await_speakers()
            client.await_listeners(*topics)
        rng, start = np.random.default_rng(0), one.now()
        for tick in range(60):
            stamp = start + nanoseconds(tick / 15)
            for topic, sample in box.samples(stamp):
                named = hasattr(sample, 'sensor')
                one.send(
                    topic, replace(sample, sensor=f'one_{sample.sensor}') if named else sample
                )
            for topic, sample in _led(stamp + 1_000_000, rng):
                two.send(topic, sample)
            one.until(lambda due=stamp: one.now() > due, 5.0)
            two.spin(0.001)
        assert one.until(lambda: len(heard[0]) >= 20), looking.log
        assert two.until(lambda: len(heard[1]) >= 20), led.log
    straight, moved = (poses[-1].T_map_body[:, :3, 3] for poses in heard)
    np.testing.assert_allclose(straight, box.T_map_ring[:, :3, 3], atol=0.01)
    np.testing.assert_allclose(moved, box.T_map_ring[:, :3, 3] + [0.0, 0.02, 0.0], atol=0.005)
    for node in (looking, led):
        assert node.stop(signal.SIGTERM) == 0 and 'no such sensor' not in node.log, node.log


def _led(stamp, rng):
    """Yield samples of a straight robot at rest, 2 cm beside where its description puts it."""
    for ring, s in (('root', 0.15), ('em', 0.3)):
        T = np.eye(4)
        T[:3, 3] = (s, 0.02, 0.0) + 1e-4 * rng.normal(size=3)
        yield f'tracker/{ring}', TrackedPose(stamp, ring, T, np.diag([1e-6] * 3 + [1e-4] * 3))
    for name in ('imu1', 'imu2'):
        rate = 1e-3 * rng.normal(size=3)
        yield 'imu/data_raw', ImuSample(stamp, name, rate, np.array([0.0, 0.0, 9.81]))
    yield 'imu/mag', FieldSample(stamp, 'hall1', 1e-4 + 1e-6 * rng.normal(size=3))


def test_publishers_that_cannot_be_heard_are_named_in_the_log(box, tmp_path):
    domain = fresh_domain()
    node = estimator(
        tmp_path, domain, robot=box.path, map=box.map, **{'intake.reliable_inputs': 'true'}
    )
    best_effort = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    with Client(domain) as client:
        client.publisher('tof/points', best_effort)
        assert wait_until(lambda: 'incompatible QoS' in node.log), node.log
    line = next(line for line in node.log.splitlines() if 'incompatible QoS' in line)
    assert 'tof/points' in line and 'RELIABILITY' in line
    assert node.stop() == 0
