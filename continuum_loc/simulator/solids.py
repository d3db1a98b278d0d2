"""
Solids for procedural scenes: parts, their watertight union, and how to place them.

Map frame throughout; metres. `azimuth` turns about the map's x axis, from +z (0 deg) towards +y.
"""

from __future__ import annotations

from dataclasses import dataclass

from manifold3d import CrossSection, Manifold, Mesh64, OpType
import numpy as np

Hulls = tuple[np.ndarray, ...]

# Slivers thinner than this [m] are collapsed: single-precision ray casters slip through them.
_ROBUST_EDGE = 1e-5


@dataclass(frozen=True, eq=False)
class Part:
    """
    A named solid, and what stands for it.

    In contact its convex pieces (n, 3); to a ToF sensor how much of its infrared light it reflects
    (0..1, at normal incidence).
    """

    name: str
    solid: Manifold
    hulls: Hulls = ()
    reflectance: float = 0.5


def convex_part(name: str, solid: Manifold, reflectance: float = 0.5) -> Part:
    """Make a part which is its own contact piece; `solid` must be convex (or nearly)."""
    return Part(name, solid, (vertices_of(solid),), reflectance)


def unite(parts: list[Part]) -> tuple[Manifold, np.ndarray]:
    """Union of all parts, and the index (F,) int32 of the part that each of its faces is of."""
    originals = [part.solid.as_original() for part in parts]
    union = Manifold.batch_boolean(originals, OpType.Add).simplify(_ROBUST_EDGE)
    mesh = union.to_mesh64()
    part_of_id = {original.original_id(): index for index, original in enumerate(originals)}
    runs = np.asarray(mesh.run_index, dtype=np.int64) // 3
    owners = [part_of_id[int(run)] for run in mesh.run_original_id]
    return union, np.repeat(np.array(owners, dtype=np.int32), np.diff(runs))


def mesh_of(solid: Manifold) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float64 and faces (F, 3) int32 of a solid, in the order of Manifold."""
    mesh = solid.to_mesh64()
    return np.ascontiguousarray(mesh.vert_properties[:, :3]), mesh.tri_verts.astype(np.int32)


def vertices_of(solid: Manifold) -> np.ndarray:
    """(V, 3) vertices of a solid."""
    return mesh_of(solid)[0]


def solid_of(vertices: np.ndarray, faces: np.ndarray) -> Manifold:
    """Make the solid inside a mesh. Raises ValueError where that is not closed and oriented."""
    # Copies: the binding takes no read-only arrays.
    solid = Manifold(
        Mesh64(np.array(vertices, dtype=np.float64, order='C'), faces.astype(np.uint64))
    )
    if solid.is_empty():
        raise ValueError(f'not a closed, oriented surface: {solid.status()}')
    return solid


def box(size: tuple[float, float, float]) -> Manifold:
    """Make a cuboid centred on the origin."""
    return Manifold.cube(size, center=True)


def cylinder(radius: float, height: float, segments: int = 32) -> Manifold:
    """Make a cylinder centred on the origin, its axis z."""
    return Manifold.cylinder(height, radius, radius, segments, center=True)


def on_cylinder(
    solid: Manifold, x: float, azimuth_deg: float, radius: float, turn_deg: float = 0.0
) -> Manifold:
    """
    Move a solid to a place on the engine's wall.

    Its z becomes radial (outward), its x axial, its y circumferential, after a turn about its own
    z.
    """
    radial = radial_direction(azimuth_deg)
    rotation = np.column_stack([[1.0, 0.0, 0.0], tangent_direction(azimuth_deg), radial])
    position = radius * radial + np.array([x, 0.0, 0.0])
    return solid.rotate((0.0, 0.0, turn_deg)).transform(np.column_stack([rotation, position]))


def radial_direction(azimuth_deg: float) -> np.ndarray:
    """(3,) unit vector away from the map's x axis."""
    azimuth = np.radians(azimuth_deg)
    return np.array([0.0, np.sin(azimuth), np.cos(azimuth)])


def tangent_direction(azimuth_deg: float) -> np.ndarray:
    """(3,) unit vector of growing azimuth."""
    azimuth = np.radians(azimuth_deg)
    return np.array([0.0, np.cos(azimuth), -np.sin(azimuth)])


def wrap(x: np.ndarray, azimuth: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """(..., 3) points from cylindrical coordinates about the map's x axis (azimuth in radians)."""
    x, azimuth, radius = np.broadcast_arrays(x, azimuth, radius)
    return np.stack([x, radius * np.sin(azimuth), radius * np.cos(azimuth)], axis=-1)


def lathe(
    profile: np.ndarray, segments: int, azimuth_deg: tuple[float, float] = (-180.0, 180.0)
) -> Manifold:
    """Revolve a profile (n, 2) of (x, r) about the map's x axis over a range of azimuth."""
    profile = np.asarray(profile, dtype=float)
    radius_x = profile[:, ::-1]
    if _signed_area(radius_x) < 0.0:
        radius_x = radius_x[::-1]
    span = azimuth_deg[1] - azimuth_deg[0]
    turned = CrossSection([radius_x]).revolve(segments, span)
    # revolve() turns from local x about local z; send (x, y, z) to the map's (y, z, x), then to
    # the first azimuth.
    turned = turned.transform([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0]])
    return turned.rotate((90.0 - azimuth_deg[1], 0.0, 0.0))


def loft(sections: np.ndarray) -> Manifold:
    """
    Make the solid through closed sections (m, n, 3).

    Each has n points, first half on one side and second half on the other in reverse, so that
    point i faces point n-1-i (the caps join them).
    """
    stations, around = sections.shape[:2]
    ring = np.arange(around)
    following = np.roll(ring, -1)
    base = np.arange(stations - 1)[:, None] * around
    lower = np.stack([base + ring, base + following, base + around + following], axis=-1).reshape(
        -1, 3
    )
    upper = np.stack(
        [base + ring, base + around + following, base + around + ring], axis=-1
    ).reshape(-1, 3)
    cap = _cap(around)
    faces = np.concatenate([lower, upper, cap[:, ::-1], cap + (stations - 1) * around])
    return _outward(sections.reshape(-1, 3), faces)


def _cap(around: int) -> np.ndarray:
    near = np.arange(around // 2 - 1)
    far = around - 1 - near
    return np.concatenate(
        [np.stack([near, near + 1, far - 1], axis=-1), np.stack([near, far - 1, far], axis=-1)]
    )


def _outward(vertices: np.ndarray, faces: np.ndarray) -> Manifold:
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    if np.einsum('ij,ij->', np.cross(a, b), c) < 0.0:
        faces = faces[:, ::-1]
    return solid_of(vertices, faces)


def _signed_area(polygon: np.ndarray) -> float:
    x, y = polygon.T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def cut_hulls(hulls: Hulls, cutter: Manifold) -> Hulls:
    """Keep what is left of convex pieces beyond a cutter (each remainder is hulled again)."""
    remainders = [Manifold.hull_points(hull) - cutter for hull in hulls]
    return tuple(vertices_of(rest.hull()) for rest in remainders if not rest.is_empty())
