"""Where somebody says that the base is: a pose in any frame, or the planar one of RViz's tool."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from continuum_loc.measurements import TrackedPose
from continuum_loc.nodes.support.frames import FrameTree
from continuum_loc.robot import RobotDescription
from msg_tools.convert import tracked_pose
from msg_tools.geometry import MAP
import numpy as np
from scipy.spatial.transform import Rotation


def is_planar(message: Any) -> bool:
    """
    Whether a PoseWithCovarianceStamped tells x, y and yaw alone, as RViz's tool gives them.

    Its z, roll and pitch are zero, and so are their variances, which are known to nobody so well.
    """
    pose = message.pose.pose
    variances = np.diag(np.reshape(message.pose.covariance, (6, 6)))
    level = (pose.position.z, pose.orientation.x, pose.orientation.y) == (0.0, 0.0, 0.0)
    return level and not variances[2:5].any() and bool(variances[:2].all())


def placed_base(message: Any, map_frame: str, tree: FrameTree) -> TrackedPose:
    """
    Return the base's pose in the map, of a PoseWithCovarianceStamped in any frame.

    An empty frame is the map's. Raises MessageError, and FrameError where there is no way to the
    map.
    """
    frame = message.header.frame_id.lstrip('/') or map_frame
    T_map_frame = np.eye(4) if frame == map_frame else tree.transform(map_frame, frame)
    message.header.frame_id = MAP
    pose = tracked_pose(message, 'base', 'pose of the base')
    return replace(pose, T_map_sensor=T_map_frame @ pose.T_map_sensor)


def raised(robot: RobotDescription, T_map_base: np.ndarray) -> np.ndarray:
    """Give a planar pose (4, 4) the height, roll and pitch of the robot description's base."""
    own = robot.base.T_map_base
    roll, pitch, _ = Rotation.from_matrix(own[:3, :3]).as_euler('xyz')
    yaw = np.arctan2(T_map_base[1, 0], T_map_base[0, 0])
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler('xyz', [roll, pitch, yaw]).as_matrix()
    T[:3, 3] = *T_map_base[:2, 3], own[2, 3]
    return T


def with_base(
    robot: RobotDescription, T_map_base: np.ndarray, covariance: np.ndarray, insertion: float
) -> RobotDescription:
    """
    Move the robot's base to a pose (4, 4) given at the present insertion [m].

    A covariance of zeros keeps the robot's own.
    """
    T_base_zero = np.eye(4)
    T_base_zero[0, 3] = -insertion
    T_map_zero = T_map_base @ T_base_zero
    rpy = Rotation.from_matrix(T_map_zero[:3, :3]).as_euler('xyz', degrees=True)
    change: dict[str, Any] = {
        'xyz': tuple(T_map_zero[:3, 3].tolist()),
        'rpy_deg': tuple(rpy.tolist()),
    }
    if covariance.any():
        change['sigma_position'] = float(max(np.sqrt(np.trace(covariance[:3, :3]) / 3.0), 1e-6))
        change['sigma_rotation_deg'] = float(
            max(np.degrees(np.sqrt(np.trace(covariance[3:, 3:]) / 3.0)), 1e-6)
        )
    base = type(robot.base).model_validate(robot.base.model_dump() | change)
    return type(robot).model_validate(robot.model_dump() | {'base': base.model_dump()})
