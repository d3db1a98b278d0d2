"""
ROS messages <-> `continuum_loc.measurements`, both ways.

Works on rclpy's messages and on rosbags' alike: reading goes by attribute, and building is handed
a `msg_tools.factory.Messages`. Which topic carries what is in `msg_tools.topics`.

A pose covariance of ROS is about the axes of the header's frame (REP-103), ours about the body's
own: with R the body's rotation, C_ros = diag(R, R) C diag(R, R)^T to first order.
"""

from __future__ import annotations

from math import isqrt
from typing import Any

from continuum_loc.errors import MessageError
from continuum_loc.measurements import (
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
    TruthSample,
)
from msg_tools.clouds import cloud_array, cloud_message, columns_cloud
from msg_tools.factory import Messages
from msg_tools.records import CloudRecord, DiagnosticsRecord, PathRecord, PosesRecord, TipRecord
import numpy as np
from scipy.spatial.transform import Rotation

MAP = 'map'

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

# ---------------------------------------------------------------- headers, stamps, poses


def time_message(make: Messages, stamp: int) -> Any:
    """builtin_interfaces/Time of integer nanoseconds."""
    return make(
        'builtin_interfaces/msg/Time', sec=stamp // NANOSECONDS, nanosec=stamp % NANOSECONDS
    )


def header_message(make: Messages, stamp: int, frame_id: str) -> Any:
    """std_msgs/Header."""
    return make('std_msgs/msg/Header', stamp=time_message(make, stamp), frame_id=frame_id)


def stamp_of(header: Any, where: str) -> int:
    """Integer nanoseconds of a header. Raises MessageError where the fields are out of range."""
    sec, nanosec = int(header.stamp.sec), int(header.stamp.nanosec)
    if sec < 0 or not 0 <= nanosec < NANOSECONDS:
        raise MessageError(
            'stamp',
            f'{where}: stamp {sec} s {nanosec} ns is not a time; valid: sec >= 0, '
            '0 <= nanosec < 1000000000',
        )
    return sec * NANOSECONDS + nanosec


def frame_of(header: Any, where: str) -> str:
    """
    Return the header's frame without a leading slash (tf1's habit).

    Raises MessageError where it is empty.
    """
    frame = header.frame_id.lstrip('/')
    if not frame:
        raise MessageError('frame', f'{where}: header.frame_id is empty; it must name the sensor')
    return frame


def _require_map(header: Any, where: str) -> None:
    if header.frame_id.lstrip('/') != MAP:
        raise MessageError(
            'frame', f"{where}: header.frame_id is '{header.frame_id}'; valid: '{MAP}'"
        )


