"""
Exact nearest-neighbour lookup in a point cloud, as arrays that compiled kernels can use.

Two levels. Below, a grid: points lie sorted by block (a cube of some twenty points), and an
open-addressing hash table finds a block. Above, a cache of candidate lists: for a cell of space (a
third of a block, occupied or not) the few points that can be nearest to *some* query inside it. A
query then costs one hash probe and a scan of a short list, however far it is from the surface and
however large the map.

A point p cannot be nearest anywhere in a box if another point p' is closer at all of it. The
difference of the two squared distances is linear in the query, so that its minimum over the box
with centre c and edge h has a closed
form:  min_q |q-p|^2 - |q-p'|^2 = |c-p|^2 - |c-p'|^2 - h (|g_x| + |g_y| + |g_z|),  g = p' - p.

The nearest point that *faces* a beam has lists of its own, one for each of 24 cones of beam
directions: they leave out what faces no direction of the cone, and only what faces all of them
rules others out.

Lists are made when a cell has been visited a few times (until then the grid is searched), in
memory of fixed size: when it is full it is emptied. Answers never depend on what the cache holds:
of points at the same distance, the first in the caller's order is taken. Because queries write to
the cache, use one index (`VoxelIndex.copy`) per thread.
"""

from __future__ import annotations

from typing import NamedTuple

from continuum_loc.mapping.errors import MapError
from numba import njit
import numpy as np

CELLS_PER_BLOCK = 3.0  # along an edge
POINTS_PER_CELL = (
    2.0  # mean over occupied ones; makes lists of about 12, where their length and number balance
)
AXIS_BITS = 19
AXIS_MASK = (1 << AXIS_BITS) - 1
AXIS_LIMIT = 1 << (AXIS_BITS - 1)
SPAN_BITS = 32  # of the length in a block's span
SPAN_MASK = (1 << SPAN_BITS) - 1
GATHER_LIMIT = 4096  # candidates before pruning
LIST_LIMIT = 384  # after pruning; longer lists (the centre of a sphere) are not worth keeping
FIRST_REACH = 0.25  # blocks that a search looks around at first
# Visits to a cell before it gets a list, which costs as much as a dozen searches: a body that
# moves on visits most cells a few times only; where it stays, each list pays.
PATIENCE = 24
CROWDED = -1000  # entry of a cell whose list would be too long
ROUNDING = 1e-9  # far above the rounding of coordinates counted in blocks
COUNTERS = (
    2  # rows after the cell table: [lists kept, pool rows in use], [lists made, times emptied]
)
ANY_DIRECTION = 24  # the cone of lists that do not ask for facing
CONE_COS = 0.85  # of the half-angle of a cone about its axis (0.857 at its farthest corner)
CONE_SIN = np.sqrt(1.0 - CONE_COS**2)
CONE_TILT = 0.366  # of the axis of a quarter of a cube's face: (1, tilt, tilt)


class Lattice(NamedTuple):
    """Origin [m] and edges [m] of blocks and cells, with their inverses, and extent in blocks."""

    x0: float
    y0: float
    z0: float
    block: float
    inverse_block: float
    cell: float
    inverse_cell: float
    blocks_x: int
    blocks_y: int
    blocks_z: int


class VoxelArrays(NamedTuple):
    """
    The index as arrays.

    Kernels take it whole and unpack it outside their loops: handing so many arrays on takes
    longer than most lookups. Only the last six arrays are ever written.

    points: (P, 4) x, y, z [m] and the row in the caller's cloud, sorted by block; normals: (P, 3).
    block_slots: (H, 2) hash table from a block's key to its span of sorted points
        (start * 2^32 + length).
    block_spans: (B,) all of them; block_at: (B, 3) each block's place, in blocks.
    reach: distance [m] up to which lists are made.
    cell_slots: (C + COUNTERS, 2) hash table from a cell's and cone's key to their packed list
        (start * 2^16 + length), to minus the number of visits so far, or to CROWDED.
    pool, pool_normals: (L, 4), (L, 3) the lists end to end: rows of `points` and `normals`.
    scratch, scratch_gap2: (B,) spans of the blocks that a search is about to look at, and their
        squared distances in blocks.
    made_for: (1,) the `min_cos` that facing lists are kept for; another empties the cache.
    """

    points: np.ndarray
    normals: np.ndarray
    block_slots: np.ndarray
    block_spans: np.ndarray
    block_at: np.ndarray
    lattice: Lattice
    reach: float
    cell_slots: np.ndarray
    pool: np.ndarray
    pool_normals: np.ndarray
    scratch: np.ndarray
    scratch_gap2: np.ndarray
    made_for: np.ndarray


