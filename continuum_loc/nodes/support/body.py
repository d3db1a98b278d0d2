"""
The body as RViz and Foxglove draw it, and each ring's pose and velocity as others use them.

A tube in the colour of the status, the 3-sigma ellipsoids of its rings, what each ToF sensor looks
at, and in red what is not to be believed.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from continuum_loc.estimate import Estimate
from continuum_loc.measurements import TrackedPose
from continuum_loc.nodes.support.transforms import Frames
from continuum_loc.robot import RobotDescription, Sensor
from msg_tools.factory import Messages
from msg_tools.geometry import header_message, pose_message
from msg_tools.records import TwistRecord
from msg_tools.topics import RING_POSE, RING_TWIST
import numpy as np

BASE = 'base'  # what is put for a ring's name where the base is meant
ARROW, SPHERE, LINE_STRIP, LINE_LIST, TEXT, DELETE_ALL = 0, 2, 4, 5, 9, 3  # of Marker
COLOURS = {
    'tracking': (0.20, 0.70, 0.95, 1.0),
    'doubtful': (1.0, 0.65, 0.10, 1.0),
    'initialising': (0.6, 0.6, 0.6, 1.0),
    'lost': (0.90, 0.15, 0.15, 1.0),
}
RED, SIGHT, SIGMA = (0.95, 0.10, 0.10, 1.0), (0.35, 0.85, 0.45, 0.6), (0.95, 0.85, 0.25, 0.35)
SIGHT_LENGTH = 0.1  # m; of the pyramids that show what a ToF sensor looks at
LINE, LETTERS = 0.0015, 0.02  # m
METRES_PER_NEWTON = 0.05  # of the arrows that show forces
SHOWN_SIGMAS = 3.0


def ring_names(robot: RobotDescription) -> tuple[str, ...]:
    """Names for the bodies of `poses`, the base first."""
    return (BASE, *robot.ring_names)


def ring_topics(robot: RobotDescription) -> tuple[str, ...]:
    """Topics of `ring_records`."""
    return tuple(family + name for family in (RING_POSE, RING_TWIST) for name in ring_names(robot))


def ring_records(frames: Frames, estimate: Estimate) -> Iterator[tuple[str, Any]]:
    """(topic, item) of each ring's pose and velocity with covariance, in the order of `poses`."""
    names = zip(ring_names(frames.robot), (frames.base, *frames.rings), strict=True)
    for number, (name, frame) in enumerate(names):
        yield (
            RING_POSE + name,
            TrackedPose(
                estimate.stamp, name, estimate.T_map_ring[number], estimate.covariance[number]
            ),
        )
        yield (
            RING_TWIST + name,
            TwistRecord(
                estimate.stamp,
                frame,
                estimate.velocity[number],
                estimate.velocity_covariance[number],
            ),
        )


def body_message(make: Messages, frames: Frames, estimate: Estimate) -> Any:
    """visualization_msgs/MarkerArray of an estimate; it replaces the one before."""
    header = header_message(make, estimate.stamp, frames.map)
    colour = COLOURS[estimate.status]
    markers = [
        _marker(make, header, 'all', 0, action=DELETE_ALL),
        _marker(
            make,
            header,
            'tube',
            0,
            type=LINE_STRIP,
            scale=_vector(make, (2.0 * frames.robot.radius, 0.0, 0.0)),
            color=_colour(make, colour),
            points=_points(make, estimate.T_map_backbone[:, :3, 3]),
        ),
        *_ellipsoids(make, header, estimate),
        *_sights(make, header, frames.robot, estimate),
        *_labels(make, header, frames.robot, estimate),
        *_loads(make, header, estimate),
    ]
    return make('visualization_msgs/msg/MarkerArray', markers=markers)


