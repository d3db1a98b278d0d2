"""Bags: the whole contract is written and read back; damaged and foreign bags are named."""

import re

from continuum_loc import lie
from continuum_loc.errors import BagError, MessageError
from continuum_loc.measurements import (
    FieldSample,
    ImuSample,
    StrainSample,
    TofFrame,
    TrackedPose,
    TruthSample,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from msg_tools.bag import BagWriter, open_bag, read_bag, split_topic
from msg_tools.factory import typestore
from msg_tools.records import CloudRecord, PathRecord, PosesRecord
from msg_tools.topics import FAMILIES, topic_spec, TOPICS
import numpy as np
import pytest

SECOND = 10**9


def _tof(stamp):
    rays = np.tile([1.0, 0.0, 0.0], (64, 1))
    return TofFrame(stamp, 'tof1', rays, np.ones(64), np.full(64, 0.01), np.full(64, 5, np.uint8))


def _imu(stamp, name='imu1'):
    return ImuSample(stamp, name, np.array([0.1, 0.2, 0.3]), np.array([0.0, 0.0, 9.81]))


@pytest.fixture
def bag(tmp_path):
    path = tmp_path / 'bag'
    with BagWriter(path) as writer:
        for tick in range(1, 201):
            writer.write('imu/data_raw', _imu(tick * SECOND // 100))
            if tick % 10 == 0:
                writer.write('tof/points', _tof(tick * SECOND // 100))
    return path


def test_every_topic_of_the_contract_is_read_back_in_order_of_the_log(tmp_path):
    T = lie.exp(np.random.default_rng(0).normal(size=(3, 6)))
    cloud = CloudRecord(4, {name: np.arange(5.0) for name in ('x', 'y', 'z', 'sigma', 'anomaly')})
    items = [
        ('tof/points', _tof(1)),
        ('imu/data_raw', _imu(2)),
        ('imu/mag', FieldSample(3, 'hall1', np.ones(3))),
        ('reconstruction', cloud),
        ('prior_map', CloudRecord(5, cloud.fields)),
        ('strain', StrainSample(SECOND, np.array([0.1]), np.zeros(1), np.ones(1))),
        ('tracker/em1', TrackedPose(SECOND + 1, 'em1', T[0])),
        ('ground_truth/poses', TruthSample(SECOND + 2, T)),
        ('poses', PosesRecord(SECOND + 3, T)),
        ('backbone', PathRecord(SECOND + 4, T)),
    ]
    with BagWriter(tmp_path / 'b') as writer:
        for topic, item in reversed(items):
            writer.write(topic, item)
    back = list(read_bag(tmp_path / 'b'))
    assert [topic for topic, _ in back] == [topic for topic, _ in items]
    assert [item.stamp for _, item in back] == sorted(item.stamp for _, item in items)
    assert [type(item) for _, item in back] == [type(item) for _, item in items]
    np.testing.assert_allclose(dict(back)['ground_truth/poses'].T_map_ring, T, atol=1e-12)


def test_the_same_samples_give_the_same_file(tmp_path):
    for name in ('a', 'b'):  # the file holds its own name, so the folder is called the same
        (tmp_path / name).mkdir()
        with BagWriter(tmp_path / name / 'bag') as writer:
            writer.write('tof/points', _tof(5))
    first, second = (
        next((tmp_path / name / 'bag').glob('*.mcap')).read_bytes() for name in ('a', 'b')
    )
    assert first == second


def test_a_bag_logs_under_the_stamp_of_its_item_or_the_one_given(tmp_path):
    """What other programs see of the bag, to the nanosecond; the message keeps its own stamp."""
    late = 7 * SECOND + 123_456_789
    with BagWriter(tmp_path / 'b') as writer:
        writer.write('imu/data_raw', _imu(3 * SECOND + 1))
        writer.write('tof/points', _tof(4 * SECOND + 2))
        writer.write('imu/data_raw', _imu(5 * SECOND), stamp=late)
    with open_bag(tmp_path / 'b') as reader:
        logged = [stamp for _, stamp, _ in reader.messages()]
        span = reader.start_time, reader.end_time
    assert logged == [3 * SECOND + 1, 4 * SECOND + 2, late]
    assert span == (3 * SECOND + 1, late + 1)  # rosbags ends it after the last message
    assert [item.stamp for _, item in read_bag(tmp_path / 'b')][-1] == 5 * SECOND


def test_publishers_of_the_contract_are_recorded_with_explicit_qos(tmp_path):
    """`ros2 bag play` offers what the bag states: the map must come out latched again."""
    from rosbags.interfaces import QosDurability, QosReliability

    with BagWriter(tmp_path / 'b') as writer:
        writer.write('prior_map', CloudRecord(1, {name: np.zeros(2) for name in 'xyz'}))
        writer.write('imu/data_raw', _imu(1))
    with open_bag(tmp_path / 'b') as reader:
        qos = {c.topic: c.ext.offered_qos_profiles[0] for c in reader.connections}
    assert qos['/prior_map'].durability == QosDurability.TRANSIENT_LOCAL
    assert qos['/imu/data_raw'].durability == QosDurability.VOLATILE
    assert all(q.reliability == QosReliability.RELIABLE for q in qos.values())


def test_topics_can_be_chosen(bag):
    assert {topic for topic, _ in read_bag(bag, topics=('tof/points',))} == {'tof/points'}
    assert len(list(read_bag(bag))) == 220


def test_a_single_mcap_file_is_a_bag_too(bag):
    assert len(list(read_bag(next(bag.glob('*.mcap'))))) == 220


def test_robots_are_told_apart_by_namespace(tmp_path):
    with BagWriter(tmp_path / 'one', namespace='/arm1') as writer:
        writer.write('imu/data_raw', _imu(1))
    assert [topic for topic, _ in read_bag(tmp_path / 'one')] == ['imu/data_raw']
    from rosbags.rosbag2 import StoragePlugin, Writer

    with Writer(tmp_path / 'two', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for robot in ('arm1', 'arm2'):
            connection = writer.add_connection(
                f'/{robot}/imu/data_raw', 'sensor_msgs/msg/Imu', typestore=typestore()
            )
            message = TOPICS['imu/data_raw'].encode(_bag_messages(), _imu(1, robot))
            writer.write(connection, 1, typestore().serialize_cdr(message, 'sensor_msgs/msg/Imu'))
    with pytest.raises(BagError, match="'arm1', 'arm2'"):
        list(read_bag(tmp_path / 'two'))
    assert [item.sensor for _, item in read_bag(tmp_path / 'two', namespace='arm2')] == ['arm2']


@given(
    namespace=st.lists(st.from_regex(r'[a-z][a-z0-9_]{0,8}', fullmatch=True), max_size=3),
    topic=st.sampled_from(
        sorted(set(TOPICS) - {*FAMILIES, '/diagnostics'} | {'ring_pose/ring1', 'tracker/em1'})
    ),
)
@settings(max_examples=50, deadline=None)
def test_a_topic_splits_into_namespace_and_contract(namespace, topic):
    name = '/' + '/'.join([*namespace, topic])
    split = split_topic(name, topic_spec(topic).type)
    assert split is not None and split[1].endswith(topic.rpartition('/')[2])
    assert '/' + '/'.join(part for part in split if part) == name


def test_a_message_of_another_type_on_a_topic_of_the_contract_is_not_taken(tmp_path):
    assert split_topic('/imu/data_raw', 'std_msgs/msg/String') is None
    assert split_topic('/somewhere/else', 'sensor_msgs/msg/Imu') is None


def test_a_bad_message_is_named_or_handed_to_the_caller(tmp_path):
    with BagWriter(tmp_path / 'b') as writer:
        writer.write('imu/data_raw', _imu(1))
        writer.write_raw('imu/data_raw', b'\x00\x01\x00\x00\x01\x02', 2)
        writer.write('imu/data_raw', _imu(3))
    with pytest.raises(
        BagError, match='imu/data_raw: not a sensor_msgs/msg/Imu.*logged at 0.000000 s'
    ):
        list(read_bag(tmp_path / 'b'))
    errors: list[MessageError] = []
    kept = list(read_bag(tmp_path / 'b', on_error=lambda topic, error: errors.append(error)))
    assert [item.stamp for _, item in kept] == [1, 3]
    assert [error.kind for error in errors] == ['bytes']


def test_what_is_no_bag_is_named(tmp_path):
    (tmp_path / 'folder').mkdir()
    (tmp_path / 'text.mcap').write_text('not a bag')
    (tmp_path / 'notes.txt').write_text('not a bag')
    for name in ('absent', 'folder', 'text.mcap', 'notes.txt'):
        with pytest.raises(BagError, match=re.escape(str(tmp_path / name))):
            list(read_bag(tmp_path / name))


@pytest.mark.parametrize('share', [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_truncated_bag_is_named(bag, share):
    file = next(bag.glob('*.mcap'))
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    with pytest.raises(BagError, match='continuum-loc repair'):
        list(read_bag(bag))


@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_a_flipped_byte_gives_messages_or_a_named_error(damaged, data):
    path, original = damaged
    place = data.draw(st.integers(0, len(original) - 1))
    flipped = bytearray(original)
    flipped[place] ^= data.draw(st.integers(1, 255))
    path.write_bytes(flipped)
    try:
        list(read_bag(path, on_error=lambda topic, error: None))
    except BagError as error:
        assert str(path) in str(error)


@pytest.fixture(scope='module')
def damaged(tmp_path_factory):
    folder = tmp_path_factory.mktemp('damaged') / 'bag'
    with BagWriter(folder) as writer:
        for tick in range(1, 5):
            writer.write('imu/data_raw', _imu(tick))
    file = next(folder.glob('*.mcap'))
    return file, file.read_bytes()


def test_the_robot_without_a_namespace_is_chosen_by_a_slash_and_an_unknown_one_is_named(tmp_path):
    from rosbags.rosbag2 import StoragePlugin, Writer

    with Writer(tmp_path / 'b', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for root, robot in (('', 'plain'), ('/left/arm', 'left')):
            connection = writer.add_connection(
                f'{root}/imu/data_raw', 'sensor_msgs/msg/Imu', typestore=typestore()
            )
            message = TOPICS['imu/data_raw'].encode(_bag_messages(), _imu(1, robot))
            writer.write(connection, 1, typestore().serialize_cdr(message, 'sensor_msgs/msg/Imu'))
    for namespace, robot in (('/', 'plain'), ('left/arm', 'left'), ('/left/arm/', 'left')):
        found = [item.sensor for _, item in read_bag(tmp_path / 'b', namespace=namespace)]
        assert found == [robot]
    with pytest.raises(BagError, match="holds several robots; .* '/', 'left/arm'"):
        list(read_bag(tmp_path / 'b'))
    with pytest.raises(BagError, match="no robot 'right' in it; .* '/', 'left/arm'"):
        list(read_bag(tmp_path / 'b', namespace='right'))


def test_a_bag_is_not_overwritten_and_foreign_topics_are_not_written(bag):
    with pytest.raises(BagError, match='exists already'):
        BagWriter(bag)
    with (
        BagWriter(bag.parent / 'new') as writer,
        pytest.raises(MessageError, match="no topic 'nowhere'"),
    ):
        writer.write('nowhere', _imu(1))


def test_a_bag_without_our_topics_lists_what_is_in_it(tmp_path):
    from rosbags.rosbag2 import StoragePlugin, Writer

    with Writer(tmp_path / 'b', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        writer.add_connection('/chatter', 'std_msgs/msg/String', typestore=typestore())
    with pytest.raises(BagError, match='/chatter'):
        list(read_bag(tmp_path / 'b'))


def _bag_messages():
    from msg_tools.factory import bag_messages

    return bag_messages()