# ------------------------------------------------------------ keys and hash tables


@njit(cache=True, inline='always')
def pack(i, j, k):
    """Key of a block or cell."""
    return (np.int64(i) << (2 * AXIS_BITS)) | (np.int64(j) << AXIS_BITS) | np.int64(k)


@njit(cache=True)
def find_slot(slots, key, mask):
    """Row of `key` in a table of mask + 1 rows, or of the free row where it belongs."""
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    row = np.int64((mixed ^ (mixed >> np.uint64(32))) & np.uint64(mask))
    while slots[row, 0] != key and slots[row, 0] != -1:
        row = (row + 1) & mask
    return row


@njit(cache=True)
def _enter(keys, values, slots):
    """Put keys (B,) with their values (B,) into the table."""
    for number in range(keys.shape[0]):
        row = find_slot(slots, keys[number], slots.shape[0] - 1)
        slots[row, 0], slots[row, 1] = keys[number], values[number]


@njit(cache=True)
def _spread_bits(value):
    """Put two zero bits between the lowest 21 bits."""
    v = np.int64(value) & 0x1FFFFF
    v = (v | (v << 32)) & 0x1F00000000FFFF
    v = (v | (v << 16)) & 0x1F0000FF0000FF
    v = (v | (v << 8)) & 0x100F00F00F00F00F
    v = (v | (v << 4)) & 0x10C30C30C30C30C3
    return (v | (v << 2)) & 0x1249249249249249


@njit(cache=True)
def _morton_codes(points, origin, inverse_edge):
    """(P,) Morton code of each point's cube."""
    codes = np.empty(points.shape[0], np.int64)
    for p in range(points.shape[0]):
        i = np.int64(np.floor((points[p, 0] - origin[0]) * inverse_edge))
        j = np.int64(np.floor((points[p, 1] - origin[1]) * inverse_edge))
        k = np.int64(np.floor((points[p, 2] - origin[2]) * inverse_edge))
        codes[p] = (_spread_bits(i) << 2) | (_spread_bits(j) << 1) | _spread_bits(k)
    return codes


# ------------------------------------------------------------ the grid
# u, v, w are x, y, z counted in blocks from the origin. Comparisons that may rule something out
# give way by ROUNDING, so that rounding never rules a neighbour out.


@njit(cache=True, inline='always')
def _gap2(u, block):
    """Squared distance, along one axis and in blocks, from a place to a block."""
    gap = max(block - u, u - block - 1.0, 0.0)
    return gap * gap


@njit(cache=True, inline='always')
def _range(u, reach, count):
    """Half-open range of blocks, of `count`, that u +- reach covers along one axis."""
    low, high = np.floor(u - reach - ROUNDING), np.floor(u + reach + ROUNDING)
    return int(max(low, 0.0)), int(max(min(high, count - 1.0), -1.0)) + 1


@njit(cache=True)
def _collect(slots, spans, block_at, lattice, scratch, gaps2, u, v, w, reach, seen2):
    """
    Write the blocks nearer than `reach`, but not than sqrt(seen2), to `scratch`; count them.

    The nearest comes first: what is found in it rules most of the others out.
    """
    count, reach2 = 0, reach * reach
    i0, i1 = _range(u, reach, lattice.blocks_x)
    j0, j1 = _range(v, reach, lattice.blocks_y)
    k0, k1 = _range(w, reach, lattice.blocks_z)
    if (i1 - i0) * (j1 - j0) * (k1 - k0) > scratch.shape[0]:  # fewer blocks than places for them
        for number in range(scratch.shape[0]):
            gap2 = _block_gap2(block_at, number, u, v, w)
            if seen2 <= gap2 < reach2:
                _note(scratch, gaps2, count, spans[number], gap2)
                count += 1
        return count
    for i in range(i0, i1):
        gap_i = _gap2(u, i)
        for j in range(j0, j1):
            gap_ij = gap_i + _gap2(v, j)
            if gap_ij > reach2:
                continue
            for k in range(k0, k1):
                gap2 = gap_ij + _gap2(w, k)
                if not seen2 <= gap2 < reach2:
                    continue
                key = pack(i, j, k)
                row = find_slot(slots, key, slots.shape[0] - 1)
                if slots[row, 0] == key:
                    _note(scratch, gaps2, count, slots[row, 1], gap2)
                    count += 1
    return count


