"""
A replay passes the gate of the live node.

One fault in a recording is counted and named, the rest is used, and the estimate is the same to
the bit as without the fault.
"""

from collections import Counter
from dataclasses import replace
import time

from continuum_loc.errors import BagError, MessageError
from continuum_loc.estimator import settings_of, SlidingWindowFilter
from continuum_loc.intake import Intake, IntakeSettings, StampGate
from continuum_loc.measurements import (
    EncoderSample,
    ImuSample,
    nanoseconds,
    StrainSample,
    TofFrame,
    TrackedPose,
    TruthSample,
)
from continuum_loc.nodes.support.warm_up import rest_samples
from continuum_loc.offline.account import account_of
from continuum_loc.offline.replay import replay
from continuum_loc.offline.runs import summary_of
from continuum_loc.robot import load_robot
from msg_tools.bag import BagWriter
from msg_tools.factory import bag_messages, typestore
from msg_tools.mcap import records
from msg_tools.topics import topic_of, topic_spec
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from synthetic import NoisyFilter, samples, START

ROBOT = load_robot('engine')
SECOND = 10**9
LATER = START + SECOND  # where the faults are


@pytest.fixture(scope='module')
def recording():
    return list(samples(ROBOT, 2.0))


@pytest.fixture(scope='module')
def clean(recording, tmp_path_factory):
    return replay(written(tmp_path_factory.mktemp('clean') / 'bag', recording), NoisyFilter(ROBOT))


def written(path, items, extra=(), namespace=''):
    """Write samples as they come, and (topic, bytes or sample, log time) beside them."""
    with BagWriter(path, namespace) as bag:
        for sample in items:
            bag.write(topic_of(sample), sample)
        for topic, what, logged in extra:
            if isinstance(what, bytes):
                bag.write_raw(topic, what, logged)
            else:
                bag.write(topic, what, logged)
    return path


def imu(stamp, sensor='ring1_imu', rate=0.1):
    return ImuSample(stamp, sensor, np.full(3, rate), np.array([0.0, 0.0, 9.81]))


def tof(stamp, sensor='ring1_tof1', zones=64):
    points, ones = np.tile([1.0, 0.0, 0.0], (zones, 1)), np.ones(zones)
    return TofFrame(stamp, sensor, points, ones, ones, np.full(zones, 5, np.uint8))


def serialised(sample, change=lambda message: None):
    spec = topic_spec(topic_of(sample))
    message = spec.encode(bag_messages(), sample)
    change(message)
    return bytes(typestore().serialize_cdr(message, spec.type))


def with_status(value):
    """Make a frame whose driver wrote the status as a wider number, one of them `value`."""

    def change(message):
        array = np.zeros(64, [(n, '<f4') for n in ('x', 'y', 'z', 'range', 'sigma', 'status')])
        array['x'] = array['range'] = 1.0
        array['status'] = 5.0
        array['status'][7] = value
        for number, item in enumerate(message.fields):
            item.offset, item.datatype = 4 * number, 7
        message.data = np.frombuffer(array.tobytes(), np.uint8)

    return serialised(tof(LATER), change)


def huge(message):
    """Claim 4 GB in the header, as a wrong driver does; there are 1536 bytes."""
    message.height, message.width, message.row_step = 1, 2**31, 2**31 * 24 % 2**32


