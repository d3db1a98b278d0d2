"""
Whether a robot fits where it is put: free way for the straight robot, and a scene within sight.

The simulation starts from the straight robot. One that begins inside of matter is pushed out by
contacts wherever they will, or stays there for good.
"""

from __future__ import annotations

from continuum_loc.errors import SceneError
from continuum_loc.robot import RobotDescription
from continuum_loc.simulator.raycast import RayCaster
from continuum_loc.simulator.scene import Scene
import numpy as np

_MOUNT = 2.0  # radii next to the base that may be inside of what it is mounted on


def check_start(
    robot: RobotDescription, scene: Scene, s: np.ndarray, points: np.ndarray, depth: np.ndarray
) -> None:
    """
    Raise SceneError where the straight robot is inside of matter, or out of sight of the scene.

    s: (N,) arclengths of its nodes; points: (N, 3) their places in map; depth: (N,) how deep each
    link is in contact pieces [m].
    """
    free = _free_way(scene, points)
    inside = (s > _MOUNT * robot.radius) & ((free < 0.0) | (depth > robot.radius / 2.0))
    if inside.any():
        at = int(np.argmax(inside))
        raise SceneError(
            f"scene '{scene.name}': the straight robot '{robot.name}', from which the simulation "
            f'starts, is inside of matter at s = {s[at]:.3g} m, {_place(points[at])}: move the '
            'mesh or base.xyz. In a mesh of your own faces look into free space: outward on a '
            'solid, inward on the inner surface of a room'
        )
    sight = robot.length + (robot.tof_model.max_range if robot.tof else 0.0)
    if np.abs(free).min() > sight:
        low, high = scene.vertices.min(axis=0), scene.vertices.max(axis=0)
        raise SceneError(
            f"scene '{scene.name}' lies {np.abs(free).min():.3g} m away from robot "
            f"'{robot.name}', out of its reach and sight ({sight:.3g} m): it spans {_place(low)} "
            f'to {_place(high)}, the base is at {_place(points[0])}. Both are in the map frame, '
            'in metres'
        )


def _free_way(scene: Scene, points: np.ndarray) -> np.ndarray:
    """Distance (N,) to the surface [m], negative in matter: what a mesh encloses, or a room's."""
    clearance = RayCaster(scene).clearance(points)
    a, b, c = (scene.vertices[scene.faces[:, i]] for i in range(3))
    is_room = np.einsum('ij,ij->', np.cross(a, b), c) < 0.0
    return -clearance if is_room else clearance


def _place(point: np.ndarray) -> str:
    return f'({", ".join(f"{value:.3f}" for value in point)})'