def ellipsoid(T_map_ring: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Principal axes and standard deviations of a ring's position.

    Returns (4, 4), whose axes are the principal ones, and (3,) [m], the smallest first.
    """
    variances, axes = np.linalg.eigh(covariance[:3, :3])
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    T_ring_axes = np.eye(4)
    T_ring_axes[:3, :3] = axes
    return T_map_ring @ T_ring_axes, np.sqrt(np.maximum(variances, 0.0))


def sight(robot: RobotDescription, sensor: Sensor, T_map_ring: np.ndarray) -> np.ndarray:
    """(16, 3) ends of the 8 edges of the pyramid that a ToF sensor sees, in the map."""
    half = np.tan(np.radians(robot.tof_model.fov_deg) / 2.0)
    corners = np.array([(1.0, y, z) for y, z in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    corners *= SIGHT_LENGTH * np.array([1.0, half, half])
    rim = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
    edges = np.stack([np.zeros_like(corners), corners], axis=1)
    T_map_sensor = T_map_ring @ sensor.mount.T_ring_sensor
    return (
        np.concatenate([edges, rim]).reshape(-1, 3) @ T_map_sensor[:3, :3].T + T_map_sensor[:3, 3]
    )


def _ellipsoids(make: Messages, header: Any, estimate: Estimate) -> Iterator[Any]:
    for number, pair in enumerate(zip(estimate.T_map_ring, estimate.covariance, strict=True)):
        T_map_axes, sigma = ellipsoid(*pair)
        yield _marker(
            make,
            header,
            'sigma',
            number,
            type=SPHERE,
            pose=pose_message(make, T_map_axes),
            scale=_vector(make, 2.0 * SHOWN_SIGMAS * np.maximum(sigma, 1e-6)),
            color=_colour(make, SIGMA),
        )


def _sights(
    make: Messages, header: Any, robot: RobotDescription, estimate: Estimate
) -> Iterator[Any]:
    """Two markers at most: the sights of those that are believed, and of those that are not."""
    T_of = dict(zip(robot.ring_names, estimate.T_map_ring[1:], strict=True))
    for number, (suspect, colour) in enumerate(((False, SIGHT), (True, RED))):
        shown = [
            sight(robot, sensor, T_of[sensor.ring])
            for sensor in robot.tof
            if (sensor.name in estimate.suspects) == suspect
        ]
        if shown:
            yield _marker(
                make,
                header,
                'tof',
                number,
                type=LINE_LIST,
                scale=_vector(make, (LINE, 0.0, 0.0)),
                color=_colour(make, colour),
                points=_points(make, np.concatenate(shown)),
            )


def _labels(
    make: Messages, header: Any, robot: RobotDescription, estimate: Estimate
) -> Iterator[Any]:
    """Name each suspect beside its ring, and say the reasons of a doubt at the base."""
    T_of = dict(zip(robot.ring_names, estimate.T_map_ring[1:], strict=True))
    rings = {sensor.name: sensor.ring for sensor in robot.sensors}
    texts = [
        (T_of[rings[name]] if name in rings else estimate.T_map_ring[0], f'{name}: {why}')
        for name, why in estimate.suspects.items()
    ]
    texts += [(estimate.T_map_ring[0], doubt) for doubt in estimate.doubts]
    for number, (T, text) in enumerate(texts):
        place = T.copy()
        place[2, 3] += (2 + number) * LETTERS
        yield _marker(
            make,
            header,
            'label',
            number,
            type=TEXT,
            pose=pose_message(make, place),
            scale=_vector(make, (0.0, 0.0, LETTERS)),
            color=_colour(make, RED),
            text=text,
        )


def _loads(make: Messages, header: Any, estimate: Estimate) -> Iterator[Any]:
    """Draw an arrow that ends where something pushes, METRES_PER_NEWTON long."""
    for number, load in enumerate(estimate.loads):
        ends = np.stack([load.place - METRES_PER_NEWTON * load.force, load.place])
        yield _marker(
            make,
            header,
            'load',
            number,
            type=ARROW,
            scale=_vector(make, (3.0 * LINE, 8.0 * LINE, 0.0)),
            color=_colour(make, RED),
            points=_points(make, ends),
        )


def _marker(make: Messages, header: Any, namespace: str, number: int, **fields: Any) -> Any:
    return make('visualization_msgs/msg/Marker', header=header, ns=namespace, id=number, **fields)


def _points(make: Messages, points: np.ndarray) -> list:
    point = make.resolve('geometry_msgs/msg/Point')
    return [point(x=x, y=y, z=z) for x, y, z in points.tolist()]


def _vector(make: Messages, values: Any) -> Any:
    x, y, z = (float(value) for value in values)
    return make('geometry_msgs/msg/Vector3', x=x, y=y, z=z)


def _colour(make: Messages, rgba: tuple[float, float, float, float]) -> Any:
    r, g, b, a = rgba
    return make('std_msgs/msg/ColorRGBA', r=r, g=g, b=b, a=a)
