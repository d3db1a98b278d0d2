"""The one list of topics: name, type, quality of service, how content is written and read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from continuum_loc.errors import MessageError
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
from msg_tools import convert, results
from msg_tools.factory import Messages
from msg_tools.records import CloudRecord, PosesRecord, TipRecord

TRACKER, RING_POSE, RING_TWIST = 'tracker/', 'ring_pose/', 'ring_twist/'
# Topics of which there is one for each sensor or ring, and how they are called as a whole.
FAMILIES = {
    TRACKER: 'tracker/<sensor>',
    RING_POSE: 'ring_pose/<ring>',
    RING_TWIST: 'ring_twist/<ring>',
}


@dataclass(frozen=True)
class Topic:
    """
    One topic of the contract.

    type: ROS type name. encode: (make, item) -> message. decode: (message, arrival ns, where) ->
    item.
    latched: the last message is kept for late joiners. depth: messages a queue holds.
    """

    type: str  # noqa: A003  (ROS's word)
    encode: Callable[[Messages, Any], Any]
    decode: Callable[[Any, int | None, str], Any]
    latched: bool = False
    depth: int = 10


def _read(decode: Callable[[Any, str], Any]) -> Callable[[Any, int | None, str], Any]:
    """Make a decoder of messages that carry their own stamp."""
    return lambda message, arrival, where: decode(message, where)


def _poses(make: Messages, item: Any) -> Any:
    T = item.T_map_body if isinstance(item, PosesRecord) else item.T_map_ring
    return results.poses_message(make, item.stamp, T)


def _path(make: Messages, item: Any) -> Any:
    return results.path_message(make, item.stamp, item.T_map_backbone)


def tip_of(estimate: Any) -> TipRecord:
    """Take the tip of an `Estimate`: its last ring."""
    if isinstance(estimate, TipRecord):
        return estimate
    return TipRecord(
        estimate.stamp,
        estimate.T_map_ring[-1],
        estimate.covariance[-1],
        estimate.velocity[-1],
        estimate.velocity_covariance[-1],
    )


def _strain(message: Any, arrival: int | None, where: str) -> Any:
    return convert.strain_sample(message, arrival, where)


def _pose_of_one(message: Any, arrival: int | None, where: str) -> Any:
    return convert.tracked_pose(message, where.rpartition('/')[2], where)


_POSE = 'geometry_msgs/msg/PoseWithCovarianceStamped'
# The depth of an input covers 4 s of all its sensors together, so that a slow moment loses
# nothing.
TOPICS: dict[str, Topic] = {
    'tof/points': Topic(
        'sensor_msgs/msg/PointCloud2', convert.tof_message, _read(convert.tof_frame), depth=1024
    ),
    'imu/data_raw': Topic(
        'sensor_msgs/msg/Imu', convert.imu_message, _read(convert.imu_sample), depth=2048
    ),
    'imu/mag': Topic(
        'sensor_msgs/msg/MagneticField',
        convert.field_message,
        _read(convert.field_sample),
        depth=1024,
    ),
    'strain': Topic('std_msgs/msg/Float64MultiArray', convert.strain_message, _strain, depth=128),
    TRACKER: Topic(_POSE, convert.tracker_message, _pose_of_one, depth=512),
    'joint_states': Topic(
        'sensor_msgs/msg/JointState',
        convert.encoder_message,
        _read(convert.encoder_sample),
        depth=256,
    ),
    'base/pose': Topic(_POSE, convert.base_message, _read(convert.base_sample), depth=512),
    'base/odom': Topic(
        'nav_msgs/msg/Odometry', convert.base_odometry, _read(convert.base_sample), depth=512
    ),
    'ground_truth/poses': Topic(
        'geometry_msgs/msg/PoseArray', _poses, _read(results.truth_sample), depth=512
    ),
    'poses': Topic('geometry_msgs/msg/PoseArray', _poses, _read(results.poses_record)),
    'backbone': Topic('nav_msgs/msg/Path', _path, _read(results.path_record)),
    'tip': Topic(
        'nav_msgs/msg/Odometry',
        lambda make, item: results.tip_message(make, tip_of(item), 'tip'),
        _read(results.tip_record),
    ),
    'base/hypotheses': Topic('geometry_msgs/msg/PoseArray', _poses, _read(results.poses_record)),
    'base/frame': Topic(_POSE, results.frame_message, _read(results.frame_record)),
    'load': Topic(
        'geometry_msgs/msg/WrenchStamped', results.load_message, _read(results.load_record)
    ),
    RING_POSE: Topic(_POSE, convert.tracker_message, _pose_of_one),
    RING_TWIST: Topic(
        'geometry_msgs/msg/TwistWithCovarianceStamped',
        results.twist_message,
        _read(results.twist_record),
    ),
    'reconstruction': Topic(
        'sensor_msgs/msg/PointCloud2', results.columns_message, _read(results.cloud_record)
    ),
    'prior_map': Topic(
        'sensor_msgs/msg/PointCloud2',
        results.columns_message,
        _read(results.cloud_record),
        latched=True,
        depth=1,
    ),
    'shape/poses': Topic('geometry_msgs/msg/PoseArray', _poses, _read(results.poses_record)),
    'shape/curve': Topic('nav_msgs/msg/Path', _path, _read(results.path_record)),
    '/diagnostics': Topic(
        'diagnostic_msgs/msg/DiagnosticArray',
        results.diagnostics_message,
        _read(results.diagnostics_record),
    ),
}

INPUTS = (
    'tof/points',
    'imu/data_raw',
    'imu/mag',
    'strain',
    'joint_states',
    'base/pose',
    'base/odom',
)
OUTPUTS = (
    'poses',
    'backbone',
    'tip',
    'base/frame',
    'base/hypotheses',
    'load',
    RING_POSE,
    RING_TWIST,
    'reconstruction',
    'prior_map',
    'shape/poses',
    'shape/curve',
    '/diagnostics',
)

# What a sample goes out on; a TrackedPose on `tracker/<sensor>`.
_SAMPLE_TOPICS = {
    TofFrame: 'tof/points',
    ImuSample: 'imu/data_raw',
    FieldSample: 'imu/mag',
    StrainSample: 'strain',
    EncoderSample: 'joint_states',
    BaseSample: 'base/pose',
    TruthSample: 'ground_truth/poses',
}


def topic_of(sample: Any) -> str:
    """Name the topic that carries a sample. Raises MessageError for what is none."""
    if isinstance(sample, TrackedPose):
        return TRACKER + sample.sensor
    if type(sample) not in _SAMPLE_TOPICS:
        raise MessageError('topic', f'no topic of the contract carries a {type(sample).__name__}')
    return _SAMPLE_TOPICS[type(sample)]


def key_of(name: str) -> str:
    """Return the name in TOPICS of a relative topic: its family's, where it has one."""
    head, slash, tail = name.partition('/')
    return head + slash if head + slash in FAMILIES and tail and '/' not in tail else name


def topic_spec(name: str) -> Topic:
    """
    Return the contract of a relative topic; `tracker/<sensor>` too.

    Raises MessageError listing the valid names.
    """
    key = key_of(name)
    if key not in TOPICS or name in FAMILIES:
        raise MessageError(
            'topic',
            f"no topic '{name}' in the contract; valid: "
            + ', '.join(FAMILIES.get(topic, topic) for topic in TOPICS),
        )
    return TOPICS[key]


def cloud_topic_record(item: Any, stamp: int) -> CloudRecord:
    """
    Gather what `reconstruction` and `prior_map` are written from.

    A CloudRecord, a PriorMap or a Reconstruction.
    """
    if isinstance(item, CloudRecord):
        return item
    if hasattr(item, 'normals'):
        return results.map_record(stamp, item)
    x, y, z = item.points.T
    return CloudRecord(
        stamp,
        {
            'x': x,
            'y': y,
            'z': z,
            'sigma': item.sigma,
            'anomaly': getattr(item, 'anomaly', 0.0 * x),
        },
    )
