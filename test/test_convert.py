"""
Messages and measurements: what goes in comes out.

In both flavours of messages, and bad input is named.
"""

from dataclasses import fields
from types import SimpleNamespace

from continuum_loc import lie
from continuum_loc.errors import MessageError
from continuum_loc.estimate import Estimate
from continuum_loc.measurements import (
    BaseSample,
    EncoderSample,
    FieldSample,
    ImuSample,
    StrainSample,
    TofFrame,
    TrackedPose,
    TruthSample,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from msg_tools import convert, geometry, results
from msg_tools.factory import bag_messages, deserialize, ros_messages
from msg_tools.records import CloudRecord, DiagnosticsRecord, PathRecord, PosesRecord
from msg_tools.topics import INPUTS, tip_of, topic_of, topic_spec, TOPICS, TRACKER
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

try:
    import sensor_msgs.msg  # noqa: F401

    FLAVOURS = [bag_messages(), ros_messages()]
except ImportError:
    FLAVOURS = [bag_messages()]

flavours = pytest.mark.parametrize('make', FLAVOURS, ids=['rosbags', 'rclpy'][: len(FLAVOURS)])
stamps = st.integers(1, 2**31 * 10**9 - 1)
names = st.text(
    st.characters(categories=('L', 'N'), include_characters='_'), min_size=1, max_size=20
)
numbers = st.floats(-1e3, 1e3)
vectors = hnp.arrays(float, 3, elements=numbers)
poses = st.builds(lambda xi: lie.exp(xi), hnp.arrays(float, 6, elements=st.floats(-2.0, 2.0)))


@st.composite
def tof_frames(draw):
    zones = draw(st.sampled_from([16, 64, 5]))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    rays = rng.normal(size=(zones, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    ranges = rng.uniform(0.02, 4.0, zones)
    ranges[rng.random(zones) < 0.3] = draw(st.sampled_from([np.inf, -np.inf, np.nan]))
    ranges = ranges.astype(np.float32).astype(float)
    with np.errstate(invalid='ignore'):
        points = np.where(np.isfinite(ranges)[:, None], rays * ranges[:, None], np.nan)
    return TofFrame(
        draw(stamps),
        draw(names),
        points.astype(np.float32).astype(float),
        ranges,
        (0.01 * np.ones(zones)).astype(np.float32).astype(float),
        rng.integers(0, 256, zones).astype(np.uint8),
    )


@st.composite
def strains(draw):
    count = draw(st.integers(1, 50))
    columns = [draw(hnp.arrays(float, count, elements=numbers)) for _ in range(3)]
    # The stamp travels as seconds in a double, which holds 2^31 s to 2^-22 s.
    return StrainSample(draw(st.integers(1, 2**20 * 10**9)), *columns)


@st.composite
def encoders(draw):
    joints = tuple(draw(st.lists(names, min_size=1, max_size=6, unique=True)))
    values = hnp.arrays(float, len(joints), elements=numbers)
    return EncoderSample(draw(stamps), joints, draw(values), draw(values))


@st.composite
def tracked(draw):
    A = draw(hnp.arrays(float, (6, 6), elements=st.floats(-1.0, 1.0)))
    return TrackedPose(draw(stamps), draw(names), draw(poses), A @ A.T)


MEASUREMENTS = {
    'tof/points': tof_frames(),
    'imu/data_raw': st.builds(ImuSample, stamps, names, vectors, vectors),
    'imu/mag': st.builds(
        FieldSample, stamps, names, hnp.arrays(float, 3, elements=st.just(np.nan) | numbers)
    ),
    'strain': strains(),
    'joint_states': encoders(),
    'base/pose': st.builds(BaseSample, stamps, names, poses),
    'base/odom': st.builds(BaseSample, stamps, names, poses),
    'ground_truth/poses': st.builds(
        TruthSample, stamps, st.lists(poses, min_size=1, max_size=6).map(np.stack)
    ),
    'poses': st.builds(PosesRecord, stamps, st.lists(poses, min_size=1, max_size=6).map(np.stack)),
    'backbone': st.builds(
        PathRecord, stamps, st.lists(poses, min_size=1, max_size=6).map(np.stack)
    ),
}


def assert_equal(a, b, tolerance=1e-9):
    assert type(a) is type(b)
    for item in fields(a):
        x, y = getattr(a, item.name), getattr(b, item.name)
        if isinstance(x, np.ndarray):
            np.testing.assert_allclose(
                x, y, rtol=0.0, atol=tolerance, equal_nan=True, err_msg=item.name
            )
        else:
            assert x == y, item.name


# ---------------------------------------------------------------- samples


def _header(stamp, frame_id):
    return SimpleNamespace(
        stamp=SimpleNamespace(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id=frame_id
    )


def _tof():
    rays = np.random.default_rng(0).normal(size=(64, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return TofFrame(10**9, 's', rays, np.ones(64), np.full(64, 0.01), np.full(64, 5, np.uint8))


def _strain():
    return StrainSample(10**9, np.array([0.1, 0.2]), np.zeros(2), np.ones(2))


def _estimate():
    rng = np.random.default_rng(1)
    T = lie.exp(rng.normal(size=(3, 6)))
    A = rng.normal(size=(3, 6, 6))
    covariance = A @ np.swapaxes(A, 1, 2)
    return Estimate(
        10**9,
        T,
        covariance,
        np.zeros((3, 6)),
        rng.normal(size=(3, 6)),
        covariance,
        np.zeros(3),
        T,
        'tracking',
        1.0,
    )


# ---------------------------------------------------------------- round trips


@flavours
@pytest.mark.parametrize('topic', MEASUREMENTS)
@given(data=st.data())
@settings(max_examples=25, deadline=None)
def test_every_measurement_survives_the_round_trip(make, topic, data):
    item = data.draw(MEASUREMENTS[topic])
    assert_equal(item, TOPICS[topic].decode(TOPICS[topic].encode(make, item), None, topic))
    if topic in (*INPUTS, 'ground_truth/poses'):
        assert topic_of(item) == ('base/pose' if topic == 'base/odom' else topic)


@flavours
@given(pose=tracked())
@settings(max_examples=25, deadline=None)
def test_a_tracked_pose_survives_and_its_topic_names_the_sensor(make, pose):
    assert topic_of(pose) == TRACKER + pose.sensor
    spec = topic_spec(TRACKER + pose.sensor)
    assert_equal(pose, spec.decode(spec.encode(make, pose), None, TRACKER + pose.sensor), 1e-8)


@pytest.mark.skipif(len(FLAVOURS) < 2, reason="rclpy's messages are not installed")
@pytest.mark.parametrize('topic', MEASUREMENTS)
@given(data=st.data())
@settings(max_examples=5, deadline=None)
def test_both_flavours_serialise_to_the_same_content(topic, data):
    """CDR of rclpy, read by rosbags, gives the same measurement: a bag is as good as a graph."""
    from rclpy.serialization import serialize_message

    item = data.draw(MEASUREMENTS[topic])
    spec = TOPICS[topic]
    message = deserialize(serialize_message(spec.encode(ros_messages(), item)), spec.type)
    assert_equal(item, spec.decode(message, None, topic))


def test_the_pose_covariance_is_turned_into_the_axes_of_the_map():
    """Samples of T Exp(delta) scatter in map axes (position, rotation vector) as published."""
    rng = np.random.default_rng(3)
    T = lie.exp(np.array([0.3, -0.2, 0.5, 0.8, -1.1, 0.4]))
    A = rng.normal(size=(6, 6))
    covariance = 1e-6 * (A @ A.T)
    samples = T @ lie.exp(rng.multivariate_normal(np.zeros(6), covariance, 200_000))
    position = samples[:, :3, 3] - T[:3, 3]
    rotation = Rotation.from_matrix(
        samples[:, :3, :3] @ T[:3, :3].T
    ).as_rotvec()  # about the map's fixed axes
    empirical = np.cov(np.hstack([position, rotation]).T)
    published = geometry.ros_covariance(covariance, T[:3, :3]).reshape(6, 6)
    # The relative error of a sample covariance of n samples is about sqrt(2 / n) = 0.3 %; 5 sigma
    # of it.
    np.testing.assert_allclose(empirical, published, atol=0.016 * np.abs(published).max())


@flavours
def test_the_tip_is_the_last_ring_with_twist_in_its_own_frame(make):
    estimate = _estimate()
    message = results.tip_message(make, tip_of(estimate), 'ring2')
    back = results.tip_record(message)
    assert message.header.frame_id == 'map' and message.child_frame_id == 'ring2'
    np.testing.assert_allclose(back.T_map_tip, estimate.T_map_ring[-1], atol=1e-12)
    np.testing.assert_allclose(back.covariance, estimate.covariance[-1], atol=1e-12)
    np.testing.assert_array_equal(back.velocity, estimate.velocity[-1])
    np.testing.assert_allclose(back.velocity_covariance, estimate.velocity_covariance[-1])


@flavours
def test_clouds_and_diagnostics_survive(make):
    rng = np.random.default_rng(0)
    columns = ('x', 'y', 'z', 'sigma', 'anomaly')
    cloud = CloudRecord(5, {name: rng.normal(size=7).astype(np.float32) for name in columns})
    back = results.cloud_record(results.columns_message(make, cloud))
    for name, values in cloud.fields.items():
        np.testing.assert_array_equal(back.fields[name], values)
    record = DiagnosticsRecord(
        9, (('estimator: engine', 2, 'lost', {'lag': '3'}), ('simulator', 0, 'running', {}))
    )
    assert results.diagnostics_record(results.diagnostics_message(make, record)) == record


@flavours
def test_imu_states_no_orientation_and_a_gyro_alone_has_no_acceleration(make):
    message = convert.imu_message(make, ImuSample(1, 'a', np.ones(3), np.ones(3)))
    assert message.orientation_covariance[0] == -1.0  # REP-145
    message.linear_acceleration_covariance[0] = -1.0
    assert np.isnan(convert.imu_sample(message).linear_acceleration).all()
    message.angular_velocity_covariance[0] = -1.0
    with pytest.raises(MessageError, match='no gyro'):
        convert.imu_sample(message)


# ---------------------------------------------------------------- other producers' clouds


@given(
    order=st.permutations(['x', 'y', 'z', 'range', 'sigma', 'status']),
    big=st.booleans(),
    pad=st.lists(st.integers(0, 7), min_size=7, max_size=7),
    row_pad=st.integers(0, 16),
    data=st.data(),
)
@settings(max_examples=60, deadline=None)
def test_any_layout_datatype_and_byte_order_of_a_cloud_is_read(order, big, pad, row_pad, data):
    frame = data.draw(tof_frames())
    types = {
        'x': 'f8',
        'y': 'f4',
        'z': 'f8',
        'range': 'f8',
        'sigma': 'f4',
        'status': data.draw(st.sampled_from(['u1', 'i2', 'u2', 'i4', 'u4', 'f4'])),
    }
    message = _foreign_cloud(frame, order, types, '>' if big else '<', pad, row_pad)
    assert_equal(frame, convert.tof_frame(message), 0.0)


def _foreign_cloud(frame, order, types, endian, pad, row_pad):
    offsets, cursor = [], pad[0]
    for name, gap in zip(order, pad[1:], strict=True):
        offsets.append(cursor)
        cursor += np.dtype(types[name]).itemsize + gap
    dtype = np.dtype(
        {
            'names': list(order),
            'formats': [endian + types[n] for n in order],
            'offsets': offsets,
            'itemsize': cursor,
        }
    )
    array = np.zeros(len(frame.ranges), dtype)
    columns = dict(zip('xyz', frame.points.T, strict=True)) | {
        'range': frame.ranges,
        'sigma': frame.sigma,
        'status': frame.status,
    }
    for name in order:
        array[name] = columns[name]
    numbers_of = {'i1': 1, 'u1': 2, 'i2': 3, 'u2': 4, 'i4': 5, 'u4': 6, 'f4': 7, 'f8': 8}
    items = [
        SimpleNamespace(name=n, offset=o, datatype=numbers_of[types[n]], count=1)
        for n, o in zip(order, offsets, strict=True)
    ]
    width = len(array)
    return SimpleNamespace(
        header=_header(frame.stamp, frame.sensor),
        height=1,
        width=width,
        fields=items,
        is_bigendian=endian == '>',
        point_step=cursor,
        row_step=cursor * width + row_pad,
        data=array.tobytes() + bytes(row_pad),
    )


def test_a_cloud_of_x_y_z_alone_gives_ranges_and_status():
    frame = _tof()
    message = _foreign_cloud(frame, ['x', 'y', 'z'], dict.fromkeys('xyz', 'f4'), '<', [0] * 4, 0)
    back = convert.tof_frame(message)
    np.testing.assert_allclose(back.ranges, 1.0, atol=1e-6)
    assert (back.status == 5).all() and np.isnan(back.sigma).all()


def _bad_clouds():
    def change(**values):
        message = convert.tof_message(bag_messages(), _tof())
        for name, value in values.items():
            setattr(message, name, value)
        return message

    yield 'size', 'bytes', change(data=np.zeros(10, np.uint8))
    yield 'size', 'row_step', change(row_step=1)
    yield 'size', 'row_step', change(point_step=0)
    yield 'empty', 'empty', change(width=0)
    yield 'fields', 'no field x, y, z', change(fields=[])
    yield 'frame', 'frame_id is empty', change(header=_header(1, ''))
    yield (
        'stamp',
        'not a time',
        change(header=SimpleNamespace(stamp=SimpleNamespace(sec=-1, nanosec=0), frame_id='a')),
    )
    for name, value, kind, text in (
        ('datatype', 9, 'type', 'datatype 9'),
        ('count', 3, 'fields', 'count 3'),
        ('offset', 22, 'fields', 'beyond'),
        ('name', 'y', 'fields', 'twice'),
    ):
        message = change()
        setattr(message.fields[0], name, value)
        yield kind, text, message
    perpendicular = _tof()
    # The distance along the axis instead of along the ray.
    perpendicular.ranges[:] = perpendicular.points[:, 0]
    yield (
        'range',
        "is not the point's distance",
        convert.tof_message(bag_messages(), perpendicular),
    )


@pytest.mark.parametrize(('kind', 'text', 'message'), list(_bad_clouds()))
def test_a_bad_cloud_is_named(kind, text, message):
    with pytest.raises(MessageError, match=text) as caught:
        convert.tof_frame(message)
    assert caught.value.kind == kind


# ---------------------------------------------------------------- strain, joints, poses


def test_unstamped_strain_takes_the_arrival():
    message = convert.strain_message(bag_messages(), _strain())
    message.layout.data_offset, message.data = 0, message.data[1:]
    assert convert.strain_sample(message, arrival=77).stamp == 77
    with pytest.raises(MessageError, match='no arrival'):
        convert.strain_sample(message)


@pytest.mark.parametrize(
    ('change', 'text'),
    [
        (lambda m: setattr(m.layout, 'data_offset', 2), 'data_offset is 2'),
        (lambda m: setattr(m, 'data', m.data[:-1]), 'values after the offset'),
        (lambda m: setattr(m, 'data', m.data[:1]), 'values after the offset'),
        (lambda m: m.data.__setitem__(3, np.nan), 'not finite'),
        (lambda m: m.data.__setitem__(0, -1.0), 'not a stamp'),
        (lambda m: setattr(m.layout.dim[0], 'label', 'row'), 'labelled'),
    ],
)
def test_bad_strain_is_named(change, text):
    message = convert.strain_message(bag_messages(), _strain())
    message.data = message.data.copy()
    change(message)
    with pytest.raises(MessageError, match=text):
        convert.strain_sample(message)


def test_joints_must_fit_their_names():
    message = convert.encoder_message(
        bag_messages(), EncoderSample(1, ('a', 'b'), np.zeros(2), np.zeros(2))
    )
    message.position = np.zeros(3)
    with pytest.raises(MessageError, match='3 values of position for 2 joints'):
        convert.encoder_sample(message)
    message.position, message.effort, message.name = np.zeros(2), np.empty(0), ['a', 'a']
    with pytest.raises(MessageError, match='twice'):
        convert.encoder_sample(message)
    message.name = ['a', 'b']
    assert np.isnan(convert.encoder_sample(message).effort).all()


def test_poses_must_be_poses_in_the_map():
    message = results.poses_message(bag_messages(), 1, np.eye(4)[None])
    message.poses[0].orientation.w = 0.5
    with pytest.raises(MessageError, match='norm 0.5'):
        results.poses_record(message)
    message.header.frame_id = 'odom'
    with pytest.raises(MessageError, match="valid: 'map'"):
        results.poses_record(message)


def test_unknown_topics_are_named():
    with pytest.raises(MessageError, match='tracker/<sensor>'):
        topic_spec('tracker/')
    with pytest.raises(MessageError, match='carries a PosesRecord'):
        topic_of(PosesRecord(1, np.eye(4)[None]))


@given(data=st.binary(max_size=400), topic=st.sampled_from(list(MEASUREMENTS)))
@settings(max_examples=300, deadline=None)
def test_random_bytes_never_do_worse_than_a_named_error(data, topic):
    """Any bytes: either a message that converts, or an error of a stated kind."""
    spec = TOPICS[topic]
    try:
        message = deserialize(b'\x00\x01\x00\x00' + data, spec.type)
    except Exception:
        return  # rosbags refuses damaged CDR in its own ways; `read_bag` names those
    try:
        spec.decode(message, 1, topic)
    except MessageError as error:
        assert error.kind
