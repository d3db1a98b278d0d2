"""
Between messages and the estimator.

The queue's order of sacrifice, rules for stamps, and 10,000 bad messages.
"""

from collections import Counter
from dataclasses import fields, replace
import threading
import time

from continuum_loc.estimator import settings_of, SlidingWindowFilter
from continuum_loc.intake import Intake, StampGate
from continuum_loc.measurements import (
    EncoderSample,
    ImuSample,
    nanoseconds,
    StrainSample,
    TofFrame,
    TrackedPose,
)
from continuum_loc.nodes.support.inbox import Early, Inbox, SACRIFICE
from continuum_loc.nodes.support.pacing import Paced
from continuum_loc.nodes.support.settings import IntakeSettings
from continuum_loc.nodes.support.warm_up import rest_samples
from continuum_loc.robot import load_robot
from msg_tools.factory import bag_messages, deserialize, typestore
from msg_tools.topics import topic_spec
import numpy as np
import pytest

SECOND = 10**9
START = 1000 * SECOND


# ---------------------------------------------------------------- the queue


def test_topics_torn_apart_by_a_backlog_are_merged_again_by_stamp():
    """
    Reception empties one topic after the other.

    What leaves is in the order of the stamps, unless one lies.
    """
    samples = [
        (_topic(sample), sample) for sample in rest_samples(load_robot('engine'), 1.0, START)
    ]
    inbox = Inbox(IntakeSettings())
    for topic in SACRIFICE:
        for name, sample in samples:
            if name == topic:
                inbox.put(
                    topic, topic_spec(topic).encode(bag_messages(), sample), START + 2 * SECOND
                )
    lying = topic_spec('strain').encode(
        bag_messages(), StrainSample(START + 10**6 * SECOND, *np.ones((3, 1)))
    )
    inbox.put('strain', lying, START + 2 * SECOND)
    left = list(iter(lambda: inbox.take(0.0), None))
    stamps = [
        topic_spec(item.topic).decode(item.message, 1, item.topic).stamp for item in left[:-1]
    ]
    assert len(left) == len(samples) + 1 and left[-1].message is lying
    assert (np.diff(stamps) >= -1000).all()  # strain's stamp is a float of seconds


def test_topics_are_merged_by_stamp_while_a_simulated_clock_stands():
    """All of them arrive at one time then, and one topic after the other."""
    inbox, tick = Inbox(IntakeSettings()), SECOND // 50
    for sensor in ('ring1_imu', 'ring2_imu'):
        for number in range(20):
            topic = 'imu/data_raw' if sensor == 'ring1_imu' else 'joint_states'
            inbox.put(topic, _imu(START + number * tick, sensor), START)
    left = list(iter(lambda: inbox.take(0.0), None))
    assert [one.stamp for one in left] == sorted(one.stamp for one in left)
    assert len({one.stamp for one in left}) == 20


def test_messages_leave_in_the_order_of_arrival_across_topics():
    inbox = Inbox(IntakeSettings())
    sent = [
        (topic, number)
        for number, topic in enumerate(['imu/data_raw', 'tof/points', 'strain'] * 20)
    ]
    for topic, number in sent:
        inbox.put(topic, number, 0)
    got = [inbox.take(0.0) for _ in sent]
    assert [(item.topic, item.message) for item in got] == sent
    assert inbox.take(0.0) is None and len(inbox) == 0


def test_an_overloaded_queue_gives_up_in_its_defined_order():
    """
    Fill with equal numbers of everything.

    As capacity shrinks, kinds go one after the other, oldest first.
    """
    inbox = Inbox(IntakeSettings(queue_capacity=10_000, max_backlog=1e9))
    for number in range(100):
        for kind in SACRIFICE:
            inbox.put('tracker/em1' if kind == 'tracker/' else kind, number, 0)
    kinds = 100 * len(SACRIFICE)
    for capacity in range(kinds - 50, 100, -100):
        inbox.settings = IntakeSettings(queue_capacity=capacity, max_backlog=1e9)
        inbox.put('imu/data_raw', 100, 0)
        for index, kind in enumerate(SACRIFICE[:-1]):
            given_up = kinds + inbox.received['imu/data_raw'] - 100 - capacity - 100 * index
            assert inbox.dropped[kind] == np.clip(given_up, 0, 100), (capacity, kind)
    oldest = inbox.take(0.0)
    assert oldest.topic == 'imu/data_raw'


