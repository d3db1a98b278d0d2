"""
Exact nearest-neighbour lookup in a point cloud, as arrays that compiled kernels can use.

Two levels. Below, a hashed voxel grid: points lie sorted by voxel, voxels are grouped in blocks of
4x4x4, and an open-addressing hash table finds a block's points. Above, a cache of candidate lists:
for a cell of space (the size of a voxel, occupied or not) the few points that can be nearest to
*some* query inside it. A query then costs one hash probe and a scan of a short list, however far
it is from the surface and however large the map.

A point p cannot be nearest anywhere in a box if another point p' is closer at all of it. The
difference of the two squared distances is linear in the query, so that its minimum over the box
with centre c and edge h has a closed
form:  min_q |q-p|^2 - |q-p'|^2 = |c-p|^2 - |c-p'|^2 - h (|g_x| + |g_y| + |g_z|),  g = p' - p.

Lists are made when a cell has been visited a few times (until then the grid is searched), in
memory of fixed size: when it is full it is emptied. Answers never depend on what the cache holds.
Because queries write to it, use one index (`VoxelIndex.copy`) per thread.
"""

from __future__ import annotations

from typing import NamedTuple

from continuum_loc.mapping.errors import MapError
from numba import njit
import numpy as np

BLOCK = 4  # voxels along a block's edge
BLOCK_VOXELS = BLOCK**3
# Mean over occupied voxels; makes lists of about 12, where their length and number balance.
POINTS_PER_VOXEL = 2.0
AXIS_BITS = 21
AXIS_MASK = (1 << AXIS_BITS) - 1
AXIS_LIMIT = 1 << (AXIS_BITS - 1)
GATHER_LIMIT = 4096  # candidates before pruning
LIST_LIMIT = 384  # after pruning; longer lists (the centre of a sphere) are not worth keeping
FIRST_REACH = 0.75  # voxels that a search looks around at first
PATIENCE = 4  # visits to a cell before it gets a list, which costs as much as a dozen searches
CROWDED = -1000  # entry of a cell whose list would be too long
ROUNDING = 1e-9  # far above the rounding of coordinates counted in voxels (2^20 of them at most)
# Rows after the cell table: [cells in use, pool rows in use], [lists made, times emptied].
COUNTERS = 2


class VoxelArrays(NamedTuple):
    """
    The index as arrays and scalars.

    Kernels take it whole; only `cell_slots` and `pool` are ever written.

    Kept to few arrays on purpose: handing each one from kernel to kernel costs as much as a tenth
    of a lookup.

    points: (P, 4) x, y, z [m] and the row in the caller's cloud, sorted by voxel.
    block_slots: (H, 2) hash table from a block's key to its number.
    voxel_start: (B * 64 + 1,) first sorted point of each voxel.
    cell_slots: (C + COUNTERS, 2) hash table from a cell's key to its packed list (start * 2^16 +
        length), to minus the number of visits so far, or to CROWDED.
    pool: (L, 4) the lists end to end: rows of `points`.
    x0, y0, z0: origin [m]; voxel: edge [m]; blocks_x, blocks_y, blocks_z: extent of the map in
    blocks;
    reach: distance [m] up to which lists are made.
    """

    points: np.ndarray
    block_slots: np.ndarray
    voxel_start: np.ndarray
    cell_slots: np.ndarray
    pool: np.ndarray
    x0: float
    y0: float
    z0: float
    voxel: float
    inverse_voxel: float
    blocks_x: int
    blocks_y: int
    blocks_z: int
    reach: float


@njit(cache=True, inline='always')
def _pack(i, j, k):
    return (np.int64(i) << (2 * AXIS_BITS)) | (np.int64(j) << AXIS_BITS) | np.int64(k)


@njit(cache=True, inline='always')
def _hash(key, mask):
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    return np.int64((mixed ^ (mixed >> np.uint64(32))) & np.uint64(mask))