def pose_message(make: Messages, T: np.ndarray, quaternion: np.ndarray | None = None) -> Any:
    """
    geometry_msgs/Pose of a (4, 4) transform.

    Pass the quaternion (x, y, z, w) where it is known already.
    """
    x, y, z, w = (
        Rotation.from_matrix(T[:3, :3]).as_quat() if quaternion is None else quaternion
    ).tolist()
    px, py, pz = T[:3, 3].tolist()
    return make(
        'geometry_msgs/msg/Pose',
        position=make('geometry_msgs/msg/Point', x=px, y=py, z=pz),
        orientation=make('geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w),
    )


def pose_messages(make: Messages, T: np.ndarray) -> list:
    """One geometry_msgs/Pose for each of (N, 4, 4)."""
    quaternions = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    return [pose_message(make, *pair) for pair in zip(T, quaternions, strict=True)]


def transforms_of(poses: list, where: str) -> np.ndarray:
    """(N, 4, 4) of geometry_msgs/Pose. Raises MessageError on what is not a pose."""
    values = np.array(
        [
            (
                p.position.x,
                p.position.y,
                p.position.z,
                p.orientation.x,
                p.orientation.y,
                p.orientation.z,
                p.orientation.w,
            )
            for p in poses
        ],
        float,
    ).reshape(-1, 7)
    _require_finite(values, 'pose', where)
    norms = np.linalg.norm(values[:, 3:], axis=1)
    if (np.abs(norms - 1.0) > 1e-2).any():
        raise MessageError(
            'value',
            f'{where}: a quaternion has norm {norms[np.argmax(np.abs(norms - 1))]:.3g}; '
            'valid: 1 within 0.01',
        )
    T = np.tile(np.eye(4), (len(poses), 1, 1))
    T[:, :3, :3] = Rotation.from_quat(values[:, 3:]).as_matrix() if len(poses) else T[:, :3, :3]
    T[:, :3, 3] = values[:, :3]
    return T


def ros_covariance(covariance: np.ndarray, R: np.ndarray) -> np.ndarray:
    """(36,) row-major covariance about map axes (REP-103), of a (6, 6) one about body axes."""
    turn = np.kron(np.eye(2), R)
    return (turn @ covariance @ turn.T).reshape(36)


def body_covariance(covariance: Any, R: np.ndarray, where: str) -> np.ndarray:
    """(6, 6) covariance about the body's axes, of 36 numbers about the map's."""
    values = np.asarray(covariance, float).reshape(6, 6)
    _require_finite(values, 'covariance', where)
    if (np.diag(values) < 0.0).any():
        raise MessageError('value', f'{where}: the covariance has a negative variance')
    turn = np.kron(np.eye(2), R)
    return turn.T @ values @ turn


def _vector(item: Any) -> np.ndarray:
    return np.array([item.x, item.y, item.z], float)


def _vector_message(make: Messages, value: np.ndarray) -> Any:
    x, y, z = value.tolist()
    return make('geometry_msgs/msg/Vector3', x=x, y=y, z=z)


def _require_finite(values: np.ndarray, what: str, where: str) -> None:
    if not np.isfinite(values).all():
        raise MessageError(
            'value', f'{where}: {what} holds a value that is not finite: {np.ravel(values)[:8]}'
        )


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
    if ((status < 0) | (status > 255)).any():
        raise MessageError(
            'value',
            f"{where}: field 'status' holds {status.min()} to {status.max()}; valid: 0 to 255",
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
        angular_velocity=_vector_message(make, sample.angular_velocity),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=_vector_message(
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
    rate, force = _vector(message.angular_velocity), _vector(message.linear_acceleration)
    _require_finite(rate, 'angular_velocity', where)
    if message.linear_acceleration_covariance[0] == -1.0:
        force = np.full(3, np.nan)
    else:
        _require_finite(force, 'linear_acceleration', where)
    return ImuSample(stamp_of(message.header, where), frame_of(message.header, where), rate, force)


def field_message(make: Messages, sample: FieldSample) -> Any:
    """MagneticField; nan where an axis is saturated."""
    return make(
        'sensor_msgs/msg/MagneticField',
        header=header_message(make, sample.stamp, sample.sensor),
        magnetic_field=_vector_message(make, sample.field),
        magnetic_field_covariance=np.zeros(9),
    )


def field_sample(message: Any, where: str = 'imu/mag') -> FieldSample:
    """Read the Hall sample of a MagneticField message."""
    value = _vector(message.magnetic_field)
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
    _require_finite(data, 'data', where)
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
    if not 0.0 <= data[0] < 2.0**33:
        raise MessageError(
            'stamp',
            f'{where}: data[0] = {data[0]:.6g} is not a stamp in seconds; valid: 0 to 2^33',
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
    _require_map(message.header, where)
    T = transforms_of([message.pose.pose], where)[0]
    covariance = body_covariance(message.pose.covariance, T[:3, :3], where)
    return TrackedPose(stamp_of(message.header, where), sensor, T, covariance)


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


# ---------------------------------------------------------- poses, paths, tip, clouds, diagnostics


def poses_message(make: Messages, stamp: int, T_map_body: np.ndarray) -> Any:
    """Write a PoseArray in `map` of (N, 4, 4)."""
    return make(
        'geometry_msgs/msg/PoseArray',
        header=header_message(make, stamp, MAP),
        poses=pose_messages(make, T_map_body),
    )


def poses_record(message: Any, where: str = 'poses') -> PosesRecord:
    """Read the poses of a PoseArray in `map`."""
    _require_map(message.header, where)
    return PosesRecord(stamp_of(message.header, where), transforms_of(message.poses, where))


def truth_sample(message: Any, where: str = 'ground_truth/poses') -> TruthSample:
    """Read the true ring poses of a PoseArray in `map`."""
    record = poses_record(message, where)
    return TruthSample(record.stamp, record.T_map_body)


def path_message(make: Messages, stamp: int, T_map_backbone: np.ndarray) -> Any:
    """Path in `map` of (B, 4, 4)."""
    header = header_message(make, stamp, MAP)
    poses = [
        make('geometry_msgs/msg/PoseStamped', header=header, pose=pose)
        for pose in pose_messages(make, T_map_backbone)
    ]
    return make('nav_msgs/msg/Path', header=header, poses=poses)


def path_record(message: Any, where: str = 'backbone') -> PathRecord:
    """Read the transforms of a Path in `map`."""
    _require_map(message.header, where)
    T = transforms_of([item.pose for item in message.poses], where)
    return PathRecord(stamp_of(message.header, where), T)


def tip_message(make: Messages, tip: TipRecord, child_frame: str) -> Any:
    """
    Odometry: pose and its covariance in `map`, twist and its in the tip's own frame.

    REP-103.
    """
    covariance = ros_covariance(tip.covariance, tip.T_map_tip[:3, :3])
    twist = make(
        'geometry_msgs/msg/Twist',
        linear=_vector_message(make, tip.velocity[:3]),
        angular=_vector_message(make, tip.velocity[3:]),
    )
    return make(
        'nav_msgs/msg/Odometry',
        header=header_message(make, tip.stamp, MAP),
        child_frame_id=child_frame,
        pose=make(
            'geometry_msgs/msg/PoseWithCovariance',
            pose=pose_message(make, tip.T_map_tip),
            covariance=covariance,
        ),
        twist=make(
            'geometry_msgs/msg/TwistWithCovariance',
            twist=twist,
            covariance=np.ascontiguousarray(tip.velocity_covariance, float).reshape(36),
        ),
    )


def tip_record(message: Any, where: str = 'tip') -> TipRecord:
    """Read the tip of an Odometry message in `map`."""
    _require_map(message.header, where)
    T = transforms_of([message.pose.pose], where)[0]
    velocity = np.concatenate(
        [_vector(message.twist.twist.linear), _vector(message.twist.twist.angular)]
    )
    velocity_covariance = np.array(message.twist.covariance, float).reshape(6, 6)
    return TipRecord(
        stamp_of(message.header, where),
        T,
        body_covariance(message.pose.covariance, T[:3, :3], where),
        velocity,
        velocity_covariance,
    )


def columns_message(make: Messages, cloud: CloudRecord, frame_id: str = MAP) -> Any:
    """PointCloud2 of named columns, float32."""
    return columns_cloud(make, header_message(make, cloud.stamp, frame_id), cloud.fields)


def cloud_record(message: Any, where: str = 'cloud') -> CloudRecord:
    """All columns of a PointCloud2 in `map`; it may be empty."""
    _require_map(message.header, where)
    stamp = stamp_of(message.header, where)
    if message.width * message.height == 0:
        return CloudRecord(stamp, {item.name: np.empty(0) for item in message.fields})
    array = cloud_array(message, where).reshape(-1)
    return CloudRecord(stamp, {name: array[name].copy() for name in array.dtype.names})


def map_record(stamp: int, prior_map: Any) -> CloudRecord:
    """Read the columns of `prior_map`: points, normals and planarity of a PriorMap."""
    values = np.column_stack([prior_map.points, prior_map.normals, prior_map.planarity])
    names = ('x', 'y', 'z', 'normal_x', 'normal_y', 'normal_z', 'planarity')
    return CloudRecord(stamp, dict(zip(names, values.T, strict=True)))


def diagnostics_message(make: Messages, record: DiagnosticsRecord) -> Any:
    """DiagnosticArray."""
    statuses = []
    for name, level, text, values in record.statuses:
        pairs = [
            make('diagnostic_msgs/msg/KeyValue', key=key, value=value)
            for key, value in values.items()
        ]
        statuses.append(
            make(
                'diagnostic_msgs/msg/DiagnosticStatus',
                level=_level(make, level),
                name=name,
                message=text,
                hardware_id='',
                values=pairs,
            )
        )
    return make(
        'diagnostic_msgs/msg/DiagnosticArray',
        header=header_message(make, record.stamp, ''),
        status=statuses,
    )


def _level(make: Messages, level: int) -> Any:
    """Rclpy wants `byte` as bytes, rosbags as int: the constant of the class tells which."""
    ok = make.resolve('diagnostic_msgs/msg/DiagnosticStatus').OK
    return bytes([level]) if isinstance(ok, bytes) else level


def diagnostics_record(message: Any, where: str = '/diagnostics') -> DiagnosticsRecord:
    """Read the statuses of a DiagnosticArray."""
    statuses = tuple(
        (
            item.name,
            item.level[0] if isinstance(item.level, bytes) else int(item.level),
            item.message,
            {pair.key: pair.value for pair in item.values},
        )
        for item in message.status
    )
    return DiagnosticsRecord(stamp_of(message.header, where), statuses)