def test_the_queue_is_limited_in_bytes_as_well_as_in_messages():
    """Ten messages of 30 kB are more than 100 kB: ToF frames go first, oldest first."""
    inbox = Inbox(IntakeSettings(queue_bytes=100_000, max_backlog=1e9))
    for number in range(5):
        inbox.put('tof/points', number, 0, 30_000)
        inbox.put('imu/data_raw', number, 0, 10_000)
    left = list(iter(lambda: inbox.take(0.0), None))
    assert [one.message for one in left if one.topic == 'imu/data_raw'] == list(range(5))
    assert [one.message for one in left if one.topic == 'tof/points'] == [4]
    assert inbox.dropped == {'tof/points': 4}
    inbox.put('tof/points', 9, 0, 90_000)  # what was taken leaves room
    assert inbox.take(0.0).message == 9 and inbox.dropped == {'tof/points': 4}


def test_what_waits_for_a_simulated_clock_is_limited_in_bytes():
    early, queue = Early(patience=60.0, most=100_000), Inbox(IntakeSettings())
    for number in range(5):
        queue.put('imu/data_raw', _imu(START + (60 + number) * SECOND), START, 30_000)
    free = early.timely(list(iter(lambda: queue.take(0.0), None)), START, 0.5)
    assert [one.stamp for one in free] == [START + 60 * SECOND, START + 61 * SECOND]
    assert len(early) == 3


def test_bytes_are_parsed_only_where_they_may_be_a_message():
    def never(data, kind):
        raise AssertionError('parsed')

    told = []
    intake = Intake(
        load_robot('engine'),
        IntakeSettings(largest_message=2000),
        lambda kind, text: told.append(text),
    )
    data = bytes(typestore().serialize_cdr(_imu(START), 'sensor_msgs/msg/Imu'))
    assert intake.parse('imu/data_raw', bytes(2001), never) is None
    assert intake.parse('imu/data_raw', data[:-20], deserialize) is None
    assert intake.parse('imu/data_raw', data, deserialize).header.frame_id == 'ring1_imu'
    assert intake.refused == {'size': 1, 'bytes': 1}
    assert told[0] == 'imu/data_raw: a message of 2001 bytes; valid: 2000'


def test_old_tof_frames_are_dropped_and_counted_while_all_else_is_kept():
    inbox = Inbox(IntakeSettings(max_backlog=0.05))
    for number in range(10):
        inbox.put('tof/points', number, 0)
        inbox.put('imu/data_raw', number, 0)
        time.sleep(0.02)
    kept = list(iter(lambda: inbox.take(0.0), None))
    frames = [item.message for item in kept if item.topic == 'tof/points']
    assert frames == list(range(10 - len(frames), 10)) and 1 <= len(frames) <= 4
    assert inbox.dropped == {'tof/points': 10 - len(frames)}
    assert [item.message for item in kept if item.topic == 'imu/data_raw'] == list(range(10))


