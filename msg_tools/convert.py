"""
ROS messages <-> `continuum_loc.measurements`, both ways.

Works on rclpy's messages and on rosbags' alike: reading goes by attribute, and building is handed
a `msg_tools.factory.Messages`. Which topic carries what is in `msg_tools.topics`. What an estimate
is published as is in `msg_tools.results`, headers and poses in `msg_tools.geometry`.
"""

from __future__ import annotations

from math import isqrt
from typing import Any

from continuum_loc.errors import MessageError
from continuum_loc.measurements import (
    BaseSample,
    EncoderSample,
    FieldSample,
    ImuSample,
    NANOSECONDS,
    nanoseconds,
    StrainSample,
    TOF_NO_TARGET,
    TOF_VALID,
    TofFrame,
    TrackedPose,
)
from msg_tools.clouds import cloud_array, cloud_message
from msg_tools.factory import Messages
from msg_tools.geometry import (
    body_covariance,
    frame_of,
    header_message,
    LAST_SECOND,
    MAP,
    pose_message,
    require_finite,
    require_map,
    ros_covariance,
    stamp_of,
    transforms_of,
    vector,
    vector_message,
)
import numpy as np

# Aligned to 4 bytes, so that viewers which cast the buffer are served too.
TOF_DTYPE = np.dtype(
    {
        'names': ['x', 'y', 'z', 'range', 'sigma', 'status'],
        'formats': ['<f4'] * 5 + ['u1'],
        'offsets': [0, 4, 8, 12, 16, 20],
        'itemsize': 24,
    }
)
_STRAIN_LABELS = ('station', 's,theta,kappa')

# ---------------------------------------------------------------- tof/points


def tof_message(make: Messages, frame: TofFrame) -> Any:
    """PointCloud2 of a ToF frame; a square number of zones is organised as rows x columns."""
    side = isqrt(len(frame.ranges))
    shape = (side, side) if side * side == len(frame.ranges) else (1, len(frame.ranges))
    # Zeroed: the padding bytes must not vary between runs.
    array = np.zeros(len(frame.ranges), TOF_DTYPE)
    array['x'], array['y'], array['z'] = frame.points.T
    array['range'], array['sigma'], array['status'] = frame.ranges, frame.sigma, frame.status
    return cloud_message(
        make, header_message(make, frame.stamp, frame.sensor), array.reshape(shape)
    )


def tof_frame(message: Any, where: str = 'tof/points') -> TofFrame:
    """
    Read the ToF frame of a PointCloud2 with at least x, y, z.

    Absent fields are filled: `range` from the points (nan where there is none), `sigma` with nan,
    `status` with 5 where a range is finite and 255 elsewhere. Raises MessageError on another
    layout, or where the stated range is not the distance of the point (a driver that put the
    perpendicular distance there).
    """
    array = cloud_array(message, where).reshape(-1)
    missing = [name for name in 'xyz' if name not in array.dtype.names]
    if missing:
        raise MessageError(
            'fields',
            f'{where}: no field {", ".join(missing)}; needed: x, y, z, and if known range, '
            f'sigma, status; got: {", ".join(array.dtype.names) or "none"}',
        )
    with np.errstate(invalid='ignore'):  # signalling NaNs, as a wrong byte order makes them
        points = np.column_stack([array[name] for name in 'xyz']).astype(float)
    ranges = _tof_ranges(array, points, where)
    finite = np.isfinite(ranges)
    sigma = (
        array['sigma'].astype(float)
        if 'sigma' in array.dtype.names
        else np.full(len(array), np.nan)
    )
    status = (
        array['status']
        if 'status' in array.dtype.names
        else np.where(finite, TOF_VALID, TOF_NO_TARGET)
    )
    return TofFrame(
        stamp=stamp_of(message.header, where),
        sensor=frame_of(message.header, where),
        points=points,
        ranges=ranges,
        sigma=sigma,
        status=_octets(status, where),
    )


def _tof_ranges(array: np.ndarray, points: np.ndarray, where: str) -> np.ndarray:
    distance = np.sqrt(np.einsum('ij,ij->i', points, points))
    if 'range' not in array.dtype.names:
        return np.where(np.isfinite(distance), distance, np.nan)
    ranges = array['range'].astype(float)
    finite = np.isfinite(ranges)
    apart = finite & ~(np.abs(distance - ranges) <= 0.01 + 0.01 * np.abs(ranges))
    if apart.any():
        zone = int(np.argmax(apart))
        raise MessageError(
            'range',
            f"{where}: in {apart.sum()} of {len(ranges)} zones `range` is not the point's "
            f'distance (zone {zone}: range {ranges[zone]:.3f} m, point at {distance[zone]:.3f} m)',
        )
    return ranges


def _octets(status: np.ndarray, where: str) -> np.ndarray:
    if status.dtype.kind == 'f' and not np.isfinite(status).all():
        raise MessageError('value', f"{where}: field 'status' holds a value that is not finite")
    odd = (status < 0) | (status > 255) | (status % 1 != 0)
    if odd.any():
        raise MessageError(
            'value',
            f"{where}: field 'status' holds {status[odd][0]}; valid: whole numbers, 0 to 255",
        )
    return status.astype(np.uint8)


