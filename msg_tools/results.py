"""ROS messages of what an estimate is published as <-> `msg_tools.records`, both ways."""

from __future__ import annotations

from typing import Any

from continuum_loc.measurements import TruthSample
from msg_tools.clouds import cloud_array, columns_cloud
from msg_tools.factory import Messages
from msg_tools.geometry import (
    body_covariance,
    frame_of,
    header_message,
    MAP,
    pose_message,
    pose_messages,
    require_map,
    ros_covariance,
    stamp_of,
    transforms_of,
    vector,
    vector_message,
)
from msg_tools.records import (
    CloudRecord,
    DiagnosticsRecord,
    FrameRecord,
    LoadRecord,
    PathRecord,
    PosesRecord,
    TipRecord,
    TwistRecord,
)
import numpy as np


def poses_message(make: Messages, stamp: int, T_map_body: np.ndarray) -> Any:
    """Write a PoseArray in `map` of (N, 4, 4)."""
    return make(
        'geometry_msgs/msg/PoseArray',
        header=header_message(make, stamp, MAP),
        poses=pose_messages(make, T_map_body),
    )


def poses_record(message: Any, where: str = 'poses') -> PosesRecord:
    """Read the poses of a PoseArray in `map`."""
    require_map(message.header, where)
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
    require_map(message.header, where)
    T = transforms_of([item.pose for item in message.poses], where)
    return PathRecord(stamp_of(message.header, where), T)


def tip_message(make: Messages, tip: TipRecord, child_frame: str) -> Any:
    """
    Odometry: pose and its covariance in `map`, twist and its in the tip's own frame.

    REP-103.
    """
    covariance = ros_covariance(tip.covariance, tip.T_map_tip[:3, :3])
    return make(
        'nav_msgs/msg/Odometry',
        header=header_message(make, tip.stamp, MAP),
        child_frame_id=child_frame,
        pose=make(
            'geometry_msgs/msg/PoseWithCovariance',
            pose=pose_message(make, tip.T_map_tip),
            covariance=covariance,
        ),
        twist=_twist(make, tip.velocity, tip.velocity_covariance),
    )


def _twist(make: Messages, velocity: np.ndarray, covariance: np.ndarray) -> Any:
    return make(
        'geometry_msgs/msg/TwistWithCovariance',
        twist=make(
            'geometry_msgs/msg/Twist',
            linear=vector_message(make, velocity[:3]),
            angular=vector_message(make, velocity[3:]),
        ),
        covariance=np.ascontiguousarray(covariance, float).reshape(36),
    )


def tip_record(message: Any, where: str = 'tip') -> TipRecord:
    """Read the tip of an Odometry message in `map`."""
    require_map(message.header, where)
    T = transforms_of([message.pose.pose], where)[0]
    return TipRecord(
        stamp_of(message.header, where),
        T,
        body_covariance(message.pose.covariance, T[:3, :3], where),
        *_velocity(message.twist),
    )


def frame_message(make: Messages, item: Any) -> Any:
    """PoseWithCovarianceStamped in `map` of a measured base's frame: an Estimate or a record."""
    covariance = ros_covariance(item.frame_covariance, item.T_map_frame[:3, :3])
    return make(
        'geometry_msgs/msg/PoseWithCovarianceStamped',
        header=header_message(make, item.stamp, MAP),
        pose=make(
            'geometry_msgs/msg/PoseWithCovariance',
            pose=pose_message(make, item.T_map_frame),
            covariance=covariance,
        ),
    )


def frame_record(message: Any, where: str = 'base/frame') -> FrameRecord:
    """Read where the frame of a measured base lies in `map`."""
    require_map(message.header, where)
    T = transforms_of([message.pose.pose], where)[0]
    covariance = body_covariance(message.pose.covariance, T[:3, :3], where)
    return FrameRecord(stamp_of(message.header, where), T, covariance)


def twist_message(make: Messages, item: TwistRecord) -> Any:
    """TwistWithCovarianceStamped, in the ring's own frame, which the header names."""
    return make(
        'geometry_msgs/msg/TwistWithCovarianceStamped',
        header=header_message(make, item.stamp, item.frame),
        twist=_twist(make, item.velocity, item.covariance),
    )


def twist_record(message: Any, where: str = 'twist') -> TwistRecord:
    """Read a body velocity in the frame that the header names."""
    frame = frame_of(message.header, where)
    return TwistRecord(stamp_of(message.header, where), frame, *_velocity(message.twist))


def _velocity(twist: Any) -> tuple[np.ndarray, np.ndarray]:
    """(6,) [v; w] and (6, 6) of a TwistWithCovariance."""
    velocity = np.concatenate([vector(twist.twist.linear), vector(twist.twist.angular)])
    return velocity, np.array(twist.covariance, float).reshape(6, 6)


def load_message(make: Messages, item: Any) -> Any:
    """WrenchStamped in `map`, about its origin, of an Estimate's first load, or of a record."""
    if isinstance(item, LoadRecord):
        force, moment = item.force, item.moment
    else:
        force, moment = np.zeros(3), np.zeros(3)
        for load in item.loads[:1]:
            force, moment = load.force, np.cross(load.place, load.force)
    return make(
        'geometry_msgs/msg/WrenchStamped',
        header=header_message(make, item.stamp, MAP),
        wrench=make(
            'geometry_msgs/msg/Wrench',
            force=vector_message(make, force),
            torque=vector_message(make, moment),
        ),
    )


def load_record(message: Any, where: str = 'load') -> LoadRecord:
    """Read the strongest force on the body."""
    require_map(message.header, where)
    wrench = message.wrench
    return LoadRecord(stamp_of(message.header, where), vector(wrench.force), vector(wrench.torque))


def columns_message(make: Messages, cloud: CloudRecord, frame_id: str = MAP) -> Any:
    """PointCloud2 of named columns, float32."""
    return columns_cloud(make, header_message(make, cloud.stamp, frame_id), cloud.fields)


def cloud_record(message: Any, where: str = 'cloud') -> CloudRecord:
    """All columns of a PointCloud2 in `map`; it may be empty."""
    require_map(message.header, where)
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