NAN = float('nan')
FAULTS = {  # topic, what, when it was logged; how it is refused, and what is said
    'undescribed sensor': (tof(LATER + 5, 'chin_tof'), 'unknown frame', "such sensor 'chin_tof'"),
    'NaN': (serialised(imu(LATER + 5, rate=NAN)), 'value', 'angular_velocity holds a value'),
    'another clock, ahead': (imu(LATER + 10**9 * SECOND), 'future stamp', 'clock 2.0000'),
    'another clock, behind': (imu(5), 'leap', 'stamp 0.000000 s refused as leap'),
    'no stamp': (imu(0), 'zero stamp', 'refused as zero stamp'),
    'twice the same': (imu(LATER - 10**7), 'duplicate', 'refused as duplicate'),
    'cut off': (serialised(imu(LATER + 5))[:-40], 'bytes', 'not a sensor_msgs/msg/Imu'),
    'random bytes': (bytes(range(256)), 'bytes', 'not a sensor_msgs/msg/Imu'),
    'no bytes': (b'', 'bytes', 'not a sensor_msgs/msg/Imu'),
    'too long': (bytes(1_000_001), 'size', 'a message of 1000001 bytes; valid: 1000000'),
    '16 zones': (tof(LATER + 5, zones=16), 'zones', '16 zones; the robot description says 64'),
    'a lying header': (serialised(tof(LATER + 5), huge), 'zones', '2147483648 zones'),
    'status 261': (with_status(261.0), 'value', "'status' holds 261.0; valid: whole numbers"),
    'status -1': (with_status(-1.0), 'value', "'status' holds -1.0"),
    'status 5.5': (with_status(5.5), 'value', "'status' holds 5.5"),
    'strain of NaN': (
        serialised(StrainSample(LATER, *np.array([[0.1], [0.0], [NAN]]))),
        'value',
        'data holds a value that is not finite',
    ),
    'strain stamped NaN': (
        serialised(
            StrainSample(LATER, np.array([0.1]), np.zeros(1), np.zeros(1)),
            lambda message: message.data.__setitem__(0, NAN),
        ),
        'value',
        'not finite',
    ),
    'strain stamped in ns': (
        serialised(
            StrainSample(LATER, np.array([0.1]), np.zeros(1), np.zeros(1)),
            lambda message: message.data.__setitem__(0, 1.7e18),
        ),
        'stamp',
        r'1.7e\+18 is not a stamp in seconds',
    ),
    'stations off the body': (
        StrainSample(LATER, np.array([0.1, 1.6]), np.zeros(2), np.zeros(2)),
        'value',
        'rise within 0 to 1.5 m, got 0.1 to 1.6',
    ),
    'travel of NaN': (
        EncoderSample(LATER, ('insertion',), np.array([NAN]), np.array([0.0])),
        'value',
        "joint 'insertion' is nan",
    ),
    'pose of NaN': (
        serialised(
            TrackedPose(LATER, 'ring1_imu', np.eye(4)),
            lambda message: setattr(message.pose.pose.position, 'x', NAN),
        ),
        'value',
        'pose holds a value',
    ),
    'truth of another robot': (
        TruthSample(LATER + 5, np.tile(np.eye(4), (4, 1, 1))),
        'size',
        'holds 4 poses',
    ),
}
TOPICS = {'strain of NaN': 'strain', 'pose of NaN': 'tracker/ring1_imu'}
TOPICS |= dict.fromkeys(('strain stamped NaN', 'strain stamped in ns'), 'strain')
TOPICS |= dict.fromkeys(('a lying header', 'status 261', 'status -1', 'status 5.5'), 'tof/points')


@pytest.mark.parametrize('fault', FAULTS)
def test_one_bad_message_is_counted_and_named_and_changes_nothing(
    fault, recording, clean, tmp_path
):
    what, kind, said = FAULTS[fault]
    bytes_alone = TOPICS.get(fault, 'imu/data_raw')
    topic = bytes_alone if isinstance(what, bytes) else topic_of(what)
    bag = written(tmp_path / 'bag', recording, [(topic, what, LATER + 5)])
    found = replay(bag, NoisyFilter(ROBOT))
    intake, before = found.counts['intake'], clean.counts['intake']
    assert intake['refused'] == {kind: 1}
    assert intake['refusals'][topic][kind]['count'] == 1
    with pytest.raises(MessageError, match=said):
        raise MessageError(kind, intake['refusals'][topic][kind]['first'])
    assert intake['used'] == before['used']
    assert sum(intake['received'].values()) == 1 + sum(before['received'].values())
    assert found.digest == clean.digest
    with pytest.raises(BagError, match=rf'bag: .*{said}.*logged at 2.000000 s'):
        replay(bag, NoisyFilter(ROBOT), strict=True)