@njit(cache=True)
def _find_slot(slots, key, mask):
    """Row of `key` in a table of mask + 1 rows, or of the free row where it belongs."""
    row = _hash(key, mask)
    while slots[row, 0] != key and slots[row, 0] != -1:
        row = (row + 1) & mask
    return row


@njit(cache=True, inline='always')
def _voxel_in_block(i, j, k):
    """Encode a voxel's place in its block, 0..63, in Morton order (each coordinate 0..3)."""
    return (
        ((i & 2) << 4)
        | ((j & 2) << 3)
        | ((k & 2) << 2)
        | ((i & 1) << 2)
        | ((j & 1) << 1)
        | (k & 1)
    )


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
def _morton_codes(points, origin, inverse_voxel):
    """
    (P,) Morton code of each point's voxel.

    The lowest 6 bits number the voxel within its block.
    """
    codes = np.empty(points.shape[0], np.int64)
    for p in range(points.shape[0]):
        i = np.int64(np.floor((points[p, 0] - origin[0]) * inverse_voxel))
        j = np.int64(np.floor((points[p, 1] - origin[1]) * inverse_voxel))
        k = np.int64(np.floor((points[p, 2] - origin[2]) * inverse_voxel))
        codes[p] = (_spread_bits(i) << 2) | (_spread_bits(j) << 1) | _spread_bits(k)
    return codes


@njit(cache=True)
def _fill_blocks(codes, keys, block_slots, voxel_start):
    """Enter the sorted points' blocks in the hash table; note where each voxel's points start."""
    block, last, voxel = -1, np.int64(-1), 0
    for p in range(codes.shape[0]):
        if codes[p] >> 6 != last:
            last = codes[p] >> 6
            block += 1
            row = _find_slot(block_slots, keys[p], block_slots.shape[0] - 1)
            block_slots[row, 0], block_slots[row, 1] = keys[p], block
        here = block * BLOCK_VOXELS + (codes[p] & 63)
        while voxel <= here:
            voxel_start[voxel] = p
            voxel += 1
    voxel_start[voxel:] = codes.shape[0]


@njit(cache=True, inline='always')
def _gap2(u, block):
    """Squared distance, along one axis and in voxels, from a place to a block."""
    gap = max(block * BLOCK - u, u - (block + 1) * BLOCK, 0.0)
    return gap * gap


@njit(cache=True, inline='always')
def _block_range(u, reach, count):
    """Half-open range of blocks, of `count`, that u +- reach (in voxels) covers along one axis."""
    low, high = np.floor((u - reach) / BLOCK), np.floor((u + reach) / BLOCK)
    return int(max(low, 0.0)), int(max(min(high, count - 1.0), -1.0)) + 1


@njit(cache=True, inline='always')
def _voxel_range(u, radius):
    """
    Half-open range, within 0..4, of a block's voxels that u +- radius covers.

    u in voxels from the block.
    """
    return int(max(np.floor(u - radius), 0.0)), int(min(np.floor(u + radius), BLOCK - 1.0)) + 1


@njit(cache=True, inline='always')
def _distance2(points, p, x, y, z):
    ex, ey, ez = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
    return ex * ex + ey * ey + ez * ez


@njit(cache=True, inline='always')
def _faces(normals, p, dx, dy, dz, min_cos):
    return -(normals[p, 0] * dx + normals[p, 1] * dy + normals[p, 2] * dz) >= min_cos


@njit(cache=True)
def _scan_block(
    points, start, normals, number, u, v, w, radius, x, y, z, dx, dy, dz, min_cos, best, best2
):
    """
    Improve (best sorted point, squared distance) by the points of one block.

    Only in the voxels that the ball touches; u, v, w: the place in voxels from the block's corner.
    """
    i0, i1 = _voxel_range(u, radius)
    j0, j1 = _voxel_range(v, radius)
    k0, k1 = _voxel_range(w, radius)
    for i in range(i0, i1):
        for j in range(j0, j1):
            for k in range(k0, k1):
                voxel = number * BLOCK_VOXELS + _voxel_in_block(i, j, k)
                for p in range(start[voxel], start[voxel + 1]):
                    d2 = _distance2(points, p, x, y, z)
                    if d2 < best2 and (
                        min_cos <= -1.0 or _faces(normals, int(points[p, 3]), dx, dy, dz, min_cos)
                    ):
                        best, best2 = p, d2
    return best, best2