@njit(cache=True, inline='always')
def _note(spans, gaps2, count, span, gap2):
    """Add a block to those already noted, as the first if it is the nearest."""
    if count > 0 and gap2 < gaps2[0]:
        spans[count], gaps2[count] = spans[0], gaps2[0]
        spans[0], gaps2[0] = span, gap2
    else:
        spans[count], gaps2[count] = span, gap2


@njit(cache=True, inline='always')
def span_bounds(span):
    """First of a block's sorted points, and the one after its last."""
    return span >> SPAN_BITS, (span >> SPAN_BITS) + (span & SPAN_MASK)


@njit(cache=True, inline='always')
def _block_gap2(block_at, number, u, v, w):
    return (
        _gap2(u, block_at[number, 0]) + _gap2(v, block_at[number, 1])
    ) + _gap2(w, block_at[number, 2])  # fmt: skip


@njit(cache=True, inline='always')
def _distance2(points, p, x, y, z):
    ex, ey, ez = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
    return ex * ex + ey * ey + ez * ez


@njit(cache=True, inline='always')
def _toward(normals, p, dx, dy, dz):
    """How far a surface faces a beam: the cosine of the angle of incidence."""
    return -(normals[p, 0] * dx + normals[p, 1] * dy + normals[p, 2] * dz)


@njit(cache=True)
def _scan(points, normals, begin, end, x, y, z, dx, dy, dz, min_cos, best, best2, row):
    """Improve (place, squared distance, caller's row) by points begin..end that face the beam."""
    for p in range(begin, end):
        d2 = _distance2(points, p, x, y, z)
        if d2 <= best2 and (d2 < best2 or points[p, 3] < row):
            if min_cos <= -1.0 or _toward(normals, p, dx, dy, dz) >= min_cos:
                best, best2, row = p, d2, points[p, 3]
    return best, best2, row


@njit(cache=True)
def _search(
    points, normals, slots, spans, block_at, lattice, scratch, gaps2,
    x, y, z, dx, dy, dz, min_cos, limit2,
):  # fmt: skip
    """
    Find the nearest that faces the beam: (sorted point or -1, squared distance, caller's row).

    It is nearer than sqrt(limit2), and looked for in balls that grow until one is sure to hold it.
    With min_cos = -1 every point counts. The first eight are fields of `VoxelArrays`.
    """
    scale = lattice.inverse_block
    nx, ny, nz = lattice.blocks_x, lattice.blocks_y, lattice.blocks_z
    u, v, w = (x - lattice.x0) * scale, (y - lattice.y0) * scale, (z - lattice.z0) * scale
    best, best2, row, seen2 = -1, limit2, -1.0, 0.0
    farthest = nx + ny + nz + abs(u) + abs(v) + abs(w)
    limit = min(np.sqrt(limit2) * scale, farthest) * (1.0 + ROUNDING) + ROUNDING
    reach = min(max(-u, u - nx, -v, v - ny, -w, w - nz, 0.0) + FIRST_REACH, limit)
    while True:
        radius = limit if best < 0 else np.sqrt(best2) * scale * (1.0 + ROUNDING) + ROUNDING
        count = _collect(slots, spans, block_at, lattice, scratch, gaps2, u, v, w, reach, seen2)
        for c in range(count):
            if gaps2[c] > radius * radius:
                continue
            first, after = span_bounds(scratch[c])
            best, best2, row = _scan(
                points, normals, first, after, x, y, z, dx, dy, dz, min_cos, best, best2, row
            )
            radius = min(radius, np.sqrt(best2) * scale * (1.0 + ROUNDING) + ROUNDING)
        if radius <= reach or reach >= limit:
            return best, best2, row
        seen2 = reach * reach
        reach = radius if best >= 0 else min(2.0 * reach, limit)