def test_messages_that_overtake_a_simulated_clock_wait_for_it():
    """As a player's do at twice the speed: none is refused, none that is due waits behind them."""
    early, queue = Early(patience=60.0), Inbox(IntakeSettings())
    tick, tolerance = SECOND // 4, 0.2
    for number in (4, 3, 2, 1, 0, -1):
        queue.put('imu/data_raw', _imu(START + number * tick), START)
    left = early.timely(list(iter(lambda: queue.take(0.0), None)), START, tolerance)
    assert [one.stamp for one in left] == [START, START - tick] and len(early) == 4
    assert early.timely([], START + tick // 10, tolerance) == []
    left = early.timely([], START + 3 * tick, tolerance)
    assert [one.stamp for one in left] == [START + number * tick for number in (1, 2, 3)]
    intake = Intake(load_robot('engine'), IntakeSettings(), lambda kind, text: None)
    assert all(intake.accept(one.topic, one.message, one.arrival) for one in left)


def test_a_message_that_the_clock_never_comes_to_is_judged_in_the_end():
    early, queue = Early(patience=0.05), Inbox(IntakeSettings())
    for sensor in ('ring1_imu', 'ring2_imu'):
        queue.put('imu/data_raw', _imu(START + 60 * SECOND, sensor), START)
    assert early.timely([queue.take(0.0), queue.take(0.0)], START, 0.5) == []
    time.sleep(0.06)
    left = early.timely([], START + SECOND, 0.5)
    assert [one.arrival for one in left] == [START + SECOND] * 2 and len(early) == 0
    intake = Intake(load_robot('engine'), IntakeSettings(), lambda kind, text: None)
    assert not any(intake.accept(one.topic, one.message, one.arrival) for one in left)
    assert intake.refused == {'future stamp': 2}
    assert early.timely([], START + 90 * SECOND, 0.5) == []


def test_a_clock_that_jumps_back_or_has_not_begun_holds_nothing_up():
    early, queue = Early(patience=60.0), Inbox(IntakeSettings())
    for arrival in (START, 0):
        queue.put('imu/data_raw', _imu(START), arrival)
    sent = [queue.take(0.0), queue.take(0.0)]
    assert len(early.timely(sent, START - 60 * SECOND, 0.5)) == 2 and len(early) == 0


def _imu(stamp, sensor='ring1_imu'):
    sample = ImuSample(stamp, sensor, np.zeros(3), np.array([0.0, 0.0, 9.81]))
    return topic_spec('imu/data_raw').encode(bag_messages(), sample)


def test_nothing_is_lost_between_two_threads():
    inbox = Inbox(IntakeSettings(queue_capacity=10**6, max_backlog=1e9))
    got: list[int] = []

    def work():
        while len(got) < 20_000:
            item = inbox.take(1.0)
            if item is not None:
                got.append(item.message)

    worker = threading.Thread(target=work)
    worker.start()
    for number in range(20_000):
        inbox.put('imu/data_raw', number, 0)
    worker.join(60.0)
    assert got == list(range(20_000))


# ---------------------------------------------------------------- stamps


def test_zero_future_and_doubled_stamps_are_told_apart():
    gate = StampGate(IntakeSettings())
    now = START + SECOND
    assert gate.judge(0, 'a', now) == 'zero stamp'
    assert gate.judge(now + 2 * SECOND, 'a', now) == 'future stamp'
    # A simulated clock that has not begun judges nobody.
    assert gate.judge(now + 2 * SECOND, 'a', 0) is None
    gate.reset()
    assert gate.judge(START, 'a', now) is None
    assert gate.judge(START, 'a', now) == 'duplicate'
    assert gate.judge(START, 'b', now) is None
    # Late, but within what the window may use.
    assert gate.judge(START - SECOND // 10, 'b', now) is None


@pytest.mark.parametrize(
    ('leap', 'restarts'),
    [(-100 * SECOND, 1), (+2 * SECOND, 0), (+100 * SECOND, 1), (+(10**9) * SECOND, 1)],
    ids=['backward', 'gap', 'pause', 'another clock'],
)
def test_a_leap_is_believed_only_when_several_agree(leap, restarts):
    """A motion prior bridges two seconds; over more the data starts anew, however far it is."""
    gate = StampGate(IntakeSettings(jump_confirmations=10))
    assert gate.judge(START, 'a', 0) is None
    verdicts = [gate.judge(START + leap + k * SECOND // 100, 'a', 0) for k in range(12)]
    assert verdicts == ['leap'] * 9 + [None] * 3
    assert gate.restarts == restarts


def test_topics_torn_apart_by_a_pause_are_late_and_no_new_start():
    """After 3 s without reception, one sensor's samples all come before the other's."""
    gate = StampGate(IntakeSettings())
    stamps = [START + k * SECOND // 100 for k in range(300)]
    assert {gate.judge(START - 1, sensor, 0) for sensor in ('a', 'b')} == {None}
    for sensor in ('a', 'b'):
        assert [gate.judge(stamp, sensor, 0) for stamp in stamps] == [None] * 300
    assert gate.restarts == 0 and gate.newest == stamps[-1]


def test_lone_wild_stamps_never_move_the_clock():
    gate = StampGate(IntakeSettings())
    rng = np.random.default_rng(0)
    accepted = 0
    for k in range(2000):
        if k % 3 == 0:
            # The very first has to be believed.
            gate.judge(int(rng.integers(1, 10**6) * SECOND), 'a', 0)
        else:
            accepted += gate.judge(START + k * SECOND // 100, 'a', 0) is None
    assert accepted >= 1300 and gate.restarts == 1
    assert abs(gate.newest - (START + 1999 * SECOND // 100)) < SECOND


# ----------------------------------------------------------- 10,000 messages of which most are bad


def _bad(rng, kind, topic, item):
    """Spoil a message of `item` in one way, or make raw bytes of it."""
    make = bag_messages()
    spec = topic_spec(topic)
    if kind in ('zero stamp', 'future stamp', 'wild stamp', 'unknown frame'):
        changes = {
            'zero stamp': {'stamp': 0},
            'future stamp': {'stamp': item.stamp + 10**12},
            'wild stamp': {'stamp': item.stamp - int(rng.integers(1, 900)) * SECOND},
            'unknown frame': {'sensor': f'stranger{rng.integers(5)}'},
        }[kind]
        return spec.encode(make, replace(item, **changes))
    message = spec.encode(make, item)
    if kind == 'nan':
        _spoil(message, topic)
    if kind == 'size':
        _shorten(message, topic)
    if kind == 'zones':
        message.height, message.width = 4, 4
        message.row_step, message.data = 4 * message.point_step, message.data[: 16 * 24]
    if kind == 'fields':
        message.fields[int(rng.integers(3))].name = 'w'
    if kind == 'type':
        message.fields[0].datatype = int(rng.integers(9, 255))
    if kind == 'endianness':
        message.is_bigendian = True
    if kind == 'empty':
        _emptied(message, topic)
    return message


def _spoil(message, topic):
    if topic == 'tof/points':
        data = message.data.copy()
        data.view('<f4').reshape(-1, 6)[:, :4] = np.nan
        message.data = data
    elif topic == 'imu/data_raw':
        message.angular_velocity.x = np.nan
    elif topic == 'joint_states':
        message.position = np.full_like(message.position, np.nan)
    else:
        message.data = np.full_like(message.data, np.nan)


def _shorten(message, topic):
    if topic == 'tof/points':
        message.data = message.data[:-5]
    elif topic == 'strain':
        message.data = message.data[:-1]
    else:
        message.position = message.position[:-1] if len(message.position) > 1 else np.zeros(3)


def _emptied(message, topic):
    if topic == 'tof/points':
        message.width, message.data = 0, message.data[:0]
    elif topic == 'strain':
        message.data = message.data[:0]
    else:
        message.name, message.position, message.effort = [], np.empty(0), np.empty(0)


# Class of spoiled messages -> topics, and what the intake calls it (None: a valid message).
CLASSES = {
    'zero stamp': (('tof/points', 'imu/data_raw', 'joint_states'), {'zero stamp'}),
    'future stamp': (('tof/points', 'imu/data_raw', 'joint_states'), {'future stamp'}),
    'unknown frame': (('tof/points', 'imu/data_raw'), {'unknown frame'}),
    'wild stamp': (('tof/points', 'imu/data_raw', 'joint_states'), {'leap'}),
    'duplicate': (('tof/points', 'imu/data_raw', 'joint_states'), {'duplicate'}),
    'size': (('tof/points', 'strain', 'joint_states'), {'size'}),
    'zones': (('tof/points',), {'zones'}),
    'fields': (('tof/points',), {'fields'}),
    'type': (('tof/points',), {'type'}),
    'endianness': (('tof/points',), {'range', 'value'}),
    'nan': (('imu/data_raw', 'strain', 'joint_states'), {'value'}),
    'empty': (('tof/points', 'strain', 'joint_states'), {'empty', 'size'}),
    'bytes': (('tof/points', 'imu/data_raw', 'strain', 'joint_states'), {'bytes'}),
}


def test_ten_thousand_bad_messages_are_refused_by_class_and_leave_the_estimates_unharmed():
    """
    Each bad message is refused under its class, each class reported once, estimates unchanged.

    The good messages arrive out of order by up to a dozen places; what of them gets through is the
    same to the last bit with and without 10,000 bad ones between them, and so is every estimate.
    """
    rng = np.random.default_rng(7)
    robot = load_robot('engine')
    good = _jumbled([(_topic(sample), sample) for sample in rest_samples(robot, 4.5, START)], rng)
    reports: list[tuple[str, str]] = []
    intake = Intake(robot, IntakeSettings(), lambda kind, text: reports.append((kind, text)))
    alone = Intake(robot, IntakeSettings(), lambda kind, text: None)
    by_topic = {topic: [sample for t, sample in good if t == topic] for topic, _ in good}
    expected: Counter[str] = Counter()
    through, without = [], []
    for topic, sample in good:
        now = sample.stamp + nanoseconds(0.1)
        message = topic_spec(topic).encode(bag_messages(), sample)
        without.append(alone.accept(topic, message, now))
        through.append(intake.accept(topic, message, now))
        for _ in range(3):
            kind = list(CLASSES)[rng.integers(len(CLASSES))]
            topics, names = CLASSES[kind]
            bad_topic = topics[rng.integers(len(topics))]
            victim = _latest(by_topic[bad_topic], sample.stamp)
            if victim is None:
                continue
            before = Counter(intake.refused)
            assert _offer(intake, rng, kind, bad_topic, victim, now) is None, (kind, bad_topic)
            assert set(intake.refused - before) <= names, (
                kind,
                bad_topic,
                intake.refused - before,
            )
            expected[kind] += 1
    assert sum(expected.values()) >= 10_000 and set(expected) == set(CLASSES)
    assert sum(intake.refused.values()) == sum(expected.values())
    kinds = [kind for kind, _ in reports]
    assert sorted(kinds) == sorted(set(kinds)) == sorted(intake.refused)
    assert all(_same(a, b) for a, b in zip(through, without, strict=True)) and None not in through
    some, same = _estimates(robot, through[:1100]), _estimates(robot, without[:1100])
    assert len(some) >= 10
    for one, other in zip(some, same, strict=True):
        np.testing.assert_array_equal(one.T_map_ring, other.T_map_ring)
        np.testing.assert_array_equal(one.covariance, other.covariance)


def _jumbled(items, rng, reach=12):
    """Move each item by less than `reach` places."""
    order = np.argsort(np.arange(len(items)) + rng.uniform(0, reach, len(items)), kind='stable')
    return [items[k] for k in order]


def _estimates(robot, measurements):
    made = map(SlidingWindowFilter(robot, None, settings_of(robot.name)).process, measurements)
    return [estimate for estimate in made if estimate is not None]


def _offer(intake, rng, kind, topic, victim, now):
    if kind == 'duplicate':
        return intake.accept(topic, topic_spec(topic).encode(bag_messages(), victim), now)
    if kind != 'bytes':
        return intake.accept(topic, _bad(rng, kind, topic, victim), now)
    from continuum_loc.errors import MessageError

    spec = topic_spec(topic)
    data = bytes(typestore().serialize_cdr(spec.encode(bag_messages(), victim), spec.type))
    try:
        deserialize(data[: int(rng.integers(5, max(len(data) // 2, 6)))], spec.type)
    except Exception as error:  # on a graph the middleware refuses such bytes before we see them
        intake.refuse('bytes', str(MessageError('bytes', f'{topic}: {error}')))
        return None
    raise AssertionError('half a message was taken for a whole one')


def _topic(sample):
    return {
        TofFrame: 'tof/points',
        ImuSample: 'imu/data_raw',
        StrainSample: 'strain',
        EncoderSample: 'joint_states',
        TrackedPose: 'tracker/em1',
    }[type(sample)]


def _latest(samples, stamp):
    """One that arrived a little while ago, however the order was jumbled."""
    earlier = [s for s in samples if stamp - SECOND // 5 < s.stamp < stamp - SECOND // 10]
    return earlier[0] if earlier else None


def _same(a, b):
    """Equal to the last bit."""
    names = [field.name for field in fields(a)]
    return type(a) is type(b) and all(
        np.array_equal(
            getattr(a, n), getattr(b, n), equal_nan=isinstance(getattr(a, n), np.ndarray)
        )
        for n in names
    )


# ---------------------------------------------------------------- pacing


def test_items_come_when_they_are_due_and_in_order():
    stamps = [k * SECOND // 100 for k in range(1, 51)]
    came: list[tuple[int, float]] = []
    paced = Paced(((stamp, None) for stamp in stamps), lookahead=0.05)
    begin: list[float] = []
    paced.run(
        lambda stamp, item, delay: came.append((stamp, time.monotonic())),
        lambda first: begin.append(time.monotonic()),
    )
    assert [stamp for stamp, _ in came] == stamps
    early = [at - begin[0] - 0.05 - (stamp - stamps[0]) / SECOND for stamp, at in came]
    assert min(early) > -0.001  # never before its time; how late is a matter of the machine's load


def test_the_preparation_runs_no_farther_ahead_than_told():
    prepared: list[int] = []

    def items():
        for k in range(40):
            prepared.append(k)
            yield k * SECOND // 50 + 1, k

    ahead: list[int] = []
    paced = Paced(items(), lookahead=0.1)
    paced.run(lambda stamp, item, delay: ahead.append(len(prepared) - item))
    assert max(ahead) <= 0.1 * 50 + 3


def test_an_error_in_the_preparation_reaches_the_one_who_delivers():
    def items():
        yield 1, None
        raise RuntimeError('diverged')

    with pytest.raises(RuntimeError, match='diverged'):
        Paced(items(), 0.0).run(lambda *_: None)


def test_stop_ends_it_at_once():
    paced = Paced(((k * SECOND, None) for k in range(1, 100)), 0.0)
    begin = time.monotonic()
    paced.run(lambda *_: paced.stop())
    assert time.monotonic() - begin < 5.0


@pytest.mark.parametrize('fails', [False, True])
def test_the_preparation_is_over_when_the_delivery_is(fails):
    """A thread that still steps the physics when the interpreter ends takes the process down."""
    inside: list[bool] = []

    def items():
        for k in range(1, 1000):
            inside.append(True)
            time.sleep(0.05)  # as a step that takes long
            inside.pop()
            yield k * SECOND // 100, None

    def deliver(*_):
        if fails:
            raise RuntimeError('no publisher')
        paced.stop()

    paced = Paced(items(), 0.5)
    try:
        paced.run(deliver)
    except RuntimeError:
        assert fails
    assert not inside
    time.sleep(0.12)
    assert not inside and not any(t.name == 'lookahead' for t in threading.enumerate())