# What follows unpacks `arrays` once and counts in voxels from the origin: u, v, w are x, y, z so.
# Comparisons that may rule something out give way by ROUNDING (relative, and in voxels), so that
# rounding never rules a neighbour out.
@njit(cache=True)
def _search(arrays, normals, x, y, z, dx, dy, dz, min_cos, best2):
    """
    (best sorted point or -1, squared distance) of the points nearer than sqrt(best2).

    Boxes double until one is sure to hold the nearest. With min_cos = -1 every point counts and
    `normals` is not read.
    """
    points, slots, start, scale = (
        arrays.points,
        arrays.block_slots,
        arrays.voxel_start,
        arrays.inverse_voxel,
    )
    nx, ny, nz = arrays.blocks_x, arrays.blocks_y, arrays.blocks_z
    u, v, w = (x - arrays.x0) * scale, (y - arrays.y0) * scale, (z - arrays.z0) * scale
    best = -1
    farthest = BLOCK * (nx + ny + nz) + abs(u) + abs(v) + abs(w)
    limit = min(np.sqrt(best2) * scale, farthest) * (1.0 + ROUNDING) + ROUNDING
    to_map = max(-u, u - BLOCK * nx, -v, v - BLOCK * ny, -w, w - BLOCK * nz, 0.0)
    reach = min(to_map + FIRST_REACH, limit)
    while True:
        i0, i1 = _block_range(u, reach, nx)
        j0, j1 = _block_range(v, reach, ny)
        k0, k1 = _block_range(w, reach, nz)
        if (i1 - i0) * (j1 - j0) * (k1 - k0) > slots.shape[0]:
            return _search_all(arrays, normals, x, y, z, dx, dy, dz, min_cos, best, best2)
        radius = min(np.sqrt(best2) * scale * (1.0 + ROUNDING) + ROUNDING, reach)
        for i in range(i0, i1):
            for j in range(j0, j1):
                gap_ij = _gap2(u, i) + _gap2(v, j)
                if gap_ij > radius * radius:
                    continue
                for k in range(k0, k1):
                    if gap_ij + _gap2(w, k) > radius * radius:
                        continue
                    key = _pack(i, j, k)
                    row = _find_slot(slots, key, slots.shape[0] - 1)
                    if slots[row, 0] == key:
                        best, best2 = _scan_block(
                            points,
                            start,
                            normals,
                            slots[row, 1],
                            u - BLOCK * i,
                            v - BLOCK * j,
                            w - BLOCK * k,
                            radius,
                            x,
                            y,
                            z,
                            dx,
                            dy,
                            dz,
                            min_cos,
                            best,
                            best2,
                        )
                        radius = min(np.sqrt(best2) * scale * (1.0 + ROUNDING) + ROUNDING, reach)
        if radius < reach or reach >= limit:
            return best, best2
        reach = min(2.0 * reach, limit)


@njit(cache=True)
def _search_all(arrays, normals, x, y, z, dx, dy, dz, min_cos, best, best2):
    """
    Go on with `_search` over the table of blocks.

    Cheaper than empty space once that is the larger of the two.
    """
    points, slots, start, scale = (
        arrays.points,
        arrays.block_slots,
        arrays.voxel_start,
        arrays.inverse_voxel,
    )
    u, v, w = (x - arrays.x0) * scale, (y - arrays.y0) * scale, (z - arrays.z0) * scale
    for row in range(slots.shape[0]):
        key = slots[row, 0]
        i, j, k = key >> (2 * AXIS_BITS), (key >> AXIS_BITS) & AXIS_MASK, key & AXIS_MASK
        radius = np.sqrt(best2) * scale * (1.0 + ROUNDING) + ROUNDING
        if key >= 0 and _gap2(u, i) + _gap2(v, j) + _gap2(w, k) <= radius * radius:
            best, best2 = _scan_block(
                points,
                start,
                normals,
                slots[row, 1],
                u - BLOCK * i,
                v - BLOCK * j,
                w - BLOCK * k,
                radius,
                x,
                y,
                z,
                dx,
                dy,
                dz,
                min_cos,
                best,
                best2,
            )
    return best, best2


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