@njit(cache=True)
def _search_arrays(arrays, x, y, z, dx, dy, dz, min_cos, limit2):
    """`_search`, where its time does not matter."""
    return _search(
        arrays.points, arrays.normals, arrays.block_slots, arrays.block_spans, arrays.block_at,
        arrays.lattice, arrays.scratch, arrays.scratch_gap2,
        x, y, z, dx, dy, dz, min_cos, limit2,
    )  # fmt: skip


# ------------------------------------------------------------ candidate lists


@njit(cache=True)
def _cone(dx, dy, dz):
    """Find the cone, 0..23, that holds a direction: a quarter of a face of the cube around it."""
    x, y, z = abs(dx), abs(dy), abs(dz)
    if x >= y and x >= z:
        return ((0 if dx > 0 else 1) << 2) | ((dy > 0) << 1) | (dz > 0)
    if y >= z:
        return ((2 if dy > 0 else 3) << 2) | ((dx > 0) << 1) | (dz > 0)
    return ((4 if dz > 0 else 5) << 2) | ((dx > 0) << 1) | (dy > 0)


@njit(cache=True)
def _cone_axis(cone):
    """Return the unit axis of a cone; zero for ANY_DIRECTION."""
    if cone == ANY_DIRECTION:
        return 0.0, 0.0, 0.0
    scale = 1.0 / np.sqrt(1.0 + 2.0 * CONE_TILT * CONE_TILT)
    face, tilt = cone >> 2, CONE_TILT * scale
    main = scale if face & 1 == 0 else -scale
    a = tilt if cone & 2 else -tilt
    b = tilt if cone & 1 else -tilt
    if face < 2:
        return main, a, b
    if face < 4:
        return a, main, b
    return a, b, main


@njit(cache=True)
def _cone_limits(cone, min_cos):
    """
    Bounds (may, sure) on the cosine between a surface and the cone's axis.

    From `may` on it may face some direction of the cone, from `sure` on it faces all of them; the
    latter is 2 where none does.
    """
    if cone == ANY_DIRECTION:
        return -2.0, -1.0
    sine = np.sqrt(max(1.0 - min_cos * min_cos, 0.0))
    may = min_cos * CONE_COS - sine * CONE_SIN - ROUNDING
    sure = min_cos * CONE_COS + sine * CONE_SIN + ROUNDING
    return (may if min_cos > -CONE_COS else -2.0), (sure if min_cos < CONE_COS else 2.0)


@njit(cache=True, inline='always')
def _never_nearest(points, p, pool, other, x, y, z, edge):
    """Whether `pool[other]` is closer than `points[p]` everywhere in the box about (x, y, z)."""
    p2 = _distance2(points, p, x, y, z)
    other2 = _distance2(pool, other, x, y, z)
    swing = edge * (
        abs(pool[other, 0] - points[p, 0])
        + abs(pool[other, 1] - points[p, 1])
        + abs(pool[other, 2] - points[p, 2])
    )
    return p2 - other2 - swing > 1e-12 * (p2 + other2)


@njit(cache=True, inline='always')
def _copy(points, normals, p, pool, pool_normals, to):
    for column in range(4):
        pool[to, column] = points[p, column]
    for column in range(3):
        pool_normals[to, column] = normals[p, column]