def test_a_clean_bag_passes_whole_and_strictly(recording, clean, tmp_path):
    bag = written(tmp_path / 'bag', recording)
    strict = replay(bag, NoisyFilter(ROBOT), strict=True)
    assert strict.digest == clean.digest == replay(recording, NoisyFilter(ROBOT)).digest
    assert clean.counts['intake']['refused'] == {}
    assert clean.counts['intake']['used'] == {
        'ground_truth/poses': 200,
        'imu/data_raw': 200 * len(ROBOT.imu),
        'tof/points': 20 * len(ROBOT.tof),
    }
    # One zone in ten is without a target (see `synthetic.frame`).
    status = clean.counts['intake']['tof_status']
    assert set(status) == {'5', '255'} and sum(status.values()) == 20 * len(ROBOT.tof) * 64
    assert status['255'] / sum(status.values()) == pytest.approx(0.1, abs=0.01)


def test_inputs_of_another_type_are_named_and_the_rest_is_used(recording, clean, tmp_path):
    store = typestore()
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {}
        for sample in recording:
            topic = topic_of(sample)
            kind = topic_spec(topic).type
            if topic not in connections:
                connections[topic] = writer.add_connection(f'/{topic}', kind, typestore=store)
            message = topic_spec(topic).encode(bag_messages(), sample)
            writer.write(connections[topic], sample.stamp, store.serialize_cdr(message, kind))
        text = writer.add_connection('/strain', 'std_msgs/msg/String', typestore=store)
        for k in range(3):
            data = store.serialize_cdr(store.types['std_msgs/msg/String']('hm'), text.msgtype)
            writer.write(text, LATER + k, data)
    found = replay(tmp_path / 'bag', NoisyFilter(ROBOT))
    assert found.digest == clean.digest
    refusal = found.counts['intake']['refusals']['strain']['type']
    assert refusal['count'] == 3 and 'of type std_msgs/msg/String' in refusal['first']


def test_a_looped_recording_starts_anew_and_is_used_from_there(recording, tmp_path):
    """
    The log goes on while the stamps go back by two seconds.

    The second turn loses what has to agree on it: the first 50 ms, five ticks of each gyro and a
    frame of each ToF sensor.
    """
    turns = [
        (topic_of(sample), sample, sample.stamp + turn * 2 * SECOND)
        for turn in range(2)
        for sample in recording
    ]
    listener = Listener()
    found = replay(written(tmp_path / 'bag', [], turns), listener)
    sensed = sum(not isinstance(sample, TruthSample) for sample in recording)
    lost = 5 * len(ROBOT.imu) + len(ROBOT.tof)
    assert listener.resets == [sensed]
    assert len(listener.heard) == 2 * sensed - lost
    assert found.counts['intake']['refused'] == {'leap': lost}
    assert found.counts['intake']['restarts'] == 1
    assert found.data_seconds == pytest.approx(1.99 + 1.94)


@pytest.mark.parametrize('away', [-(10**7), 10**7, 10**9], ids=['past', 'future', 'far'])
def test_a_stamp_of_another_clock_that_also_wrote_the_log_is_left_out(away, recording, tmp_path):
    """
    From the future it comes last, and costs nothing but itself.

    From the past it comes first: then nobody knows better until the others agree for 50 ms.
    """
    shifted = [replace(sample, stamp=sample.stamp + 10**8 * SECOND) for sample in recording]
    stamp = shifted[0].stamp + away * SECOND
    listener = Listener()
    bag = written(tmp_path / 'bag', shifted, [('imu/data_raw', imu(stamp), stamp)])
    found = replay(bag, listener)
    sensed = sum(not isinstance(sample, TruthSample) for sample in shifted)
    lost = 5 * len(ROBOT.imu) + len(ROBOT.tof) if away < 0 else 1
    assert found.counts['intake']['refused'] == {'leap': lost}
    assert len(listener.heard) == 1 + sensed - lost
    assert listener.resets == ([1] if away < 0 else [])
    assert found.data_seconds == pytest.approx(1.99, abs=0.06)


