"""
TF: map -> base_link -> rings, and the static frames of sensors on their rings.

Needs tf2_msgs, which not every installation has; `broadcaster` then gives None, and the node says
so.
"""

from __future__ import annotations

import importlib.util
from typing import Any

from continuum_loc import lie
from continuum_loc.robot import RobotDescription
from msg_tools.factory import Messages, ros_messages
from msg_tools.geometry import header_message, MAP, pose_message
import numpy as np
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

BASE_LINK = 'base_link'


def transform_message(
    make: Messages, stamp: int, parent: str, child: str, T_parent_child: np.ndarray
) -> Any:
    """geometry_msgs/TransformStamped."""
    pose = pose_message(make, T_parent_child)
    translation = make(
        'geometry_msgs/msg/Vector3', x=pose.position.x, y=pose.position.y, z=pose.position.z
    )
    return make(
        'geometry_msgs/msg/TransformStamped',
        header=header_message(make, stamp, parent),
        child_frame_id=child,
        transform=make(
            'geometry_msgs/msg/Transform', translation=translation, rotation=pose.orientation
        ),
    )


def body_transforms(
    make: Messages, robot: RobotDescription, prefix: str, stamp: int, T_map_ring: np.ndarray
) -> list:
    """Map -> base_link, base_link -> each ring, of T_map_ring (R + 1, 4, 4), the base first."""
    base = prefix + BASE_LINK
    T_base_ring = lie.inverse(T_map_ring[0]) @ T_map_ring[1:]
    rings = [
        transform_message(make, stamp, base, prefix + name, T)
        for name, T in zip(robot.ring_names, T_base_ring, strict=True)
    ]
    return [transform_message(make, stamp, MAP, base, T_map_ring[0]), *rings]


def sensor_transforms(make: Messages, robot: RobotDescription, prefix: str, stamp: int) -> list:
    """Each ring -> its sensors."""
    return [
        transform_message(
            make, stamp, prefix + sensor.ring, prefix + sensor.name, sensor.mount.T_ring_sensor
        )
        for sensor in robot.sensors
    ]


def broadcaster(node: Node, robot: RobotDescription, prefix: str) -> Broadcaster | None:
    """Make a broadcaster on /tf and /tf_static, or None where tf2_msgs is not installed."""
    if importlib.util.find_spec('tf2_msgs') is None:
        return None
    return Broadcaster(node, robot, prefix)


class Broadcaster:
    """Publishes the robot's frames."""

    def __init__(self, node: Node, robot: RobotDescription, prefix: str) -> None:
        self.robot, self.prefix, self.make = robot, prefix, ros_messages()
        self.type = self.make.resolve('tf2_msgs/msg/TFMessage')
        self._moving = node.create_publisher(self.type, '/tf', QoSProfile(depth=100))
        latched = QoSProfile(
            depth=1,
            reliability=ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.TRANSIENT_LOCAL,
        )
        self._static = node.create_publisher(self.type, '/tf_static', latched)
        self._static.publish(
            self.type(transforms=sensor_transforms(self.make, robot, prefix, node.now()))
        )

    def send(self, stamp: int, T_map_ring: np.ndarray) -> None:
        """Publish the body's frames at `stamp`."""
        transforms = body_transforms(self.make, self.robot, self.prefix, stamp, T_map_ring)
        self._moving.publish(self.type(transforms=transforms))
