"""
Simulator, recorder and replayer as processes.

What is published is in the bag, and comes back from it.
"""

from collections import Counter
import json
from pathlib import Path
import resource
import signal

from continuum_loc.measurements import StrainSample, TofFrame
from continuum_loc.offline.repair import repair
from continuum_loc.robot import load_robot
from msg_tools.bag import BagWriter, open_bag, raw_messages, read_bag
from node_graph import Client, fresh_domain, Process, wait_until
import numpy as np
import pytest
from rosgraph_msgs.msg import Clock

pytestmark = pytest.mark.timeout(300)
SENSORS = {'imu/data_raw', 'joint_states', 'ground_truth/poses'}


@pytest.fixture(scope='module')
def recorded(tmp_path_factory):
    """Two seconds of the engine robot in empty space and what the nodes say of it."""
    folder, domain = tmp_path_factory.mktemp('recorded'), fresh_domain()
    recorder = Process(
        'recorder',
        domain,
        folder,
        bag=folder / 'bag',
        reliable_inputs='true',
        summary_file=folder / 'recorder.json',
    )
    recorder.await_log('recording')
    simulator = Process(
        'simulator',
        domain,
        folder,
        scene='S0',
        duration=2,
        seed=5,
        wait_for=1,
        summary_file=folder / 'simulator.json',
    )
    assert simulator.wait() == 0, simulator.log
    published = json.loads((folder / 'simulator.json').read_text())['published']
    assert recorder.stop() == 0, recorder.log
    written = json.loads((folder / 'recorder.json').read_text())['written']
    return folder / 'bag', published, written


def test_everything_that_was_published_is_in_the_bag(recorded):
    bag, published, written = recorded
    robot = load_robot('engine')
    assert published == {
        'tof/points': 30 * len(robot.tof),
        'imu/data_raw': 200 * len(robot.imu),
        'strain': 40,
        'joint_states': 100,
        'ground_truth/poses': 200,
    }
    assert {topic: count for topic, count in written.items() if topic in published} == published
    in_bag = Counter(topic for topic, _ in read_bag(bag))
    assert {topic: in_bag[topic] for topic in published} == published


def test_stamps_are_the_clock_at_the_sensors_own_rates(recorded):
    bag, _, _ = recorded
    with open_bag(bag) as reader:
        begin, end = reader.start_time, reader.end_time
    stamps = [
        item.stamp
        for _, item in read_bag(bag, topics=('imu/data_raw',))
        if item.sensor == 'ring1_imu'
    ]
    assert begin - 10**9 < min(stamps) and max(stamps) <= end
    np.testing.assert_array_equal(np.diff(stamps), 10**7)
    frames = {}
    for _, frame in read_bag(bag, topics=('tof/points',)):
        assert isinstance(frame, TofFrame)
        frames.setdefault(frame.stamp, set()).add(frame.sensor)
    assert all(len(sensors) == 16 for sensors in frames.values()) and len(frames) == 30


def test_a_bag_comes_back_as_it_is_with_its_clock(recorded, tmp_path):
    bag, published, _ = recorded
    domain = fresh_domain()
    recorder = Process(
        'recorder', domain, tmp_path, bag=tmp_path / 'again', reliable_inputs='true'
    )
    recorder.await_log('recording')
    ticks: list[int] = []
    with Client(domain) as client:
        client.node.create_subscription(
            Clock,
            '/clock',
            lambda message: ticks.append(message.clock.sec * 10**9 + message.clock.nanosec),
            1000,
        )
        replayer = Process('replayer', domain, tmp_path, bag=bag, wait_for=1, rate=2.0)
        assert client.until(lambda: replayer.popen.poll() is not None)
        assert replayer.wait() == 0, replayer.log
        client.until(lambda: False, patience=0.5)
    assert recorder.stop() == 0, recorder.log
    first, second = (
        {topic: [data for t, _, data in raw_messages(path, (topic,))] for topic in published}
        for path in (bag, tmp_path / 'again')
    )
    for topic in published:
        assert sorted(first[topic]) == sorted(second[topic]), topic
    assert len(ticks) > 100 and (np.diff(ticks) >= 0).all()


def test_a_recorder_that_is_terminated_leaves_a_bag_that_can_be_read(tmp_path):
    domain = fresh_domain()
    recorder = Process('recorder', domain, tmp_path, bag=tmp_path / 'bag')
    recorder.await_log('recording')
    simulator = Process('simulator', domain, tmp_path, scene='none', duration=30, wait_for=1)
    simulator.await_log('data begins')
    with Client(domain) as client:
        heard = client.hear('imu/data_raw')
        assert client.until(lambda: len(heard) > 50), simulator.log
    assert recorder.stop(signal.SIGTERM) == 0, recorder.log
    assert simulator.stop(signal.SIGTERM) == 0, simulator.log
    assert 'Traceback' not in recorder.log + simulator.log
    assert sum(1 for _ in read_bag(tmp_path / 'bag')) > 0