@pytest.mark.parametrize('kind', [TofFrame, ImuSample])
def test_a_kind_of_sensor_on_a_clock_of_its_own_is_refused_and_does_not_take_turns(
    kind, recording, tmp_path
):
    """Sixteen frames at one instant are many that agree, and yet no new start at each cycle."""
    apart = [
        replace(sample, stamp=sample.stamp + 10**6 * SECOND)
        if isinstance(sample, kind)
        else sample
        for sample in recording
    ]
    turns = [
        (topic_of(sample), sample, 10**8 * SECOND + k * 10**6) for k, sample in enumerate(apart)
    ]
    listener = Listener()
    found = replay(written(tmp_path / 'bag', [], turns), listener)
    heard = Counter(type(sample) for sample in listener.heard)
    assert found.counts['intake']['restarts'] <= 1
    assert heard[ImuSample] >= 200 * len(ROBOT.imu) - 60 and heard[TofFrame] <= len(ROBOT.tof)
    assert found.counts['intake']['refused']['leap'] >= 19 * len(ROBOT.tof)


def test_a_slow_sensor_is_heard_again_after_a_pause():
    """Five samples a second: two seconds pass until ten agree, not for ever."""
    gate = StampGate(IntakeSettings())
    times = [0.2 * k for k in range(20)] + [10.0 + 0.2 * k for k in range(20)]
    verdicts = [gate.judge(START + nanoseconds(time), 'tracker', 0) for time in times]
    assert verdicts == [None] * 20 + ['leap'] * 9 + [None] * 11


def test_a_bag_that_is_damaged_further_on_is_used_up_to_there(tmp_path):
    longer = list(samples(ROBOT, 4.0))
    whole = replay(longer, NoisyFilter(ROBOT))
    bag = written(tmp_path / 'bag', longer)
    file = next(bag.glob('*.mcap'))
    with file.open('rb') as stream:
        chunks = [end for code, _, end, _ in records(stream) if code == 6]
    assert len(chunks) > 1
    data = bytearray(file.read_bytes())
    inside = slice(chunks[0] + 200, chunks[0] + 100_000)  # of what follows the first
    data[inside] = b'\xff' * 99_800
    file.write_bytes(data)
    found = replay(bag, NoisyFilter(ROBOT))
    used = found.counts['intake']['used']['imu/data_raw']
    assert 0 < used < 400 * len(ROBOT.imu)
    assert 'repair' in found.counts['intake']['refusals']['bag']['damaged']['first']
    account = account_of(ROBOT, None, found.counts, summary_of(found))
    assert any('damaged' in problem for problem in account['problems'])
    common = np.isin(whole.track.stamps, found.track.stamps)
    np.testing.assert_array_equal(whole.track.T_map_ring[common], found.track.T_map_ring)


class Listener(NoisyFilter):
    """Remembers what it was given, and when it was told to forget it."""

    def __init__(self):
        super().__init__(ROBOT)
        self.heard, self.resets = [], []

    def process(self, measurement):
        self.heard.append(measurement)
        return super().process(measurement)

    def reset(self):
        self.resets.append(len(self.heard))


def test_a_filter_that_fails_on_a_bag_starts_anew_and_says_so(recording, tmp_path):
    class Failing(Listener):
        def process(self, measurement):
            if len(self.heard) == 700:
                self.heard.append(measurement)
                raise np.linalg.LinAlgError('singular matrix')
            return super().process(measurement)

    bag = written(tmp_path / 'bag', recording)
    failing = Failing()
    intake = replay(bag, failing).counts['intake']
    assert (intake['failures'], failing.resets) == (1, [701])
    assert intake['refused'] == {'failure': 1}
    with pytest.raises(MessageError, match='LinAlgError: singular matrix'):
        replay(bag, Failing(), strict=True)
    # Samples of a study are right: there a failure is the filter's, and no result.
    with pytest.raises(np.linalg.LinAlgError):
        replay(recording, Failing())