@njit(cache=True)
def _make_list(arrays, x, y, z, cone, min_cos, begin):
    """
    Write the candidates of the cell with this centre from pool row `begin` on.

    Their number (0: no point within reach), or -1 where they are too many.
    """
    pool, pool_normals, edge = arrays.pool, arrays.pool_normals, arrays.lattice.cell
    ax, ay, az = _cone_axis(cone)
    may, sure = _cone_limits(cone, min_cos)
    half_diagonal = 0.5 * np.sqrt(3.0) * edge * (1.0 + ROUNDING)
    limit = arrays.reach + half_diagonal
    best, best2, _ = _search_arrays(arrays, x, y, z, ax, ay, az, sure, limit * limit)
    # Every query of the cell has a point within |c - best| + half diagonal of it.
    radius = limit if best < 0 else np.sqrt(best2) + 2.0 * half_diagonal
    if best >= 0:
        _copy(arrays.points, arrays.normals, best, pool, pool_normals, begin)
    end = _gather(arrays, x, y, z, radius, ax, ay, az, may, best, begin)
    if end < 0:
        return -1
    end = _prune(pool, pool_normals, begin, end, x, y, z, edge, ax, ay, az, sure)
    if end - begin > LIST_LIMIT:
        return -1
    _sort_rows(pool, pool_normals, begin, end)
    return end - begin


@njit(cache=True)
def _gather(arrays, x, y, z, radius, ax, ay, az, may, best, begin):
    """
    Write to the pool the points within `radius` that may face.

    Not those that `best` (already at row `begin`, or -1) rules out. The end of what was written,
    or -1 when they are too many.
    """
    points, normals, lattice = arrays.points, arrays.normals, arrays.lattice
    pool, pool_normals, scale = arrays.pool, arrays.pool_normals, lattice.inverse_block
    u, v, w = (x - lattice.x0) * scale, (y - lattice.y0) * scale, (z - lattice.z0) * scale
    end = begin if best < 0 else begin + 1
    reach = radius * scale * (1.0 + ROUNDING) + ROUNDING
    count = _collect(
        arrays.block_slots, arrays.block_spans, arrays.block_at, lattice,
        arrays.scratch, arrays.scratch_gap2, u, v, w, reach, 0.0,
    )  # fmt: skip
    for c in range(count):
        first, after = span_bounds(arrays.scratch[c])
        for p in range(first, after):
            if p == best or _toward(normals, p, ax, ay, az) < may:
                continue
            if best >= 0 and _never_nearest(points, p, pool, begin, x, y, z, lattice.cell):
                continue
            if _distance2(points, p, x, y, z) > radius * radius * (1.0 + ROUNDING):
                continue
            if end - begin >= GATHER_LIMIT:
                return -1
            _copy(points, normals, p, pool, pool_normals, end)
            end += 1
    return end


@njit(cache=True)
def _sort_rows(pool, pool_normals, begin, end):
    """Bring a list into the caller's order, so that the first of equally near ones wins."""
    for c in range(begin + 1, end):
        at = c
        while at > begin and pool[at - 1, 3] > pool[at, 3]:
            _swap(pool, pool_normals, at - 1, at)
            at -= 1


@njit(cache=True, inline='always')
def _swap(pool, pool_normals, a, b):
    for column in range(4):
        pool[a, column], pool[b, column] = pool[b, column], pool[a, column]
    for column in range(3):
        pool_normals[a, column], pool_normals[b, column] = (
            pool_normals[b, column],
            pool_normals[a, column],
        )


@njit(cache=True)
def _prune(pool, pool_normals, begin, end, x, y, z, edge, ax, ay, az, sure):
    """Drop rows ruled out by the sure one that is nearest to a corner of the box; the new end."""
    for corner in range(8):
        qx = x + edge * ((corner & 1) - 0.5)
        qy = y + edge * (((corner >> 1) & 1) - 0.5)
        qz = z + edge * (((corner >> 2) & 1) - 0.5)
        best, best2, _ = _scan(
            pool, pool_normals, begin, end, qx, qy, qz, ax, ay, az, sure, -1, np.inf, -1.0
        )
        if best < 0:
            return end
        # The winner goes first, where compaction cannot overwrite it before it has been compared
        # with all others.
        _swap(pool, pool_normals, begin, best)
        kept = begin + 1
        for c in range(begin + 1, end):
            if not _never_nearest(pool, c, pool, begin, x, y, z, edge):
                _copy(pool, pool_normals, c, pool, pool_normals, kept)
                kept += 1
        end = kept
    return end


