"""
Exact nearest-neighbour lookup in a point cloud, as arrays that compiled kernels can use.

For a cell of space, occupied or not, a list names the few points that can be nearest to *some*
place inside it. A lookup costs one hash probe and a scan of a short list, sixteen points at a time
(`lanes`), however far it is from the surface and however large the map. Single precision finds the
points that may be nearest, double precision decides (`lookup`).

- The nearest of all points: lists for all space within reach, made at once (`candidates`).
- The nearest that *faces* a beam: lists for each cone of beam directions, made where beams are
  (`facing`).
- Beyond reach, and where there is no list yet: a search among points sorted by block (`grid`).

Answers never depend on which of them is used: of points at the same distance, the first in the
caller's order is taken. Because searches and lists for beams write to memory of the index, use one
(`VoxelIndex.copy`) per thread.
"""

from __future__ import annotations

from functools import cached_property

from continuum_loc.errors import MapError
from continuum_loc.mapping.candidates import near_cells, NearCells
from continuum_loc.mapping.facing import COUNTERS, empty_cache, TAKEN_AS_FILLED
from continuum_loc.mapping.grid import (
    AXIS_LIMIT,
    enter,
    Lattice,
    morton_codes,
    pack_all,
    span,
    table_size,
)
from continuum_loc.mapping.lanes import FAR, LANES, pack_lanes, SINGLE
from continuum_loc.mapping.lookup import nearest_batch, nearest_facing_batch, VoxelArrays
import numpy as np

POINTS_PER_CELL = 2.0  # mean over occupied ones; makes lists of a packed group or two
CELLS_PER_CUBE = 2.0  # along an edge, of those with lists made at once: of seven groups or so
CELLS_PER_BLOCK = 3.0  # along an edge
SORTED_PER_BLOCK = 8  # along an edge: cubes in whose order the points of a block are sorted
CUBES_PER_POINT = 1.5  # with lists made at once, at most
LARGEST = 1e9  # m; a cloud farther across is refused: its single precision would be of no use


