"""
What the 3-D view and the moving picture show.

The surroundings near the robot, and its body at chosen instants.
"""

from __future__ import annotations

from dataclasses import dataclass

from continuum_loc.measurements import NANOSECONDS
from continuum_loc.offline.replay import Cloud, ReplayResult
from continuum_loc.trajectory import Trajectory
import numpy as np

POINTS_PER_SPAN = 9
# A picture shows the ToF points of the half second before its instant.
CLOUD_SPAN = NANOSECONDS // 2


@dataclass(frozen=True, eq=False)
class Surroundings:
    """
    Mesh and prior map points (P, 3) near the robot; either may be empty.

    The mesh is vertices (V, 3) and faces (F, 3).
    """

    vertices: np.ndarray
    faces: np.ndarray
    map_points: np.ndarray


@dataclass(frozen=True, eq=False)
class Moment:
    """
    The body at one instant.

    Estimated and true backbone (B, 3), estimated rings (R, 3), recent ToF points (M, 3). `truth`
    is empty where none was recorded.
    """

    stamp: int
    backbone: np.ndarray
    truth: np.ndarray
    rings: np.ndarray
    points: np.ndarray


def moments(
    result: ReplayResult, count: int, points: int, reach: float, extra: np.ndarray | None = None
) -> list[Moment]:
    """
    At most `count` evenly spaced instants of the run and those in `extra` (stamps).

    Each with at most `points` ToF points of those in the `swept_box`.
    """
    track = result.track
    if len(track) == 0:
        return []
    low, high = swept_box(result, reach)
    inside = np.all((result.cloud.points >= low) & (result.cloud.points <= high), axis=1)
    cloud = Cloud(result.cloud.stamps[inside], result.cloud.points[inside])
    chosen = np.unique(np.linspace(0, len(track) - 1, min(count, len(track))).round().astype(int))
    if extra is not None:
        chosen = np.union1d(chosen, np.searchsorted(track.stamps, extra).clip(0, len(track) - 1))
    estimated = track.backbone if track.backbone is not None else smooth_backbone(track.T_map_ring)
    return [
        Moment(
            int(track.stamps[k]),
            estimated[k],
            true_backbone(result.truth, int(track.stamps[k])),
            track.T_map_ring[k, 1:, :3, 3],
            recent_points(cloud, int(track.stamps[k]), points),
        )
        for k in chosen
    ]


def swept_box(result: ReplayResult, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Corners (3,), (3,) of the box that reaches `reach` [m] beyond all that the body swept."""
    track = result.track if len(result.track) else result.truth
    if len(track) == 0:
        return np.full(3, -np.inf), np.full(3, np.inf)
    body = smooth_backbone(track.T_map_ring).reshape(-1, 3)
    return body.min(axis=0) - reach, body.max(axis=0) + reach


def recent_points(cloud: Cloud, stamp: int, most: int) -> np.ndarray:
    """ToF points (M, 3) placed in the half second before `stamp`, thinned to `most` at most."""
    recent = cloud.points[(cloud.stamps > stamp - CLOUD_SPAN) & (cloud.stamps <= stamp)]
    return recent[:: max(1, -(-len(recent) // most))]


def true_backbone(truth: Trajectory, stamp: int) -> np.ndarray:
    """(B, 3) curve through the true poses at `stamp`; empty outside the recorded truth."""
    if len(truth) < 2 or not truth.stamps[0] <= stamp <= truth.stamps[-1]:
        return np.empty((0, 3))
    return smooth_backbone(truth.at(np.array([stamp])))[0]


def smooth_backbone(T_map_ring: np.ndarray) -> np.ndarray:
    """(K, B, 3) cubic Hermite curve through poses (K, R + 1, 4, 4) along their body x axes."""
    start, end = T_map_ring[:, :-1, None, :3], T_map_ring[:, 1:, None, :3]
    chord = np.linalg.norm(end[..., 3] - start[..., 3], axis=-1, keepdims=True)
    u = np.linspace(0.0, 1.0, POINTS_PER_SPAN)[None, None, :, None]
    curve = (
        (1 + 2 * u) * (1 - u) ** 2 * start[..., 3]
        + u * (1 - u) ** 2 * chord * start[..., 0]
        + u**2 * (3 - 2 * u) * end[..., 3]
        - u**2 * (1 - u) * chord * end[..., 0]
    )
    return curve.reshape(len(curve), -1, 3)


def surroundings(
    result: ReplayResult,
    mesh: tuple[np.ndarray, np.ndarray] | None,
    map_points: np.ndarray | None,
    reach: float,
    most_faces: int,
    most_points: int,
) -> Surroundings:
    """Cut mesh (vertices, faces) and map points inside the `swept_box`, thinned as given."""
    low, high = swept_box(result, reach)
    vertices, faces = np.empty((0, 3)), np.empty((0, 3), int)
    if mesh is not None:
        vertices, faces = thinned(*clipped(*mesh, low, high), most_faces)
    points = map_points if map_points is not None else np.empty((0, 3))
    points = points[np.all((points >= low) & (points <= high), axis=1)]
    return Surroundings(vertices, faces, points[:: max(1, -(-len(points) // most_points))])


def clipped(
    vertices: np.ndarray, faces: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Clip the mesh to an axis-aligned box, its faces cut at the box's sides."""
    from trimesh.intersections import slice_faces_plane

    vertices, faces = np.array(vertices), np.array(faces)
    low, high = np.clip(low, -1e6, 1e6), np.clip(high, -1e6, 1e6)  # planes need finite points
    for axis in range(3):
        for origin, sign in ((low, 1.0), (high, -1.0)):
            vertices, faces, _ = slice_faces_plane(vertices, faces, sign * np.eye(3)[axis], origin)
    return vertices, faces


def thinned(
    vertices: np.ndarray, faces: np.ndarray, most_faces: int
) -> tuple[np.ndarray, np.ndarray]:
    """Thin the mesh to at most about `most_faces` faces, by quadric decimation."""
    import open3d as o3d

    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(faces.astype(np.int32))
    )
    mesh.remove_duplicated_vertices()
    if len(faces) > most_faces:
        mesh = mesh.simplify_quadric_decimation(most_faces)
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles)
