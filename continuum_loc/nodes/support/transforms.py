"""
TF, out and in: the robot's frames to others, and the frames of others.

Which frames are ours is a choice, so that none has two parents: where somebody else moves the
base in `odom`, map -> odom tells where that is. Needs tf2_msgs, which not every installation has.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
import importlib.util
from types import SimpleNamespace
from typing import Any, Literal

from continuum_loc import lie
from continuum_loc.errors import FrameError
from continuum_loc.nodes.support.frames import FrameTree
from continuum_loc.nodes.support.managed import PackageNode
from continuum_loc.nodes.support.quality import LATCHED
from continuum_loc.nodes.support.settings import EstimatorNodeSettings
from continuum_loc.robot import RobotDescription
from msg_tools.factory import Messages, ros_messages
from msg_tools.geometry import header_message, MAP, pose_message, stamp_of, transforms_of
import numpy as np
from rclpy.qos import QoSProfile

TF = 'tf2_msgs/msg/TFMessage'
DEPTH = 100
WAITING = 30  # estimates that may wait for the odometry of their instant


@dataclass(frozen=True)
class Frames:
    """
    Names of the frames as they are on the graph, and which of them are published.

    The prefix is put before all but the map's.
    """

    robot: RobotDescription
    prefix: str = ''
    tf: Literal['base', 'odom', 'rings', 'none'] = 'base'
    map: str = MAP  # noqa: A003  (the frame's name)
    odom_frame: str = 'odom'
    base_frame: str = 'base_link'

    @classmethod
    def of(cls, robot: RobotDescription, settings: EstimatorNodeSettings) -> Frames:
        """Take them from a node's parameters."""
        s = settings
        return cls(robot, s.frame_prefix, s.tf, s.map_frame, s.odom_frame, s.base_frame)

    @property
    def base(self) -> str:
        """Name of the base's frame."""
        return self.prefix + self.base_frame

    @property
    def odom(self) -> str:
        """Name of the frame in which others move the base."""
        return self.prefix + self.odom_frame

    @property
    def rings(self) -> tuple[str, ...]:
        """Names of the rings' frames."""
        return tuple(self.prefix + name for name in self.robot.ring_names)


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


def ring_transforms(make: Messages, frames: Frames, stamp: int, T_map_ring: np.ndarray) -> list:
    """Place each ring in the base, of T_map_ring (R + 1, 4, 4), the base first."""
    T_base_ring = lie.inverse(T_map_ring[0]) @ T_map_ring[1:]
    return [
        transform_message(make, stamp, frames.base, name, T)
        for name, T in zip(frames.rings, T_base_ring, strict=True)
    ]


def sensor_transforms(make: Messages, frames: Frames, stamp: int) -> list:
    """Place each sensor on its ring."""
    return [
        transform_message(
            make,
            stamp,
            frames.prefix + sensor.ring,
            frames.prefix + sensor.name,
            sensor.mount.T_ring_sensor,
        )
        for sensor in frames.robot.sensors
    ]


def available() -> bool:
    """Whether tf2_msgs is installed."""
    return importlib.util.find_spec('tf2_msgs') is not None


class Broadcaster:
    """
    Publishes the robot's frames.

    `tree` holds those of others: it says where the base is in `odom`.
    """

    def __init__(self, node: PackageNode, frames: Frames, tree: FrameTree) -> None:
        self.frames, self.tree, self.make = frames, tree, ros_messages()
        self.type = self.make.resolve(TF)
        self._node = node
        self._waiting: deque[tuple[int, np.ndarray]] = deque(maxlen=WAITING)
        if frames.tf != 'none':
            self._moving = node.managed_publisher(self.type, '/tf', QoSProfile(depth=DEPTH))
            self._static = node.managed_publisher(self.type, '/tf_static', LATCHED)

    def send_fixed(self) -> None:
        """Publish the sensors' frames on their rings, which late joiners get too."""
        if self.frames.tf != 'none':
            fixed = sensor_transforms(self.make, self.frames, self._node.now())
            self._static.publish(self.type(transforms=fixed))

    def send(
        self, stamp: int, T_map_ring: np.ndarray, T_map_frame: np.ndarray | None = None
    ) -> None:
        """
        Publish the body's frames at `stamp`.

        T_map_frame: (4, 4) where the frame of a measured base is known to lie, which is `odom`.
        """
        if self.frames.tf == 'none':
            return
        rings = ring_transforms(self.make, self.frames, stamp, T_map_ring)
        if T_map_frame is not None and self.frames.tf == 'odom':
            names = self.frames.map, self.frames.odom
            root = [transform_message(self.make, stamp, *names, T_map_frame)]
        else:
            root = self._root(stamp, T_map_ring[0])
        self._moving.publish(self.type(transforms=root + rings))

    def _root(self, stamp: int, T_map_base: np.ndarray) -> list:
        """
        Map -> base, or map -> odom.

        That of the newest estimate of whose instant the odometry has come: it may come later.
        """
        frames = self.frames
        if frames.tf == 'rings':
            return []
        if frames.tf == 'base':
            return [transform_message(self.make, stamp, frames.map, frames.base, T_map_base)]
        self._waiting.append((stamp, T_map_base))
        why: FrameError | None = None
        for earlier, T_map_base_then in reversed(self._waiting):
            try:
                T_odom_base = self.tree.transform(frames.odom, frames.base, earlier)
            except FrameError as error:
                why = error
                continue
            T_map_odom = T_map_base_then @ lie.inverse(T_odom_base)
            while self._waiting and self._waiting[0][0] <= earlier:
                self._waiting.popleft()
            return [transform_message(self.make, earlier, frames.map, frames.odom, T_map_odom)]
        if len(self._waiting) == WAITING:
            self._node.get_logger().warning(
                f'{frames.map} -> {frames.odom} is not published: {why}',
                throttle_duration_sec=10.0,
            )
        return []


def listen_to_frames(node: PackageNode, tree: FrameTree) -> None:
    """Keep the frames that are published on /tf and /tf_static in `tree`."""

    def take(message: Any, fixed: bool) -> None:
        poses = [
            SimpleNamespace(position=one.transform.translation, orientation=one.transform.rotation)
            for one in message.transforms
        ]
        try:
            T = transforms_of(poses, '/tf')
        except ValueError as error:
            node.get_logger().warning(str(error), throttle_duration_sec=10.0)
            return
        for one, T_parent_child in zip(message.transforms, T, strict=True):
            stamp = None if fixed else stamp_of(one.header, '/tf')
            parent, child = one.header.frame_id.lstrip('/'), one.child_frame_id.lstrip('/')
            tree.add(parent, child, T_parent_child, stamp)

    node.listen(TF, '/tf', lambda message: take(message, False), QoSProfile(depth=DEPTH))
    node.listen(TF, '/tf_static', lambda message: take(message, True), LATCHED)