@njit(cache=True)
def _gather(arrays, x, y, z, radius, used):
    """
    Write to the pool, after row `used`, the points within `radius` that it does not rule out.

    Row `used` itself is among them, so it is written twice and the first one dropped by the
    caller. Returns the end of what was written, or -1 when there are more than GATHER_LIMIT.
    """
    points, slots, start, scale = (
        arrays.points,
        arrays.block_slots,
        arrays.voxel_start,
        arrays.inverse_voxel,
    )
    pool, edge, end = arrays.pool, arrays.voxel, used + 1
    u, v, w = (x - arrays.x0) * scale, (y - arrays.y0) * scale, (z - arrays.z0) * scale
    reach = radius * scale * (1.0 + ROUNDING) + ROUNDING
    i0, i1 = _block_range(u, reach, arrays.blocks_x)
    j0, j1 = _block_range(v, reach, arrays.blocks_y)
    k0, k1 = _block_range(w, reach, arrays.blocks_z)
    for i in range(i0, i1):
        for j in range(j0, j1):
            gap_ij = _gap2(u, i) + _gap2(v, j)
            for k in range(k0, k1):
                if gap_ij + _gap2(w, k) > reach * reach:
                    continue
                key = _pack(i, j, k)
                row = _find_slot(slots, key, slots.shape[0] - 1)
                if slots[row, 0] == key:
                    end = _gather_block(
                        points,
                        start,
                        pool,
                        slots[row, 1],
                        u - BLOCK * i,
                        v - BLOCK * j,
                        w - BLOCK * k,
                        reach,
                        x,
                        y,
                        z,
                        edge,
                        used,
                        end,
                    )
                    if end < 0:
                        return end
    return end


@njit(cache=True)
def _gather_block(points, start, pool, number, u, v, w, reach, x, y, z, edge, used, end):
    i0, i1 = _voxel_range(u, reach)
    j0, j1 = _voxel_range(v, reach)
    k0, k1 = _voxel_range(w, reach)
    for i in range(i0, i1):
        for j in range(j0, j1):
            for k in range(k0, k1):
                voxel = number * BLOCK_VOXELS + _voxel_in_block(i, j, k)
                for p in range(start[voxel], start[voxel + 1]):
                    if _never_nearest(points, p, pool, used, x, y, z, edge):
                        continue
                    if end - used > GATHER_LIMIT:
                        return -1
                    for column in range(4):
                        pool[end, column] = points[p, column]
                    end += 1
    return end


@njit(cache=True)
def _prune(pool, used, end, x, y, z, edge):
    """
    Drop from pool rows used..end those ruled out by the one nearest to some corner of the box.

    Returns the new end.
    """
    for corner in range(8):
        qx = x + edge * ((corner & 1) - 0.5)
        qy = y + edge * (((corner >> 1) & 1) - 0.5)
        qz = z + edge * (((corner >> 2) & 1) - 0.5)
        best, best2 = used, np.inf
        for c in range(used, end):
            d2 = _distance2(pool, c, qx, qy, qz)
            if d2 < best2:
                best, best2 = c, d2
        # The winner goes first, where compaction cannot overwrite it before it has been compared
        # with all others.
        for column in range(4):
            pool[used, column], pool[best, column] = pool[best, column], pool[used, column]
        kept = used + 1
        for c in range(used + 1, end):
            if not _never_nearest(pool, c, pool, used, x, y, z, edge):
                for column in range(4):
                    pool[kept, column] = pool[c, column]
                kept += 1
        end = kept
    return end