# ---------------------------------------------------------------- imu/data_raw, imu/mag


def imu_message(make: Messages, sample: ImuSample) -> Any:
    """
    Write an Imu without orientation, and a gyro alone without acceleration.

    REP-145: a covariance that begins with -1.
    """
    absent = np.zeros(9)
    absent[0] = -1.0
    gyro_alone = np.isnan(sample.linear_acceleration).all()
    return make(
        'sensor_msgs/msg/Imu',
        header=header_message(make, sample.stamp, sample.sensor),
        orientation=make('geometry_msgs/msg/Quaternion', x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=absent,
        angular_velocity=vector_message(make, sample.angular_velocity),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vector_message(
            make, np.zeros(3) if gyro_alone else sample.linear_acceleration
        ),
        linear_acceleration_covariance=absent if gyro_alone else np.zeros(9),
    )


def imu_sample(message: Any, where: str = 'imu/data_raw') -> ImuSample:
    """
    Read the IMU sample of an Imu message.

    A gyro alone (linear_acceleration_covariance[0] = -1) has nan acceleration.
    """
    if message.angular_velocity_covariance[0] == -1.0:
        raise MessageError(
            'value', f'{where}: angular_velocity_covariance[0] = -1 says that there is no gyro'
        )
    rate, force = vector(message.angular_velocity), vector(message.linear_acceleration)
    require_finite(rate, 'angular_velocity', where)
    if message.linear_acceleration_covariance[0] == -1.0:
        force = np.full(3, np.nan)
    else:
        require_finite(force, 'linear_acceleration', where)
    return ImuSample(stamp_of(message.header, where), frame_of(message.header, where), rate, force)


def field_message(make: Messages, sample: FieldSample) -> Any:
    """MagneticField; nan where an axis is saturated."""
    return make(
        'sensor_msgs/msg/MagneticField',
        header=header_message(make, sample.stamp, sample.sensor),
        magnetic_field=vector_message(make, sample.field),
        magnetic_field_covariance=np.zeros(9),
    )


def field_sample(message: Any, where: str = 'imu/mag') -> FieldSample:
    """Read the Hall sample of a MagneticField message."""
    value = vector(message.magnetic_field)
    if np.isinf(value).any():
        raise MessageError(
            'value',
            f'{where}: magnetic_field {value} is infinite; valid: tesla, nan where saturated',
        )
    return FieldSample(stamp_of(message.header, where), frame_of(message.header, where), value)


# ---------------------------------------------------------------- strain


def strain_message(make: Messages, sample: StrainSample) -> Any:
    """
    Float64MultiArray: data[0] the stamp in seconds, then rows (s, theta, kappa).

    The stamp is good to 0.3 us in this century.
    """
    rows = np.column_stack([sample.s, sample.theta, sample.kappa])
    data = np.concatenate([[sample.stamp / NANOSECONDS], rows.reshape(-1)])
    sizes = ((len(rows), rows.size), (3, 3))
    dim = [
        make('std_msgs/msg/MultiArrayDimension', label=label, size=size, stride=stride)
        for label, (size, stride) in zip(_STRAIN_LABELS, sizes, strict=True)
    ]
    layout = make('std_msgs/msg/MultiArrayLayout', dim=dim, data_offset=1)
    return make('std_msgs/msg/Float64MultiArray', layout=layout, data=make.doubles(data))


def strain_is_stamped(message: Any) -> bool:
    """Whether the message carries its own stamp; otherwise the arrival time has to do."""
    return message.layout.data_offset == 1


def strain_sample(message: Any, arrival: int | None = None, where: str = 'strain') -> StrainSample:
    """
    Read the strain of a Float64MultiArray.

    `arrival` (ns) is the stamp of one with data_offset = 0.
    """
    data = np.array(message.data, float)
    offset = int(message.layout.data_offset)
    if offset not in (0, 1):
        raise MessageError(
            'size',
            f'{where}: layout.data_offset is {offset}; valid: 1 (data[0] is the stamp) or 0',
        )
    labels = tuple(dim.label for dim in message.layout.dim)
    if labels and labels != _STRAIN_LABELS:
        raise MessageError(
            'fields', f'{where}: layout.dim is labelled {labels}; valid: {_STRAIN_LABELS}'
        )
    rows = data[offset:]
    if len(rows) == 0 or len(rows) % 3 or (labels and message.layout.dim[0].size * 3 != len(rows)):
        raise MessageError(
            'size',
            f'{where}: {len(rows)} values after the offset; valid: 3 (s, theta, kappa) for each '
            f'of the {message.layout.dim[0].size if labels else "M"} stations, at least one',
        )
    require_finite(data, 'data', where)
    s, theta, kappa = rows.reshape(-1, 3).T
    return StrainSample(
        _strain_stamp(data, offset, arrival, where), s.copy(), theta.copy(), kappa.copy()
    )


def _strain_stamp(data: np.ndarray, offset: int, arrival: int | None, where: str) -> int:
    if offset == 0:
        if arrival is None:
            raise MessageError(
                'stamp', f'{where}: data_offset = 0 states no stamp, and no arrival time is known'
            )
        return arrival
    if not 0.0 <= data[0] <= LAST_SECOND:
        raise MessageError(
            'stamp',
            f'{where}: data[0] = {data[0]:.6g} is not a stamp in seconds; valid: 0 to 2^31 - 1, '
            'as in a header',
        )
    return nanoseconds(data[0])


# ---------------------------------------------------------------- tracker/<sensor>, joint_states


def tracker_message(make: Messages, pose: TrackedPose) -> Any:
    """Write a PoseWithCovarianceStamped in `map`; the topic names the sensor."""
    covariance = ros_covariance(pose.covariance, pose.T_map_sensor[:3, :3])
    return make(
        'geometry_msgs/msg/PoseWithCovarianceStamped',
        header=header_message(make, pose.stamp, MAP),
        pose=make(
            'geometry_msgs/msg/PoseWithCovariance',
            pose=pose_message(make, pose.T_map_sensor),
            covariance=covariance,
        ),
    )


def tracked_pose(message: Any, sensor: str, where: str = 'tracker') -> TrackedPose:
    """Read the pose of `sensor`, from PoseWithCovarianceStamped in `map`."""
    require_map(message.header, where)
    T = transforms_of([message.pose.pose], where)[0]
    covariance = body_covariance(message.pose.covariance, T[:3, :3], where)
    return TrackedPose(stamp_of(message.header, where), sensor, T, covariance)


def base_message(make: Messages, sample: BaseSample) -> Any:
    """Write a PoseWithCovarianceStamped of the base in the sample's frame."""
    return make(
        'geometry_msgs/msg/PoseWithCovarianceStamped',
        header=header_message(make, sample.stamp, sample.frame),
        pose=_base_pose(make, sample),
    )


def base_odometry(make: Messages, sample: BaseSample) -> Any:
    """Write an Odometry of the base in the sample's frame; a covariance of -1: no twist."""
    zero = vector_message(make, np.zeros(3))
    unknown = np.zeros(36)
    unknown[0] = -1.0
    return make(
        'nav_msgs/msg/Odometry',
        header=header_message(make, sample.stamp, sample.frame),
        child_frame_id='base_link',
        pose=_base_pose(make, sample),
        twist=make(
            'geometry_msgs/msg/TwistWithCovariance',
            twist=make('geometry_msgs/msg/Twist', linear=zero, angular=zero),
            covariance=unknown,
        ),
    )


def _base_pose(make: Messages, sample: BaseSample) -> Any:
    return make(
        'geometry_msgs/msg/PoseWithCovariance',
        pose=pose_message(make, sample.T_frame_base),
        covariance=ros_covariance(sample.covariance, sample.T_frame_base[:3, :3]),
    )


def base_sample(message: Any, where: str = 'base/pose') -> BaseSample:
    """Read the base's pose of a PoseWithCovarianceStamped or Odometry, in its header's frame."""
    T = transforms_of([message.pose.pose], where)[0]
    covariance = body_covariance(message.pose.covariance, T[:3, :3], where)
    frame = frame_of(message.header, where)
    return BaseSample(stamp_of(message.header, where), frame, T, covariance)


def encoder_message(make: Messages, sample: EncoderSample) -> Any:
    """Write a JointState with positions and efforts."""
    return make(
        'sensor_msgs/msg/JointState',
        header=header_message(make, sample.stamp, ''),
        name=list(sample.names),
        position=make.doubles(np.asarray(sample.position, float)),
        velocity=make.doubles(np.empty(0)),
        effort=make.doubles(np.asarray(sample.effort, float)),
    )


def encoder_sample(message: Any, where: str = 'joint_states') -> EncoderSample:
    """Read the encoders of a JointState; an empty `position` or `effort` becomes nan."""
    names = tuple(message.name)
    if not names:
        raise MessageError('empty', f'{where}: no joint is named')
    if len(set(names)) != len(names):
        raise MessageError('fields', f'{where}: a joint is named twice: {", ".join(names)}')
    position = _per_joint(message.position, names, 'position', where)
    effort = _per_joint(message.effort, names, 'effort', where)
    return EncoderSample(stamp_of(message.header, where), names, position, effort)


def _per_joint(values: Any, names: tuple[str, ...], what: str, where: str) -> np.ndarray:
    array = np.array(values, float)
    if len(array) not in (0, len(names)):
        raise MessageError(
            'size',
            f'{where}: {len(array)} values of {what} for {len(names)} joints; valid: as many '
            'as names, or none',
        )
    if np.isinf(array).any():
        raise MessageError('value', f'{where}: {what} holds an infinite value')
    return array if len(array) else np.full(len(names), np.nan)