class VoxelIndex:
    """
    Nearest-neighbour index of a fixed cloud; see the module's docstring for how it works.

    points: (P, 3) [m], finite, P >= 1. normals: (P, 3) unit, needed for `nearest_facing`.
    cell: edge of a cell [m], by default so that an occupied one holds two points or so.
    reach: largest distance [m] that is served at full speed; larger ones are exact too, but
    searched for.
    cache_cells: lists for `nearest_facing` kept at a time (about 1 kB each).
    """

    def __init__(
        self,
        points: np.ndarray,
        normals: np.ndarray | None = None,
        cell: float | None = None,
        reach: float = 0.1,
        cache_cells: int = 1 << 16,
    ):
        points = _checked_rows(points, 'points')
        given = points if normals is None else _checked_rows(normals, 'normals')
        if given.shape != points.shape:
            raise MapError(f'normals {given.shape} must match points {points.shape}')
        self._has_normals = normals is not None
        extent = float(np.ptp(points, axis=0).max())
        if extent > LARGEST:
            raise MapError(f'the cloud is {extent:.3g} m across; at most {LARGEST:g} m is valid')
        self.cell = float(cell) if cell is not None else _suitable_cell(points)
        if not self.cell > 0.0 or not 0.0 <= reach < np.inf:
            raise MapError(
                f'cell must be > 0 and reach >= 0 and finite, got cell {cell!r}, reach {reach!r}'
            )
        self._cache_cells, self._extent = int(cache_cells), extent
        self.arrays = _build(points, given, self.cell, float(reach), self._cache_cells)

    @cached_property
    def near(self) -> NearCells:
        """
        Return what `nearest` looks up in.

        It is made at first use, which takes about three times as long as the index itself.
        """
        arrays, lattice = self.arrays, self.arrays.lattice
        return near_cells(
            arrays.lanes,
            np.array([lattice.x0, lattice.y0, lattice.z0]),
            self._extent,
            CELLS_PER_CUBE * lattice.cell,
            arrays.reach,
            lattice.rounding,
            most=max(int(CUBES_PER_POINT * len(arrays.points)), 4096),
        )

    def prepare(self) -> VoxelIndex:
        """Make at once what `nearest` would make at its first call; return self."""
        _ = self.near
        return self

    def copy(self) -> VoxelIndex:
        """Return an index of the same cloud with a cache of its own (for another thread)."""
        twin = object.__new__(VoxelIndex)
        twin.__dict__.update(self.__dict__)
        sizes = len(self.arrays.block_at), len(self.arrays.lanes)
        twin.arrays = self.arrays._replace(**empty_cache(self._cache_cells, *sizes))
        return twin

    def reserve(self) -> VoxelIndex:
        """Take the cache's memory at once, not in the course of a long run; return self."""
        for name in TAKEN_AS_FILLED:
            getattr(self.arrays, name).fill(0)
        return self

    @property
    def cache_use(self) -> dict[str, int]:
        """
        Count `cells` with a list now, `groups` in the lists, lists `made`, and times `emptied`.

        The last two since the start.
        """
        counters = self.arrays.cell_slots[-COUNTERS:].ravel()
        return dict(zip(('cells', 'groups', 'made', 'emptied'), map(int, counters), strict=True))

    def nearest(
        self, queries: np.ndarray, max_distance: float = np.inf
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Rows (Q,) of the nearest points and distances (Q,) [m] for queries (Q, 3).

        They are -1 and inf where none is nearer than max_distance [m]. Of equally near points the
        first is taken.
        """
        queries = _checked_queries(queries)
        index, gap2 = np.empty(len(queries), np.int64), np.empty(len(queries))
        nearest_batch(self.arrays, self.near, queries, float(max_distance), index, gap2)
        return index, np.sqrt(gap2)

    def nearest_facing(
        self,
        queries: np.ndarray,
        directions: np.ndarray,
        max_distance: float = np.inf,
        min_cos: float = 0.0,
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        As `nearest`, among points whose normals face the rays.

        A normal n faces the ray direction d of (Q, 3) where -(n . d) >= min_cos.
        """
        if not self._has_normals:
            raise MapError('nearest_facing needs an index made with normals')
        queries = _checked_queries(queries)
        directions = np.ascontiguousarray(directions, dtype=np.float64)
        if directions.shape != queries.shape:
            directions = np.ascontiguousarray(np.broadcast_to(directions, queries.shape))
        index, gap2 = np.empty(len(queries), np.int64), np.empty(len(queries))
        nearest_facing_batch(
            self.arrays, queries, directions, float(max_distance), float(min_cos), index, gap2
        )
        return index, np.sqrt(gap2)


def _checked_rows(rows: np.ndarray, name: str) -> np.ndarray:
    rows = np.ascontiguousarray(rows, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != 3 or len(rows) == 0:
        raise MapError(f'{name} must be (P, 3) with P >= 1, got {rows.shape}')
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if len(bad):
        raise MapError(
            f'{name}: {len(bad)} of {len(rows)} rows are not finite, the first is row {bad[0]}'
        )
    return rows


def _checked_queries(queries: np.ndarray) -> np.ndarray:
    queries = np.ascontiguousarray(queries, dtype=np.float64)
    if queries.ndim != 2 or queries.shape[1] != 3:
        raise MapError(f'queries must be (Q, 3), got {queries.shape}')
    return queries


def _suitable_cell(points: np.ndarray) -> float:
    """Edge at which occupied cells hold about POINTS_PER_CELL points, for points on a surface."""
    extent = float(np.ptp(points, axis=0).max())
    if extent == 0.0:
        return 1.0
    origin = points.min(axis=0)
    smallest = extent / (AXIS_LIMIT // 2)
    cell = max(extent * np.sqrt(POINTS_PER_CELL / len(points)), smallest)
    for _ in range(4):  # occupancy grows as the square of the cell
        occupied = 1 + np.count_nonzero(np.diff(np.sort(morton_codes(points, origin, 1.0 / cell))))
        cell = max(cell * np.sqrt(POINTS_PER_CELL * occupied / len(points)), smallest)
        if cell >= extent:
            return extent
    return cell


def _build(
    points: np.ndarray, normals: np.ndarray, cell: float, reach: float, cache_cells: int
) -> VoxelArrays:
    origin, block = points.min(axis=0), CELLS_PER_BLOCK * cell
    extent = np.ptp(points, axis=0).max()
    if np.floor(extent / cell) >= AXIS_LIMIT:
        raise MapError(
            f'cell {cell} m is too small for a cloud {extent:.6g} m across; '
            f'at most {AXIS_LIMIT} cells fit along an axis'
        )
    order, first, at = _sorted_by_block(points, origin, block)
    spans = span(first, np.diff(first, append=len(points)))
    slots = np.full((table_size(4 * len(first)), 2), -1, np.int64)
    enter(pack_all(at.astype(np.int64)), spans, slots)
    lanes = pack_lanes(points[order] - origin, FAR)
    return VoxelArrays(
        points=_filled(np.column_stack([points[order], order.astype(np.float64)]), np.inf),
        normals=_filled(normals[order], 0.0),
        lanes=lanes,
        faces=pack_lanes(normals[order], np.nan),
        block_slots=slots,
        block_spans=spans,
        block_at=at,
        lattice=Lattice(
            *map(float, origin),
            *(block, 1.0 / block),
            *(cell, 1.0 / cell),
            *map(int, at.max(axis=0) + 1),
            rounding=float(4.0 * SINGLE * (extent + 2.0 * (reach + cell))),
        ),
        reach=reach,
        **empty_cache(cache_cells, len(first), len(lanes)),
    )


def _sorted_by_block(
    points: np.ndarray, origin: np.ndarray, block: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    (order (P,) of the points, where each block begins (B,), its place (B, 3) in blocks).

    Within a block they lie in the order of smaller cubes, so that sixteen in a row are close.
    """
    inverse = 1.0 / block
    order = np.argsort(morton_codes(points, origin, SORTED_PER_BLOCK * inverse), kind='stable')
    blocks = morton_codes(points, origin, inverse)[order]
    first = np.flatnonzero(np.diff(blocks, prepend=-1))
    return order, first, np.floor((points[order[first]] - origin) * inverse)


def _filled(rows: np.ndarray, value: float) -> np.ndarray:
    """Rows with more of this value, so that they are a whole number of groups."""
    spare = -len(rows) % LANES
    return np.concatenate([rows, np.full((spare, rows.shape[1]), value)])


def spatial_order(points: np.ndarray, edge: float) -> np.ndarray:
    """Rows (P,) of the points along a Morton curve through cubes of this edge [m]."""
    return np.argsort(morton_codes(points, points.min(axis=0), 1.0 / edge), kind='stable')