@njit(cache=True)
def _visit(slots, key, row):
    """
    Count a visit to a cell that has no list, where its key belongs in row `row` of the table.

    Returns the row and its entry: minus the number of visits, or CROWDED.
    """
    table = slots.shape[0] - COUNTERS
    if slots[row, 0] != key:
        if slots[table, 0] * 2 >= table:
            _empty(slots)
            row = find_slot(slots, key, table - 1)
        slots[row, 0], slots[row, 1] = key, 0
        slots[table, 0] += 1
    if slots[row, 1] != CROWDED:
        slots[row, 1] -= 1
    return row, slots[row, 1]


@njit(cache=True)
def _empty(slots):
    table = slots.shape[0] - COUNTERS
    slots[:table, 0] = -1
    slots[table] = 0
    slots[table + 1, 1] += 1


@njit(cache=True)
def _add_list(arrays, key, row, min_cos):
    """Give the cell and cone in row `row` of the table its list; its packed entry, or CROWDED."""
    slots, pool, lattice, place = arrays.cell_slots, arrays.pool, arrays.lattice, key >> 5
    counters = slots[-COUNTERS:]
    if counters[0, 1] + GATHER_LIMIT + 2 > pool.shape[0]:
        _empty(slots)
        return np.int64(-1)
    x = lattice.x0 + ((place >> (2 * AXIS_BITS)) - AXIS_LIMIT + 0.5) * lattice.cell
    y = lattice.y0 + (((place >> AXIS_BITS) & AXIS_MASK) - AXIS_LIMIT + 0.5) * lattice.cell
    z = lattice.z0 + ((place & AXIS_MASK) - AXIS_LIMIT + 0.5) * lattice.cell
    begin = counters[0, 1]
    length = _make_list(arrays, x, y, z, key & 31, min_cos, begin)
    counters[1, 0] += 1
    if length < 0:
        slots[row, 1] = CROWDED
    else:
        counters[0, 1] += length
        slots[row, 1] = (begin << 16) + length
    return slots[row, 1]


@njit(cache=True)
def _list_key(lattice, x, y, z, cone):
    """Key of the cell that holds a place, with a cone; -1 for nan and places absurdly far away."""
    i = np.floor((x - lattice.x0) * lattice.inverse_cell)
    j = np.floor((y - lattice.y0) * lattice.inverse_cell)
    k = np.floor((z - lattice.z0) * lattice.inverse_cell)
    if not (abs(i) < AXIS_LIMIT and abs(j) < AXIS_LIMIT and abs(k) < AXIS_LIMIT):
        return np.int64(-1)
    return (pack(int(i) + AXIS_LIMIT, int(j) + AXIS_LIMIT, int(k) + AXIS_LIMIT) << 5) | cone


# ------------------------------------------------------------ lookups


@njit(cache=True)
def _nearest_listed(pool, begin, end, x, y, z, limit2):
    """(pool row or -1, squared distance) of a list's nearest."""
    best, best2 = -1, limit2
    for c in range(begin, end):
        d2 = _distance2(pool, c, x, y, z)
        if d2 < best2:
            best, best2 = c, d2
    return best, best2


@njit(cache=True)
def _facing_listed(pool, normals, begin, end, x, y, z, dx, dy, dz, min_cos, limit2):
    """Look, as `_nearest_listed` does, among those that face the beam."""
    best, best2 = -1, limit2
    for c in range(begin, end):
        d2 = _distance2(pool, c, x, y, z)
        if d2 < best2 and _toward(normals, c, dx, dy, dz) >= min_cos:
            best, best2 = c, d2
    return best, best2