@njit(cache=True)
def _make_list(arrays, x, y, z, used):
    """
    Write the candidate list of the cell with this centre at pool row `used`.

    Returns its length (0: no point within reach), or -1 where it would be too long.
    """
    half_diagonal = 0.5 * np.sqrt(3.0) * arrays.voxel
    limit = arrays.reach + half_diagonal
    best, best2 = _search(arrays, arrays.points, x, y, z, 0.0, 0.0, 0.0, -1.0, limit * limit)
    if best < 0:
        return 0
    # Every query of the cell has a point within |c - best| + half diagonal of it.
    radius = np.sqrt(best2) + 2.0 * half_diagonal * (1.0 + 1e-9)
    arrays.pool[used] = arrays.points[best]
    end = _gather(arrays, x, y, z, radius, used)
    if end < 0:
        return -1
    arrays.pool[used] = arrays.pool[end - 1]  # the second copy of `best` is still among them
    length = _prune(arrays.pool, used, end - 1, x, y, z, arrays.voxel) - used
    return length if length <= LIST_LIMIT else -1


@njit(cache=True)
def _visit(arrays, key, row):
    """
    Count a visit to a cell that has no list, in row `row` of the table.

    From the PATIENCE-th on it gets one. Returns the cell's entry.
    """
    slots = arrays.cell_slots
    table = slots.shape[0] - COUNTERS
    if slots[row, 0] != key:
        if slots[table, 0] * 2 >= table:
            _empty(slots)
            row = _find_slot(slots, key, table - 1)
        slots[row, 0], slots[row, 1] = key, 0
        slots[table, 0] += 1
    if slots[row, 1] == CROWDED:
        return CROWDED
    slots[row, 1] -= 1
    if slots[row, 1] <= -PATIENCE:
        if slots[table, 1] + GATHER_LIMIT + 2 > arrays.pool.shape[0]:
            _empty(slots)
            return np.int64(-1)
        slots[row, 1] = _add_list(arrays, key)
    return slots[row, 1]


@njit(cache=True)
def _empty(slots):
    table = slots.shape[0] - COUNTERS
    slots[:table, 0] = -1
    slots[table] = 0
    slots[table + 1, 1] += 1


@njit(cache=True)
def _add_list(arrays, key):
    """Make the list of a cell; its packed entry, or CROWDED."""
    counters = arrays.cell_slots[-COUNTERS:]
    x = arrays.x0 + ((key >> (2 * AXIS_BITS)) - AXIS_LIMIT + 0.5) * arrays.voxel
    y = arrays.y0 + (((key >> AXIS_BITS) & AXIS_MASK) - AXIS_LIMIT + 0.5) * arrays.voxel
    z = arrays.z0 + ((key & AXIS_MASK) - AXIS_LIMIT + 0.5) * arrays.voxel
    start = counters[0, 1]
    length = _make_list(arrays, x, y, z, start)
    counters[1, 0] += 1
    if length < 0:
        return np.int64(CROWDED)
    counters[0, 1] += length
    return (start << 16) + length


@njit(cache=True)
def _cell_key(x0, y0, z0, inverse_voxel, x, y, z):
    """Key of the cell that holds a place; -1 for nan and for places absurdly far away."""
    i = np.floor((x - x0) * inverse_voxel)
    j = np.floor((y - y0) * inverse_voxel)
    k = np.floor((z - z0) * inverse_voxel)
    if not (abs(i) < AXIS_LIMIT and abs(j) < AXIS_LIMIT and abs(k) < AXIS_LIMIT):
        return np.int64(-1)
    return _pack(int(i) + AXIS_LIMIT, int(j) + AXIS_LIMIT, int(k) + AXIS_LIMIT)


