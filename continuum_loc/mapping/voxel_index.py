"""
Exact nearest-neighbour lookup in a point cloud, as arrays that compiled kernels can use.

Points are sorted by block, a cube of some twenty of them; a hash table finds a block by its place
(`grid`), and a lookup searches blocks around a place, the nearest first (`lookup`).
"""

from __future__ import annotations

from continuum_loc.errors import MapError
from continuum_loc.formats.shapes import finite_rows
from continuum_loc.mapping.grid import AXIS_BITS, hash_table, MORTON_BITS, morton_codes
from continuum_loc.mapping.lookup import Lattice, nearest_facing_batch, VoxelArrays
import numpy as np

# A block is so many cubes along an edge, of which occupied ones hold so many points on average.
CUBES_PER_BLOCK, POINTS_PER_CUBE = 3.0, 2.0
# Within a block points lie in the order of smaller cubes (8 along an edge), so that what else is
# equal is decided by where points are and hardly by how the caller's cloud is ordered.
ORDER_BITS = 3
MOST_BLOCKS = 1 << min(AXIS_BITS, MORTON_BITS - ORDER_BITS)  # along an axis
LARGEST = 1e9  # m; farther across, double precision tells no two places apart within 0.1 um
SMALLEST = 1e-9  # m; points closer together than this share a block


class VoxelIndex:
    """
    Nearest-neighbour index of a fixed cloud.

    points: (P, 3) [m], finite, P >= 1. normals: (P, 3) unit. edge: of a block [m], by default so
    that an occupied one holds some twenty points of a surface.
    Lookups only read `arrays`, so that any number of users may share an index.
    """

    def __init__(self, points: np.ndarray, normals: np.ndarray, edge: float | None = None):
        points = finite_rows(points, 'points', 'index')
        normals = finite_rows(normals, 'normals', 'index')
        if normals.shape != points.shape:
            raise MapError(f'normals {normals.shape} must match points {points.shape}')
        extent = float(np.ptp(points, axis=0).max())
        if extent > LARGEST:
            raise MapError(f'the cloud is {extent:.3g} m across; at most {LARGEST:g} m is valid')
        edge = _suitable_edge(points, extent) if edge is None else float(edge)
        if not 0.0 < edge < np.inf:
            raise MapError(f'edge must be > 0 and finite, got {edge}')
        if extent / edge >= MOST_BLOCKS - 1:
            raise MapError(
                f'blocks of {edge} m are too small for a cloud {extent:.6g} m across; '
                f'at most {MOST_BLOCKS} fit along an axis'
            )
        self.arrays = _sorted_by_block(points, normals, edge)

    @property
    def memory_bytes(self) -> int:
        """Size of all arrays."""
        return sum(array.nbytes for array in self.arrays if isinstance(array, np.ndarray))

    def nearest(
        self, queries: np.ndarray, max_distance: float = np.inf
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Rows (Q,) of the nearest points and distances (Q,) [m] for queries (Q, 3).

        They are -1 and inf where none is nearer than max_distance [m]. Of equally near points the
        first is taken. Raises MapError for queries of another shape.
        """
        return self.nearest_facing(queries, np.zeros(3), max_distance, -1.0)

    def nearest_facing(
        self,
        queries: np.ndarray,
        directions: np.ndarray,
        max_distance: float = np.inf,
        min_cosine: float = 0.0,
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        As `nearest`, among points whose normals face the beams.

        A normal n faces the unit direction d, of (Q, 3) or (3,), where -(n . d) >= min_cosine.
        """
        queries = np.ascontiguousarray(queries, dtype=np.float64)
        if queries.ndim != 2 or queries.shape[1] != 3:
            raise MapError(f'queries must be (Q, 3), got {queries.shape}')
        directions = np.asarray(directions, dtype=np.float64)
        if directions.shape not in (queries.shape, (3,)):
            raise MapError(
                f'directions must be {queries.shape}, as the queries, or (3,), '
                f'got {directions.shape}'
            )
        directions = np.ascontiguousarray(np.broadcast_to(directions, queries.shape))
        found, distance2 = np.empty(len(queries), np.int64), np.empty(len(queries))
        nearest_facing_batch(
            self.arrays,
            queries,
            directions,
            float(max_distance),
            float(min_cosine),
            found,
            distance2,
        )
        return found, np.sqrt(distance2)


def _suitable_edge(points: np.ndarray, extent: float) -> float:
    """Edge [m] of a block, from the cube that holds POINTS_PER_CUBE points of a surface."""
    if extent < SMALLEST:
        return 1.0  # all in one block
    corner = points.min(axis=0)
    smallest = 2.0 * extent / MOST_BLOCKS
    cube = max(extent * np.sqrt(POINTS_PER_CUBE / len(points)), smallest)
    for _ in range(4):  # occupancy grows as the square of the edge
        occupied = 1 + np.count_nonzero(np.diff(np.sort(morton_codes(points, corner, 1.0 / cube))))
        cube = max(cube * np.sqrt(POINTS_PER_CUBE * occupied / len(points)), smallest)
        if cube >= extent:
            cube = extent
            break
    return max(CUBES_PER_BLOCK * float(cube), SMALLEST)


def _sorted_by_block(points: np.ndarray, normals: np.ndarray, edge: float) -> VoxelArrays:
    corner, inverse_edge = points.min(axis=0), 1.0 / edge
    codes = morton_codes(points, corner, (1 << ORDER_BITS) * inverse_edge)
    order = np.argsort(codes, kind='stable')
    first = np.flatnonzero(np.diff(codes[order] >> (3 * ORDER_BITS), prepend=-1))
    places = np.floor((points[order[first]] - corner) * inverse_edge).astype(np.int64)
    lattice = Lattice(
        tuple(corner.tolist()), edge, inverse_edge, tuple((places.max(axis=0) + 1).tolist())
    )
    return VoxelArrays(
        points[order],
        normals[order],
        order,
        np.append(first, len(points)),
        places,
        hash_table(places),
        lattice,
    )