@njit(cache=True)
def _nearest_batch(arrays, facing, queries, directions, max_distance, min_cos, index, distance2):
    """Find the nearest point to each query (Q, 3); where `facing`, of those facing its beam."""
    points, normals, block_slots = arrays.points, arrays.normals, arrays.block_slots
    spans, block_at, lattice = arrays.block_spans, arrays.block_at, arrays.lattice
    scratch, gaps2, reach = arrays.scratch, arrays.scratch_gap2, arrays.reach
    slots, pool, pool_normals = arrays.cell_slots, arrays.pool, arrays.pool_normals
    mask, limit2 = slots.shape[0] - COUNTERS - 1, max_distance * max_distance
    dx, dy, dz, cone = 0.0, 0.0, 0.0, ANY_DIRECTION
    for q in range(queries.shape[0]):
        index[q], distance2[q] = -1, np.inf
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        if facing:
            dx, dy, dz = directions[q, 0], directions[q, 1], directions[q, 2]
            cone = _cone(dx, dy, dz)
        key = _list_key(lattice, x, y, z, cone)
        if key < 0:
            continue
        slot = find_slot(slots, key, mask)
        entry = slots[slot, 1]
        if slots[slot, 0] != key or entry < 0:
            slot, entry = _visit(slots, key, slot)
            if CROWDED < entry <= -PATIENCE:
                entry = _add_list(arrays, key, slot, min_cos)
        best, best2 = -1, limit2
        begin, end = entry >> 16, (entry >> 16) + (entry & 0xFFFF)
        if entry >= 0 and facing:
            best, best2 = _facing_listed(
                pool, pool_normals, begin, end, x, y, z, dx, dy, dz, min_cos, limit2
            )
        elif entry >= 0:
            best, best2 = _nearest_listed(pool, begin, end, x, y, z, limit2)
        # A list knows all that lies within reach, and nothing about what lies beyond.
        if entry < 0 or (max_distance > reach and (best < 0 or best2 > reach * reach)):
            best, best2, row = _search(
                points, normals, block_slots, spans, block_at, lattice, scratch, gaps2,
                x, y, z, dx, dy, dz, min_cos, limit2,
            )  # fmt: skip
        else:
            row = pool[best, 3] if best >= 0 else -1.0
        if best >= 0:
            index[q], distance2[q] = np.int64(row), best2


@njit(cache=True)
def nearest_batch(arrays, queries, max_distance, index, distance2):
    """
    Find the nearest points to queries (Q, 3): their rows index (Q,) and distance2 (Q,) [m^2].

    The rows are the caller's; -1 and inf where none lies strictly within `max_distance` [m] or a
    query is not finite.
    """
    _nearest_batch(arrays, False, queries, queries, max_distance, -1.0, index, distance2)


@njit(cache=True)
def nearest_facing_batch(arrays, queries, directions, max_distance, min_cos, index, distance2):
    """
    As `nearest_batch`, among the points whose outward normal n has -(n . d) >= min_cos.

    directions: (Q, 3) unit vectors d along the beams, so that each hits the surface from outside.
    """
    if arrays.made_for[0] != min_cos:
        _empty(arrays.cell_slots)
        arrays.made_for[0] = min_cos
    _nearest_batch(arrays, True, queries, directions, max_distance, min_cos, index, distance2)