@njit(cache=True)
def _nearest_listed(pool, entry, x, y, z, limit2):
    """Nearest of a cell's candidates: (pool row or -1, squared distance)."""
    best, best2 = -1, limit2
    start = entry >> 16
    for c in range(start, start + (entry & 0xFFFF)):
        d2 = _distance2(pool, c, x, y, z)
        if d2 < best2:
            best, best2 = c, d2
    return best, best2


@njit(cache=True)
def _nearest_facing_listed(pool, normals, entry, x, y, z, dx, dy, dz, min_cos, limit2):
    """
    Nearest of a cell's candidates that face.

    (pool row or -1, squared distance, whether none is nearer).
    """
    best, best2, any2 = -1, limit2, limit2
    start = entry >> 16
    for c in range(start, start + (entry & 0xFFFF)):
        d2 = _distance2(pool, c, x, y, z)
        if d2 < any2:
            any2 = d2
        if d2 < best2 and _faces(normals, int(pool[c, 3]), dx, dy, dz, min_cos):
            best, best2 = c, d2
    return best, best2, any2 >= best2


@njit(cache=True)
def _nearest_searched(arrays, normals, x, y, z, dx, dy, dz, min_cos, limit2):
    best, best2 = _search(arrays, normals, x, y, z, dx, dy, dz, min_cos, limit2)
    if best < 0:
        return np.int64(-1), np.inf
    return np.int64(arrays.points[best, 3]), best2


@njit(cache=True)
def nearest(arrays, x, y, z, max_distance):
    """
    (row of the nearest point in the caller's cloud, squared distance [m^2]), or (-1, inf).

    The latter when none lies strictly within `max_distance` [m] or the query is not finite.
    """
    index, distance2 = np.int64(-1), np.inf
    key = _cell_key(arrays.x0, arrays.y0, arrays.z0, arrays.inverse_voxel, x, y, z)
    if key >= 0:
        slots = arrays.cell_slots
        row = _find_slot(slots, key, slots.shape[0] - COUNTERS - 1)
        entry = slots[row, 1]
        if slots[row, 0] != key or entry < 0:
            entry = _visit(arrays, key, row)
        if entry >= 0 and ((entry & 0xFFFF) > 0 or max_distance <= arrays.reach):
            best, best2 = _nearest_listed(arrays.pool, entry, x, y, z, max_distance * max_distance)
            if best >= 0:
                index, distance2 = np.int64(arrays.pool[best, 3]), best2
        else:
            index, distance2 = _nearest_searched(
                arrays, arrays.points, x, y, z, 0.0, 0.0, 0.0, -1.0, max_distance * max_distance
            )
    return index, distance2


@njit(cache=True)
def nearest_facing(arrays, normals, x, y, z, dx, dy, dz, max_distance, min_cos):
    """
    As `nearest`, among the points whose outward normal n has -(n . d) >= min_cos.

    normals: (P, 3) in the caller's order; d = (dx, dy, dz): unit direction of the ray, so that it
    hits the surface from its outside. The list holds the nearest of all: where that one faces it
    is the answer, which is the common case. Otherwise the nearest facing candidate bounds the
    distance within which the grid is searched.
    """
    index, distance2 = np.int64(-1), np.inf
    key = _cell_key(arrays.x0, arrays.y0, arrays.z0, arrays.inverse_voxel, x, y, z)
    if key >= 0:
        limit2, done = max_distance * max_distance, False
        slots = arrays.cell_slots
        row = _find_slot(slots, key, slots.shape[0] - COUNTERS - 1)
        entry = slots[row, 1]
        if slots[row, 0] != key or entry < 0:
            entry = _visit(arrays, key, row)
        if entry >= 0 and ((entry & 0xFFFF) > 0 or max_distance <= arrays.reach):
            best, limit2, done = _nearest_facing_listed(
                arrays.pool, normals, entry, x, y, z, dx, dy, dz, min_cos, limit2
            )
            if best >= 0:
                index, distance2 = np.int64(arrays.pool[best, 3]), limit2
        if not done:
            nearer, nearer2 = _nearest_searched(
                arrays, normals, x, y, z, dx, dy, dz, min_cos, limit2
            )
            if nearer >= 0:
                index, distance2 = nearer, nearer2
    return index, distance2


