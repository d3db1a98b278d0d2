"""Ray casting: the scene by Embree (through Open3D), the robot's own body as capsules by a compiled kernel."""

from __future__ import annotations

import numpy as np
from numba import njit

from continuum_loc.simulator.scenes import Scene


class RayCaster:
    """Casts rays against a scene's mesh. Single precision inside: about 1e-7 of the distance."""

    def __init__(self, scene: Scene, threads: int = 1) -> None:
        import open3d

        self.scene = scene
        self._tensor = open3d.core.Tensor
        self._embree = open3d.t.geometry.RaycastingScene(nthreads=threads)
        self._embree.add_triangles(
            self._tensor(scene.vertices.astype(np.float32)), self._tensor(scene.faces.astype(np.uint32)))
        self._invalid = self._embree.INVALID_ID

    def cast(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """First hits of N rays, given origins (N, 3) [m] and unit directions (N, 3) in the map frame.

        Returns distance (N,) [m], inf where nothing is hit; face (N,) int64, -1 where nothing is hit; and the
        unit normal (N, 3) of the face, nan where nothing is hit.
        """
        rays = np.concatenate([origins, directions], axis=1, dtype=np.float32)
        hits = self._embree.cast_rays(self._tensor(rays))
        faces = hits["primitive_ids"].numpy()
        missed = faces == self._invalid
        faces = np.where(missed, -1, faces.astype(np.int64))
        normals = np.where(missed[:, None], np.nan, self.scene.face_normals[faces])
        return hits["t_hit"].numpy().astype(float), faces, normals


@njit(cache=True)
def cast_capsules(origins: np.ndarray, directions: np.ndarray, capsules: np.ndarray) -> np.ndarray:
    """Distance (N,) along unit rays to the first of M capsules, inf where none is hit.

    Each capsule (M, 7) is ax ay az bx by bz radius: all points within `radius` of the segment from a to b.
    Only entering hits count: a sensor inside a capsule (its own mount) looks through that capsule.
    """
    nearest = np.full(len(origins), np.inf)
    for j in range(len(capsules)):
        a, b, radius = capsules[j, 0:3], capsules[j, 3:6], capsules[j, 6]
        centre = 0.5 * (a + b)
        reach = 0.5 * np.sqrt(np.sum((b - a) ** 2)) + radius
        for i in range(len(origins)):
            if _misses_ball(origins[i], directions[i], centre, reach, nearest[i]):
                continue
            nearest[i] = min(nearest[i], _capsule_entry(origins[i], directions[i], a, b, radius))
    return nearest


@njit(cache=True, inline="always")
def _misses_ball(origin, direction, centre, reach, limit):
    """True where a ray cannot meet the ball before `limit`: sifts out nearly all pairs cheaply."""
    x, y, z = centre[0] - origin[0], centre[1] - origin[1], centre[2] - origin[2]
    along = x * direction[0] + y * direction[1] + z * direction[2]
    squared = x * x + y * y + z * z
    return squared - along * along > reach * reach or along < -reach or along - reach > limit


@njit(cache=True)
def _capsule_entry(origin, direction, a, b, radius):
    """Distance at which a ray enters a capsule, inf if it does not (or starts inside)."""
    axis, offset = b - a, origin - a
    axis_axis, axis_direction, axis_offset = np.dot(axis, axis), np.dot(axis, direction), np.dot(axis, offset)
    quadratic = axis_axis - axis_direction * axis_direction
    if quadratic > 1e-12 * axis_axis:
        linear = axis_axis * np.dot(direction, offset) - axis_offset * axis_direction
        constant = axis_axis * (np.dot(offset, offset) - radius * radius) - axis_offset * axis_offset
        discriminant = linear * linear - quadratic * constant
        if discriminant < 0.0:
            return np.inf
        distance = (-linear - np.sqrt(discriminant)) / quadratic
        station = axis_offset + distance * axis_direction
        if 0.0 < station < axis_axis:
            return distance if distance > 0.0 and not _inside(origin, a, b, radius) else np.inf
    if _inside(origin, a, b, radius):
        return np.inf
    return min(_ball_entry(offset, direction, radius), _ball_entry(origin - b, direction, radius))


@njit(cache=True)
def _ball_entry(offset, direction, radius):
    along = np.dot(direction, offset)
    discriminant = along * along - np.dot(offset, offset) + radius * radius
    if discriminant < 0.0:
        return np.inf
    distance = -along - np.sqrt(discriminant)
    return distance if distance > 0.0 else np.inf


@njit(cache=True)
def _inside(point, a, b, radius):
    axis = b - a
    squared = np.dot(axis, axis)
    station = 0.0
    if squared > 0.0:
        station = min(max(np.dot(point - a, axis) / squared, 0.0), 1.0)
    gap = point - a - station * axis
    return np.dot(gap, gap) <= radius * radius
