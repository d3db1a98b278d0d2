"""
Headers, stamps, poses and covariances of ROS messages, both ways.

A pose covariance of ROS is about the axes of the header's frame (REP-103), ours about the body's
own: with R the body's rotation, C_ros = diag(R, R) C diag(R, R)^T to first order.
"""

from __future__ import annotations

from typing import Any

from continuum_loc.errors import MessageError
from continuum_loc.measurements import NANOSECONDS
from msg_tools.factory import Messages
import numpy as np
from scipy.spatial.transform import Rotation

MAP = 'map'
LAST_SECOND = 2**31 - 1  # that ROS's Time can hold


def time_message(make: Messages, stamp: int) -> Any:
    """
    builtin_interfaces/Time of integer nanoseconds.

    Raises MessageError where its 32 bits cannot hold the seconds, which would else wrap.
    """
    sec, nanosec = divmod(stamp, NANOSECONDS)
    if not 0 <= sec <= LAST_SECOND:
        raise MessageError(
            'stamp', f'stamp {sec} s does not fit a ROS time; valid: 0 to {LAST_SECOND} s'
        )
    return make('builtin_interfaces/msg/Time', sec=sec, nanosec=nanosec)


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


def require_map(header: Any, where: str) -> None:
    """Raise MessageError unless the header is in the frame `map`."""
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
    require_finite(values, 'pose', where)
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
    require_finite(values, 'covariance', where)
    if (np.diag(values) < 0.0).any():
        raise MessageError('value', f'{where}: the covariance has a negative variance')
    turn = np.kron(np.eye(2), R)
    return turn.T @ values @ turn


def vector(item: Any) -> np.ndarray:
    """(3,) of a Vector3 or Point."""
    return np.array([item.x, item.y, item.z], float)


def vector_message(make: Messages, value: np.ndarray) -> Any:
    """geometry_msgs/Vector3 of (3,)."""
    x, y, z = value.tolist()
    return make('geometry_msgs/msg/Vector3', x=x, y=y, z=z)


def require_finite(values: np.ndarray, what: str, where: str) -> None:
    """Raise MessageError unless every value is finite."""
    if not np.isfinite(values).all():
        raise MessageError(
            'value', f'{where}: {what} holds a value that is not finite: {np.ravel(values)[:8]}'
        )