def test_one_robot_of_several_is_chosen(recording, clean, tmp_path):
    """Two arms in one bag, the frames of one with a prefix."""
    store = typestore()
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {}
        for sample in recording:
            topic = topic_of(sample)
            kind = topic_spec(topic).type
            for arm, prefix in (('left', ''), ('right', 'right/')):
                name = getattr(sample, 'sensor', None)
                one = sample if name is None else replace(sample, sensor=prefix + name)
                if (arm, topic) not in connections:
                    connections[arm, topic] = writer.add_connection(
                        f'/{arm}/{topic}', kind, typestore=store
                    )
                data = store.serialize_cdr(topic_spec(topic).encode(bag_messages(), one), kind)
                writer.write(connections[arm, topic], sample.stamp, data)
    with pytest.raises(BagError, match="choose one by its namespace: 'left', 'right'"):
        replay(tmp_path / 'bag', NoisyFilter(ROBOT))
    left = replay(tmp_path / 'bag', NoisyFilter(ROBOT), namespace='left')
    right = replay(tmp_path / 'bag', NoisyFilter(ROBOT), namespace='right', frame_prefix='right/')
    assert left.digest == right.digest == clean.digest
    nobody = replay(tmp_path / 'bag', NoisyFilter(ROBOT), namespace='right')
    assert nobody.counts['intake']['refused'] == {
        'unknown frame': 200 * len(ROBOT.imu) + 20 * len(ROBOT.tof)
    }


def test_the_filter_itself_does_not_hang_however_far_the_stamps_leap(tmp_path):
    """A thousand million seconds on, and back: each is a new start, not 15 knots a second."""
    at_rest = list(rest_samples(ROBOT, 1.0, 1000 * SECOND))
    away = [replace(sample, stamp=sample.stamp + 10**9 * SECOND) for sample in at_rest]
    back = [replace(sample, stamp=sample.stamp + 2 * SECOND) for sample in at_rest]
    turns, logged = [], 3 * 10**9 * SECOND
    for sample in (*at_rest, *away, *back):
        logged += 10**6
        turns.append((topic_of(sample), sample, logged))
    estimator = SlidingWindowFilter(ROBOT, None, settings_of('engine'))
    replay(at_rest, estimator)  # what compiles does it here
    estimator.reset()
    begin = time.process_time()
    found = replay(written(tmp_path / 'bag', [], turns), estimator)
    assert time.process_time() - begin < 30.0
    assert found.counts['intake']['restarts'] == 2
    assert 18 <= found.counts['intake']['refused']['leap'] < 150
    assert len(found.track) > 0 and found.data_seconds < 3.5


def test_a_strict_gate_raises_the_first_and_another_tells_each_class_once():
    told = []
    gate = Intake(ROBOT, report=lambda kind, text: told.append(kind))
    strict = Intake(ROBOT, IntakeSettings(), strict=True)
    for stamp in (SECOND, SECOND, SECOND):
        gate.admit('imu/data_raw', imu(stamp), 0)
    assert told == ['duplicate'] and gate.refused == {'duplicate': 2}
    assert gate.counts()['refusals']['imu/data_raw']['duplicate']['count'] == 2
    strict.admit('imu/data_raw', imu(SECOND), 0)
    with pytest.raises(MessageError, match='duplicate'):
        strict.admit('imu/data_raw', imu(SECOND), 0)


def test_a_cloud_is_refused_by_its_header_before_its_bytes_are_touched():
    class Untouched:
        def __getattr__(self, name):
            raise AssertionError(f'{name} was read')

    class Cloud(Untouched):
        height, width = 1000, 1000

    gate = Intake(ROBOT)
    assert gate.accept('tof/points', Cloud(), 0) is None
    assert gate.refusals['tof/points', 'zones'] == (
        1,
        'tof/points: 1000000 zones; the robot description says 64',
    )