def test_a_recorder_that_is_killed_leaves_all_but_the_last_seconds(tmp_path):
    """It had no time to write anything; what it had flushed is repaired."""
    domain = fresh_domain()
    recorder = Process('recorder', domain, tmp_path, bag=tmp_path / 'bag')
    recorder.await_log('recording')
    simulator = Process('simulator', domain, tmp_path, scene='none', duration=30, wait_for=1)
    simulator.await_log('data begins')
    with Client(domain) as client:
        heard = client.hear('imu/data_raw')
        assert client.until(lambda: heard and heard[-1].stamp - heard[0].stamp > 6e9)
        recorder.popen.kill()
        recorder.popen.wait()
        killed = heard[-1].stamp
    simulator.stop()
    assert not (tmp_path / 'bag' / 'metadata.yaml').exists()
    saved = repair(tmp_path / 'bag', tmp_path / 'saved')
    stamps = [item.stamp for _, item in read_bag(tmp_path / 'saved', topics=('imu/data_raw',))]
    assert saved.saved['/imu/data_raw'] == len(stamps) > 500
    assert killed - max(stamps) < 4e9  # a second, and what a busy machine takes to come to it


def test_on_a_full_disk_the_recorder_ends_with_an_error_and_a_bag(tmp_path):
    """A limit on the size of its files stands for the full disk."""
    domain = fresh_domain()
    recorder = Process(
        'recorder',
        domain,
        tmp_path,
        bag=tmp_path / 'bag',
        summary_file=tmp_path / 'recorder.json',
    )
    recorder.await_log('recording')
    resource.prlimit(recorder.popen.pid, resource.RLIMIT_FSIZE, (400_000, 400_000))
    simulator = Process('simulator', domain, tmp_path, scene='none', duration=60, wait_for=1)
    assert wait_until(lambda: recorder.popen.poll() is not None)
    simulator.stop()
    assert recorder.popen.returncode == 2 and 'Traceback' not in recorder.log, recorder.log
    assert 'bag: cannot be written (File too large)' in recorder.log
    written = json.loads((tmp_path / 'recorder.json').read_text())['written']
    assert Counter(topic for topic, _ in read_bag(tmp_path / 'bag')) == written
    assert written['imu/data_raw'] > 100
    assert f'holds {sum(written.values())} messages' in recorder.log


def test_messages_that_are_too_long_are_dropped_and_counted(tmp_path):
    domain = fresh_domain()
    recorder = Process(
        'recorder',
        domain,
        tmp_path,
        bag=tmp_path / 'bag',
        largest_message=2000,
        reliable_inputs='true',
        summary_file=tmp_path / 'recorder.json',
    )
    recorder.await_log('recording')
    short = StrainSample(10**9, np.array([0.1]), np.zeros(1), np.zeros(1))
    long = StrainSample(10**9, np.linspace(0.0, 1.0, 500), np.zeros(500), np.zeros(500))
    with Client(domain) as client:
        client.publisher('strain')
        client.await_listeners('strain')
        for sample in (short, long, short, long, long):
            client.send('strain', sample)
        client.until(lambda: 'are dropped' in recorder.log, patience=5.0)
        client.until(lambda: False, patience=0.5)
    assert recorder.stop() == 0, recorder.log
    counts = json.loads((tmp_path / 'recorder.json').read_text())
    assert (counts['written'], counts['dropped']) == ({'strain': 2}, {'strain': 3})
    assert recorder.log.count('messages of more than 2000 bytes') == 1


def test_a_log_that_leaps_far_is_played_without_the_wait(tmp_path):
    """One message was logged by another clock, eleven days later."""
    with BagWriter(tmp_path / 'bag') as bag:
        for k in (1, 2, 3, 10**8):
            sample = StrainSample(k * 10**7, np.array([0.1]), np.zeros(1), np.zeros(1))
            bag.write('strain', sample)
    domain = fresh_domain()
    ticks: list[int] = []
    with Client(domain) as client:
        heard = client.hear('strain')
        client.node.create_subscription(
            Clock, '/clock', lambda message: ticks.append(message.clock.sec), 1000
        )
        replayer = Process('replayer', domain, tmp_path, bag=tmp_path / 'bag', wait_for=1)
        assert client.until(lambda: replayer.popen.poll() is not None), replayer.log
        assert client.until(lambda: len(heard) == 4, patience=5.0)
    assert replayer.wait() == 0 and ticks[-1] == 10**6 and len(ticks) < 50


def test_bad_input_ends_in_one_clear_line(recorded, tmp_path):
    bag = recorded[0]
    cases = (
        ('simulator', {'scene': 'S99'}, 'S99'),
        ('simulator', {'scene': ''}, 'parameter override'),
        ('simulator', {'trajectory': 't99'}, 't99'),
        ('replayer', {'bag': tmp_path / 'absent'}, 'absent'),
        ('recorder', {'bag': bag}, 'exists already'),
        ('replayer', {'bag': bag, 'topics': '[nowhere]'}, "no topic 'nowhere'"),
    )
    nodes = [
        Process(node, fresh_domain(), tmp_path, **parameters) for node, parameters, _ in cases
    ]
    for node, (_, _, text) in zip(nodes, cases, strict=True):
        assert wait_until(lambda node=node: node.popen.poll() is not None)
        assert node.popen.returncode == 2 and text in node.log and 'Traceback' not in node.log, (
            node.log
        )
    assert Path(bag).is_dir()