@njit(cache=True)
def _stored_list(slots, key):
    """Return a cell's packed list, or -1 where there is none (yet)."""
    if key < 0:
        return np.int64(-1)
    row = _find_slot(slots, key, slots.shape[0] - COUNTERS - 1)
    return slots[row, 1] if slots[row, 0] == key else np.int64(-1)


# The batches unpack `arrays` once and not per lookup, which halves the time of a lookup that finds
# its list.
@njit(cache=True)
def nearest_batch(arrays, queries, max_distance, index, distance2):
    """`nearest` for queries (Q, 3), into index (Q,) and distance2 (Q,)."""
    slots, pool, within = arrays.cell_slots, arrays.pool, max_distance <= arrays.reach
    x0, y0, z0, inverse = arrays.x0, arrays.y0, arrays.z0, arrays.inverse_voxel
    for q in range(queries.shape[0]):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        entry = _stored_list(slots, _cell_key(x0, y0, z0, inverse, x, y, z))
        if entry >= 0 and ((entry & 0xFFFF) > 0 or within):
            best, best2 = _nearest_listed(pool, entry, x, y, z, max_distance * max_distance)
            index[q] = np.int64(pool[best, 3]) if best >= 0 else -1
            distance2[q] = best2 if best >= 0 else np.inf
        else:
            index[q], distance2[q] = nearest(arrays, x, y, z, max_distance)


@njit(cache=True)
def nearest_facing_batch(
    arrays, normals, queries, directions, max_distance, min_cos, index, distance2
):
    """
    `nearest_facing` for queries (Q, 3) along directions (Q, 3).

    Written into index (Q,) and distance2 (Q,).
    """
    slots, pool, within = arrays.cell_slots, arrays.pool, max_distance <= arrays.reach
    x0, y0, z0, inverse = arrays.x0, arrays.y0, arrays.z0, arrays.inverse_voxel
    for q in range(queries.shape[0]):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        dx, dy, dz = directions[q, 0], directions[q, 1], directions[q, 2]
        entry, done = _stored_list(slots, _cell_key(x0, y0, z0, inverse, x, y, z)), False
        if entry >= 0 and ((entry & 0xFFFF) > 0 or within):
            best, best2, done = _nearest_facing_listed(
                pool, normals, entry, x, y, z, dx, dy, dz, min_cos, max_distance * max_distance
            )
            index[q] = np.int64(pool[best, 3]) if best >= 0 else -1
            distance2[q] = best2 if best >= 0 else np.inf
        if not done:
            index[q], distance2[q] = nearest_facing(
                arrays, normals, x, y, z, dx, dy, dz, max_distance, min_cos
            )


class VoxelIndex:
    """
    Nearest-neighbour index of a fixed cloud; see the module's docstring for how it works.

    points: (P, 3) [m], finite, P >= 1. normals: (P, 3) unit, needed for `nearest_facing`.
    voxel: edge of a voxel [m], by default so that an occupied one holds two points or so.
    reach: largest distance [m] that is served at full speed; larger ones are exact too, but
    searched for.
    cache_cells: candidate lists kept at a time (about 0.5 kB each).
    """

    def __init__(
        self,
        points: np.ndarray,
        normals: np.ndarray | None = None,
        voxel: float | None = None,
        reach: float = 0.1,
        cache_cells: int = 1 << 16,
    ):
        points = _checked_rows(points, 'points')
        self.normals = points if normals is None else _checked_rows(normals, 'normals')
        if self.normals.shape != points.shape:
            raise MapError(f'normals {self.normals.shape} must match points {points.shape}')
        self._has_normals = normals is not None
        self.voxel = float(voxel) if voxel is not None else _suitable_voxel(points)
        if not self.voxel > 0.0 or not reach >= 0.0:
            raise MapError(
                f'voxel must be > 0 and reach >= 0, got voxel {voxel!r}, reach {reach!r}'
            )
        self._cache_cells = int(cache_cells)
        self.arrays = _build(points, self.voxel, float(reach), self._cache_cells)

    def copy(self) -> VoxelIndex:
        """Return an index of the same cloud with a cache of its own (for another thread)."""
        twin = object.__new__(VoxelIndex)
        twin.__dict__.update(self.__dict__)
        cell_slots, pool = _empty_cache(self._cache_cells)
        twin.arrays = self.arrays._replace(cell_slots=cell_slots, pool=pool)
        return twin

    def reserve(self) -> VoxelIndex:
        """Take the cache's memory at once, not in the course of a long run; return self."""
        self.arrays.pool.fill(0.0)
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

        -1 and inf where none.
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
            self.normals,
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


