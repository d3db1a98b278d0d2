"""
Exact nearest-neighbour lookup in a point cloud, as arrays that compiled kernels can use.

For a cell of space, occupied or not, a list names the few groups of sixteen points that can hold
the nearest one to *some* place inside it (`candidates`). A lookup costs one hash probe and a scan
of a short list, sixteen points at a time (`lanes`), however far it is from the surface and however
large the map. Single precision finds the points that may be nearest, double precision decides.

- The nearest of all points: lists of all space within reach, made at once (`near_cells`).
- The nearest that *faces* a beam: lists for each cone of beam directions too, made where beams
  are (`facing`).
- Beyond reach, and where there is no list yet: a search of the grid (`grid`).

Answers never depend on which of them is used: of points at the same distance, the first in the
caller's order is taken. Because lookups of what faces write to a cache, use one index
(`VoxelIndex.copy`) per thread.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

from continuum_loc.mapping.candidates import find_near_lists, near_cells, NearCells
from continuum_loc.mapping.errors import MapError
from continuum_loc.mapping.facing import COUNTERS, empty_cache, find_facing_lists, forget_lists
from continuum_loc.mapping.grid import (
    AXIS_LIMIT,
    distance2,
    enter,
    in_range,
    Lattice,
    morton_codes,
    pack_all,
    search,
    span,
    table_size,
    toward,
)
from continuum_loc.mapping.lanes import (
    COS_ERROR,
    facing_lanes,
    FAR,
    LANES,
    lowest_lane,
    near_lanes,
    pack_lanes,
    SINGLE,
    slack2,
    two_nearest,
    two_nearest_facing,
)
from numba import njit
import numpy as np

POINTS_PER_CELL = 2.0  # mean over occupied ones; makes lists of a group or two
CELLS_PER_CUBE = (
    2.0  # along an edge, of those with lists made at once: lists of seven groups or so
)
CELLS_PER_BLOCK = 3.0  # along an edge
SCRATCH = ('scratch', 'scratch_gap2', 'marks')
SORTED_PER_BLOCK = 8  # along an edge: cubes in whose order the points of a block are sorted
CUBES_PER_POINT = 1.5  # at most
LARGEST = 1e9  # m; a cloud farther across is refused: its single precision would be of no use


class VoxelArrays(NamedTuple):
    """
    The index as arrays.

    Kernels take it whole and unpack it outside their loops: handing so many arrays on takes
    longer than most lookups. Only the last eight arrays are ever written.

    points: (16 G, 4) x, y, z [m] and the row in the caller's cloud, sorted by block; the last
        group is filled up with points at infinity. normals: (16 G, 3).
    lanes, faces: (G, 3, 16) points, from the lattice's corner, and normals in groups.
    block_slots: (H, 2) hash table from a block's key to its span of sorted points.
    block_spans: (B,) all of them; block_at: (B, 3) each block's place, in blocks.
    reach: distance [m] up to which lists are made.
    cell_slots: (C + COUNTERS, 2) hash table from a cell's and cone's key to their packed list
        (start * 2^16 + length), to minus the number of visits so far, or to CROWDED.
    list_lanes, list_faces: (L, 3, 16) packed groups of the lists, end to end.
    list_points: (L, 16) their points' rows of `points`.
    scratch, scratch_gap2: (B,) spans of the blocks that a search is about to look at, and their
        squared distances in blocks.
    marks: (G,) the last list for which a group was looked at.
    made_for: (1,) the `min_cos` that the lists are kept for; another empties the cache.
    """

    points: np.ndarray
    normals: np.ndarray
    lanes: np.ndarray
    faces: np.ndarray
    block_slots: np.ndarray
    block_spans: np.ndarray
    block_at: np.ndarray
    lattice: Lattice
    reach: float
    cell_slots: np.ndarray
    list_lanes: np.ndarray
    list_faces: np.ndarray
    list_points: np.ndarray
    scratch: np.ndarray
    scratch_gap2: np.ndarray
    marks: np.ndarray
    made_for: np.ndarray


# ------------------------------------------------------------ lookups


# Arrays are handed on once a batch: numba counts who holds them, which for each query would take
# longer than the lookup.


@njit(cache=True)
def nearest_batch(arrays, near, queries, max_distance, index, gap2):
    """
    Find the nearest points to queries (Q, 3): their rows index (Q,) and gap2 (Q,) [m^2].

    The rows are the caller's; -1 and inf where none lies strictly within `max_distance` [m] or a
    query is not finite. near: `NearCells`.
    """
    count = len(queries)
    first, after = np.empty(count, np.int64), np.empty(count, np.int64)
    found = np.empty(count, np.int64), np.empty(count, np.float32), np.empty(count, np.float32)
    find_near_lists(near, queries, first, after)
    _compare(arrays, near.groups, queries, first, after, *found)
    _settle(arrays, near.groups, queries, max_distance, first, after, *found, index, gap2)
    _search_rest(arrays, queries, queries, max_distance, -1.0, first, index, gap2)


@njit(cache=True)
def nearest_facing_batch(arrays, queries, directions, max_distance, min_cos, index, gap2):
    """
    As `nearest_batch`, among the points whose outward normal n has -(n . d) >= min_cos.

    directions: (Q, 3) unit vectors d along the beams, so that each hits the surface from outside.
    """
    if arrays.made_for[0] != min_cos:
        forget_lists(arrays.cell_slots)
        arrays.made_for[0] = min_cos
    count = len(queries)
    first, after = np.empty(count, np.int64), np.empty(count, np.int64)
    found = np.empty(count, np.int64), np.empty(count, np.float32), np.empty(count, np.float32)
    begin = 0
    while begin < count:
        end = find_facing_lists(arrays, queries, directions, min_cos, begin, first, after)
        _compare_facing(
            arrays, queries, directions, min_cos, begin, end, first, after, *found
        )  # fmt: skip
        _settle_facing(
            arrays, queries, directions, max_distance, min_cos, begin, end, first, after, *found,
            index, gap2,
        )  # fmt: skip
        begin = end
    _search_rest(arrays, queries, directions, max_distance, min_cos, first, index, gap2)


@njit(cache=True)
def _compare(arrays, groups, queries, first, after, nearest, least2, next2):
    """Find the two nearest to each query in its list, groups[first:after], in single precision."""
    lanes, lattice = arrays.lanes, arrays.lattice
    x0, y0, z0 = lattice.x0, lattice.y0, lattice.z0
    for q in range(queries.shape[0]):
        nearest[q], least2[q], next2[q] = two_nearest(
            lanes, groups, first[q], after[q],
            np.float32(queries[q, 0] - x0), np.float32(queries[q, 1] - y0),
            np.float32(queries[q, 2] - z0),
        )  # fmt: skip


@njit(cache=True)
def _settle(
    arrays, groups, queries, max_distance, first, after, nearest, least2, next2, index, gap2
):
    """
    Decide in double precision which point is nearest, and whether it is near enough.

    Nearly always no other one comes into question.
    """
    lanes, points, lattice, rounding = (
        arrays.lanes,
        arrays.points,
        arrays.lattice,
        arrays.lattice.rounding,
    )
    x0, y0, z0 = lattice.x0, lattice.y0, lattice.z0
    for q in range(queries.shape[0]):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        best2, row = max_distance * max_distance, -1.0
        within2 = np.float32(least2[q] + 2.0 * slack2(least2[q], rounding))
        if next2[q] > within2:
            p = nearest[q]
            d2 = distance2(points, p, x, y, z)
            if d2 < best2:
                best2, row = d2, points[p, 3]
        elif least2[q] < np.inf:
            sx, sy, sz = np.float32(x - x0), np.float32(y - y0), np.float32(z - z0)
            for c in range(first[q], after[q]):
                group = np.int64(groups[c])
                chosen = near_lanes(lanes, group, sx, sy, sz, within2)
                while chosen != 0:
                    p = LANES * group + lowest_lane(chosen)
                    chosen &= chosen - 1
                    d2 = distance2(points, p, x, y, z)
                    if d2 < best2 or (d2 == best2 and points[p, 3] < row):
                        best2, row = d2, points[p, 3]
        index[q], gap2[q] = np.int64(row), best2 if row >= 0.0 else np.inf


@njit(cache=True)
def _compare_facing(
    arrays, queries, directions, min_cos, begin, end, first, after, nearest, least2, next2
):
    """As `_compare`, for queries begin..end, among the points of their lists that may face."""
    lanes, faces, lattice = arrays.list_lanes, arrays.list_faces, arrays.lattice
    x0, y0, z0 = lattice.x0, lattice.y0, lattice.z0
    may = np.float32(min_cos - COS_ERROR)
    for q in range(begin, end):
        nearest[q], least2[q], next2[q] = two_nearest_facing(
            lanes, None, first[q], after[q],
            np.float32(queries[q, 0] - x0), np.float32(queries[q, 1] - y0),
            np.float32(queries[q, 2] - z0), faces,
            np.float32(directions[q, 0]), np.float32(directions[q, 1]),
            np.float32(directions[q, 2]), may,
        )  # fmt: skip


@njit(cache=True)
def _settle_facing(
    arrays, queries, directions, max_distance, min_cos, begin, end, first, after,
    nearest, least2, next2, index, gap2,
):  # fmt: skip
    """
    As `_settle`, for queries begin..end, among those that face the beam.

    Sets `first` to -1 where that does not settle it: a point that all but faces the beam is nearer
    than one that does.
    """
    lanes, faces, listed = arrays.list_lanes, arrays.list_faces, arrays.list_points
    points, normals, lattice = arrays.points, arrays.normals, arrays.lattice
    x0, y0, z0, rounding = lattice.x0, lattice.y0, lattice.z0, lattice.rounding
    may = np.float32(min_cos - COS_ERROR)
    for q in range(begin, end):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        dx, dy, dz = directions[q, 0], directions[q, 1], directions[q, 2]
        best2, row, slack = max_distance * max_distance, -1.0, slack2(least2[q], rounding)
        within2, settled = np.float32(least2[q] + 2.0 * slack), least2[q] == np.inf
        if next2[q] > within2:
            p = np.int64(listed[nearest[q] // LANES, nearest[q] % LANES])
            if toward(normals, p, dx, dy, dz) >= min_cos:
                settled, d2 = True, distance2(points, p, x, y, z)
                if d2 < best2:
                    best2, row = d2, points[p, 3]
        if not settled:
            sx, sy, sz = np.float32(x - x0), np.float32(y - y0), np.float32(z - z0)
            bx, by, bz = np.float32(dx), np.float32(dy), np.float32(dz)
            for group in range(first[q], after[q]):
                chosen = near_lanes(lanes, group, sx, sy, sz, within2)
                chosen &= facing_lanes(faces, group, bx, by, bz, may)
                while chosen != 0:
                    p = np.int64(listed[group, lowest_lane(chosen)])
                    chosen &= chosen - 1
                    d2 = distance2(points, p, x, y, z)
                    if d2 < best2 or (d2 == best2 and points[p, 3] < row):
                        if toward(normals, p, dx, dy, dz) >= min_cos:
                            best2, row = d2, points[p, 3]
            if best2 > least2[q] + slack:
                first[q] = -1
        index[q], gap2[q] = np.int64(row), best2 if row >= 0.0 else np.inf


@njit(cache=True)
def _search_rest(arrays, queries, directions, max_distance, min_cos, first, index, gap2):
    """
    Search the grid where there is no list (first: -1) or it does not know.

    A list knows all that lies within reach, and nothing about what lies beyond.
    """
    points, normals, block_slots = arrays.points, arrays.normals, arrays.block_slots
    spans, block_at, lattice = arrays.block_spans, arrays.block_at, arrays.lattice
    scratch, gaps2, reach = arrays.scratch, arrays.scratch_gap2, arrays.reach
    far, limit2 = max_distance > reach, max_distance * max_distance
    for q in range(queries.shape[0]):
        if first[q] >= 0 and not (far and (index[q] < 0 or gap2[q] > reach * reach)):
            continue
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        dx, dy, dz = directions[q, 0], directions[q, 1], directions[q, 2]
        if not in_range(lattice, x, y, z):
            continue
        best, best2, row = search(
            points, normals, block_slots, spans, block_at, lattice, scratch, gaps2,
            x, y, z, dx, dy, dz, min_cos, limit2,
        )  # fmt: skip
        if best >= 0:
            index[q], gap2[q] = np.int64(row), best2


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
        What `nearest` looks up in.

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
        for name in ('list_lanes', 'list_faces', 'list_points', *SCRATCH):
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
        queries = np.ascontiguousarray(queries, dtype=np.float64)
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
        queries = np.ascontiguousarray(queries, dtype=np.float64)
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
        faces=pack_lanes(normals[order], 0.0),
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