class VoxelIndex:
    """
    Nearest-neighbour index of a fixed cloud; see the module's docstring for how it works.

    points: (P, 3) [m], finite, P >= 1. normals: (P, 3) unit, needed for `nearest_facing`.
    cell: edge of a cell [m], by default so that an occupied one holds two points or so.
    reach: largest distance [m] that is served at full speed; larger ones are exact too, but
    searched for.
    cache_cells: candidate lists kept at a time (about 1 kB each).
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
        self.cell = float(cell) if cell is not None else _suitable_cell(points)
        if not self.cell > 0.0 or not reach >= 0.0:
            raise MapError(f'cell must be > 0 and reach >= 0, got cell {cell!r}, reach {reach!r}')
        self._cache_cells = int(cache_cells)
        self.arrays = _build(points, given, self.cell, float(reach), self._cache_cells)

    def copy(self) -> VoxelIndex:
        """Return an index of the same cloud with a cache of its own (for another thread)."""
        twin = object.__new__(VoxelIndex)
        twin.__dict__.update(self.__dict__)
        blocks = len(self.arrays.block_at)
        twin.arrays = self.arrays._replace(**_empty_cache(self._cache_cells, blocks))
        return twin

    def reserve(self) -> VoxelIndex:
        """Take the cache's memory at once, not in the course of a long run; return self."""
        for name in ('pool', 'pool_normals', 'scratch', 'scratch_gap2'):
            getattr(self.arrays, name).fill(0)
        return self

    @property
    def cache_use(self) -> dict[str, int]:
        """
        Count `cells` with a list now, `candidates` in them, lists `made`, and times `emptied`.

        The last two since the start.
        """
        counters = self.arrays.cell_slots[-COUNTERS:].ravel()
        return dict(
            zip(('cells', 'candidates', 'made', 'emptied'), map(int, counters), strict=True)
        )

    def nearest(
        self, queries: np.ndarray, max_distance: float = np.inf
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Rows (Q,) of the nearest points and distances (Q,) [m] for queries (Q, 3).

        They are -1 and inf where none is nearer than max_distance [m]. Of equally near points the
        first is taken.
        """
        queries = np.ascontiguousarray(queries, dtype=np.float64)
        index, distance2 = np.empty(len(queries), np.int64), np.empty(len(queries))
        nearest_batch(self.arrays, queries, float(max_distance), index, distance2)
        return index, np.sqrt(distance2)

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
        directions = np.ascontiguousarray(
            np.broadcast_to(directions, queries.shape), dtype=np.float64
        )
        index, distance2 = np.empty(len(queries), np.int64), np.empty(len(queries))
        nearest_facing_batch(
            self.arrays,
            queries,
            directions,
            float(max_distance),
            float(min_cos),
            index,
            distance2,
        )
        return index, np.sqrt(distance2)


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
    for _ in range(4):  # occupancy grows as the square of the edge
        occupied = 1 + np.count_nonzero(
            np.diff(np.sort(_morton_codes(points, origin, 1.0 / cell)))
        )
        cell = max(cell * np.sqrt(POINTS_PER_CELL * occupied / len(points)), smallest)
        if cell >= extent:
            return extent
    return cell


def _build(
    points: np.ndarray, normals: np.ndarray, cell: float, reach: float, cache_cells: int
) -> VoxelArrays:
    origin, block = points.min(axis=0), CELLS_PER_BLOCK * cell
    if np.floor((points.max(axis=0) - origin) / cell).max() >= AXIS_LIMIT:
        raise MapError(
            f'cell {cell} m is too small for a cloud {np.ptp(points, axis=0).max():.6g} m across; '
            f'at most {AXIS_LIMIT} cells fit along an axis'
        )
    codes = _morton_codes(points, origin, 1.0 / block)
    order = np.argsort(codes, kind='stable')
    first = np.flatnonzero(np.diff(codes[order], prepend=-1))
    at = np.floor((points[order[first]] - origin) * (1.0 / block))
    slots = np.full((_power_of_two(4 * len(first)), 2), -1, np.int64)
    spans = (first << SPAN_BITS) + np.diff(first, append=len(points))
    _enter(np.array([pack(*place) for place in at.astype(np.int64).tolist()]), spans, slots)
    return VoxelArrays(
        points=np.column_stack([points[order], order.astype(np.float64)]),
        normals=normals[order],
        block_slots=slots,
        block_spans=spans,
        block_at=at,
        lattice=Lattice(
            *map(float, origin),
            *(block, 1.0 / block),
            *(cell, 1.0 / cell),
            *map(int, at.max(axis=0) + 1),
        ),
        reach=reach,
        **_empty_cache(cache_cells, len(first)),
    )


def _empty_cache(cells: int, blocks: int) -> dict[str, np.ndarray]:
    """Tables for that many candidate lists; the memory of the pool is taken only as it fills."""
    cell_slots = np.full((_power_of_two(2 * cells) + COUNTERS, 2), -1, np.int64)
    cell_slots[-COUNTERS:] = 0
    rows = 20 * cells + 2 * GATHER_LIMIT
    return {
        'cell_slots': cell_slots,
        'pool': np.empty((rows, 4)),
        'pool_normals': np.empty((rows, 3)),
        'scratch': np.empty(blocks, np.int64),
        'scratch_gap2': np.empty(blocks),
        'made_for': np.full(1, np.nan),
    }


def spatial_order(points: np.ndarray, edge: float) -> np.ndarray:
    """Rows (P,) of the points along a Morton curve through cubes of this edge [m]."""
    return np.argsort(_morton_codes(points, points.min(axis=0), 1.0 / edge), kind='stable')


def _power_of_two(least: int) -> int:
    return 1 << max(int(least - 1).bit_length(), 4)