def _suitable_voxel(points: np.ndarray) -> float:
    """Voxel edge at which occupied voxels hold about POINTS_PER_VOXEL points of a surface."""
    extent = float(np.ptp(points, axis=0).max())
    if extent == 0.0:
        return 1.0
    origin = points.min(axis=0)
    smallest = extent / (AXIS_LIMIT // 2)
    voxel = max(extent * np.sqrt(POINTS_PER_VOXEL / len(points)), smallest)
    for _ in range(4):  # occupancy grows as the square of the edge
        occupied = 1 + np.count_nonzero(
            np.diff(np.sort(_morton_codes(points, origin, 1.0 / voxel)))
        )
        voxel = max(voxel * np.sqrt(POINTS_PER_VOXEL * occupied / len(points)), smallest)
        if voxel >= extent:
            return extent
    return voxel


def _build(points: np.ndarray, voxel: float, reach: float, cache_cells: int) -> VoxelArrays:
    origin, inverse = points.min(axis=0), 1.0 / voxel
    extent = np.floor((points.max(axis=0) - origin) * inverse).astype(np.int64)
    if extent.max() >= AXIS_LIMIT:
        raise MapError(
            f'voxel {voxel} m is too small for a cloud {np.ptp(points, axis=0).max():.6g} m '
            f'across; at most {AXIS_LIMIT} voxels fit along an axis'
        )
    codes = _morton_codes(points, origin, inverse)
    order = np.argsort(codes, kind='stable')
    codes, points = codes[order], np.column_stack([points[order], order.astype(np.float64)])
    block = np.floor((points[:, :3] - origin) * inverse).astype(np.int64) // BLOCK
    keys = (block[:, 0] << (2 * AXIS_BITS)) | (block[:, 1] << AXIS_BITS) | block[:, 2]
    count = 1 + int(np.count_nonzero(np.diff(codes >> 6)))
    block_slots = np.full((_power_of_two(4 * count), 2), -1, np.int64)
    voxel_start = np.empty(count * BLOCK_VOXELS + 1, np.int64)
    _fill_blocks(codes, keys, block_slots, voxel_start)
    return VoxelArrays(
        points,
        block_slots,
        voxel_start,
        *_empty_cache(cache_cells),
        *map(float, origin),
        voxel,
        inverse,
        *map(int, extent // BLOCK + 1),
        reach,
    )


def _empty_cache(cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Tables for that many candidate lists; the memory of the pool is taken only as it fills."""
    cell_slots = np.full((_power_of_two(2 * cells) + COUNTERS, 2), -1, np.int64)
    cell_slots[-COUNTERS:] = 0
    return cell_slots, np.empty((20 * cells + 2 * GATHER_LIMIT, 4))


def spatial_order(points: np.ndarray, voxel: float) -> np.ndarray:
    """
    (P,) rows of the points along a Morton curve through voxels of this edge [m].

    Neighbours lie close in memory.
    """
    return np.argsort(_morton_codes(points, points.min(axis=0), 1.0 / voxel), kind='stable')


def _power_of_two(least: int) -> int:
    return 1 << max(int(least - 1).bit_length(), 4)
