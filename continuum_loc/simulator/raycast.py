"""Ray casting: the scene by Embree (through Open3D), the robot's own body by a compiled kernel."""

from __future__ import annotations

from continuum_loc.compiling import kernel
from continuum_loc.extras import require
from continuum_loc.simulator.scene import Scene
import numpy as np

_INSIDE_RAYS = 5  # odd


class RayCaster:
    """Casts rays against a scene's mesh. Single precision inside: about 1e-7 of the distance."""

    def __init__(self, scene: Scene, threads: int = 1) -> None:
        open3d = require('open3d', 'simulate')

        self.scene = scene
        self._tensor = open3d.core.Tensor
        self._embree = open3d.t.geometry.RaycastingScene(nthreads=threads)
        self._embree.add_triangles(
            self._tensor(scene.vertices.astype(np.float32)),
            self._tensor(scene.faces.astype(np.uint32)),
        )
        self._invalid = self._embree.INVALID_ID

    def cast(
        self, origins: np.ndarray, directions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """
        First hits of N rays, given origins (N, 3) [m] and unit directions (N, 3) in the map frame.

        Returns distance (N,) [m], inf where nothing is hit; face (N,) int64, -1 where nothing is
        hit; and the unit normal (N, 3) of the face, nan where nothing is hit.
        """
        distance, faces = self._hits(origins, directions)
        return (
            distance,
            faces,
            np.where((faces < 0)[:, None], np.nan, self.scene.face_normals[faces]),
        )

    def cast_light(
        self, origins: np.ndarray, directions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Distance (N,) as by `cast`, and the share (N,) of light that comes back from there.

        That is the reflectance times the cosine of incidence, 0 where nothing is hit.
        """
        distance, faces = self._hits(origins, directions)
        scene = self.scene
        return distance, _brightness(faces, directions, scene.face_normals, scene.reflectance)

    def _hits(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rays = np.concatenate([origins, directions], axis=1, dtype=np.float32)
        hits = self._embree.cast_rays(self._tensor(rays))
        faces = hits['primitive_ids'].numpy()
        faces = np.where(faces == self._invalid, -1, faces.astype(np.int64))
        return hits['t_hit'].numpy().astype(float), faces

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """Distance (N,) from points (N, 3) to the nearest surface [m], negative inside solids."""
        # A majority of rays tells inside from outside: a single one errs where it grazes an edge.
        found = self._embree.compute_signed_distance(
            self._tensor(np.asarray(points, np.float32)), nsamples=_INSIDE_RAYS
        )
        return found.numpy().astype(float)


@kernel
def _brightness(faces, directions, normals, reflectance):
    light = np.zeros(faces.shape[0])
    for k in range(faces.shape[0]):
        if faces[k] >= 0:
            light[k] = reflectance[faces[k]] * abs(_dot(normals[faces[k]], directions[k]))
    return light


@kernel
def cast_capsules(origins: np.ndarray, directions: np.ndarray, capsules: np.ndarray) -> np.ndarray:
    """
    Distance (S, K) along the K unit rays of S fans to the first of M capsules; inf for none.

    origins: (S, 3). directions: (S, K, 3). Each capsule (M, 7) is ax ay az bx by bz radius: all
    points within `radius` of the segment from a to b. A fan that starts inside a capsule (its own
    mount) looks through it.
    """
    fans, rays = directions.shape[:2]
    nearest = np.full((fans, rays), np.inf)
    for i in range(fans):
        cone_axis, half_angle = _enclosing_cone(directions[i])
        for j in range(len(capsules)):
            axis, offset, radius = (
                capsules[j, 3:6] - capsules[j, 0:3],
                origins[i] - capsules[j, 0:3],
                capsules[j, 6],
            )
            if _outside_cone(cone_axis, half_angle, axis, offset, radius):
                continue
            axis_axis, axis_offset, offset_offset = (
                _dot(axis, axis),
                _dot(axis, offset),
                _dot(offset, offset),
            )
            if _inside(axis_axis, axis_offset, offset_offset, radius):
                continue
            for k in range(rays):
                entry = _capsule_entry(
                    axis_axis,
                    axis_offset,
                    offset_offset,
                    _dot(axis, directions[i, k]),
                    _dot(offset, directions[i, k]),
                    radius,
                )
                nearest[i, k] = min(nearest[i, k], entry)
    return nearest


@kernel
def _enclosing_cone(directions):
    """Axis (3,) and half angle of a cone round a fan's rays."""
    axis = np.zeros(3)
    for k in range(len(directions)):
        axis += directions[k]
    axis /= max(np.sqrt(_dot(axis, axis)), 1e-12)
    cosine = 1.0
    for k in range(len(directions)):
        cosine = min(cosine, _dot(axis, directions[k]))
    return axis, np.arccos(max(-1.0, cosine))


@kernel
def _outside_cone(cone_axis, half_angle, axis, offset, radius):
    """Tell where a capsule's ball is clear of the fan's cone, as most of the body is."""
    to_centre = 0.5 * axis - offset
    reach = 0.5 * np.sqrt(_dot(axis, axis)) + radius
    distance = np.sqrt(_dot(to_centre, to_centre))
    if distance <= reach:
        return False
    angle = np.arccos(max(-1.0, min(1.0, _dot(cone_axis, to_centre) / distance)))
    return angle > half_angle + np.arcsin(reach / distance)


# A ray from o along unit d against a capsule from a along v needs only the products of v, w = o -
# a and d: below, vv, vw, ww are those of the capsule and the origin, vd and wd those with the
# ray's direction.


@kernel
def _capsule_entry(vv, vw, ww, vd, wd, radius):
    """Distance at which a ray from outside enters a capsule, inf if it does not."""
    quadratic = vv - vd * vd
    if quadratic > 1e-12 * vv:
        linear = vv * wd - vw * vd
        discriminant = linear * linear - quadratic * (vv * (ww - radius * radius) - vw * vw)
        if discriminant < 0.0:
            return np.inf
        distance = (-linear - np.sqrt(discriminant)) / quadratic
        if 0.0 < vw + distance * vd < vv:
            return distance if distance > 0.0 else np.inf
    return min(_ball_entry(ww, wd, radius), _ball_entry(ww - 2.0 * vw + vv, wd - vd, radius))


@kernel
def _ball_entry(ww, wd, radius):
    discriminant = wd * wd - ww + radius * radius
    if discriminant < 0.0:
        return np.inf
    distance = -wd - np.sqrt(discriminant)
    return distance if distance > 0.0 else np.inf


@kernel
def _inside(vv, vw, ww, radius):
    """Tell where the origin lies within the capsule."""
    station = min(max(vw / vv, 0.0), 1.0) if vv > 0.0 else 0.0
    return ww - 2.0 * station * vw + station * station * vv <= radius * radius


@kernel
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
