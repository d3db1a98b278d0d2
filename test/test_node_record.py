"""
Simulator, recorder and replayer as processes.

What is published is in the bag, and comes back from it.
"""

from collections import Counter
import json
from pathlib import Path
import signal

from continuum_loc.measurements import TofFrame
from continuum_loc.robot import load_robot
from msg_tools.bag import open_bag, raw_messages, read_bag
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
