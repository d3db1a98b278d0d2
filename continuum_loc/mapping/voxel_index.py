"""Exact nearest-neighbour lookup in a point cloud, as arrays that compiled kernels can use.

Two levels. Below, a hashed voxel grid: points lie sorted by voxel, voxels are grouped in blocks of 4x4x4, and
an open-addressing hash table finds a block's points. Above, a cache of candidate lists: for a cell of space
(the size of a voxel, occupied or not) the few points that can be nearest to *some* query inside it. A query then
costs one hash probe and a scan of a short list, however far it is from the surface and however large the map.

A point p cannot be nearest anywhere in a box if another point p' is closer at all of it. The difference of the two
squared distances is linear in the query, so that its minimum over the box with centre c and edge h has a closed
form:  min_q |q-p|^2 - |q-p'|^2 = |c-p|^2 - |c-p'|^2 - h (|g_x| + |g_y| + |g_z|),  g = p' - p.

Lists are made when a cell is first visited, in memory of fixed size: when it is full it is emptied. Answers never
depend on what the cache holds. Because queries write to it, use one index (`VoxelIndex.copy`) per thread.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from continuum_loc.mapping.errors import MapError

BLOCK = 4  # voxels along a block's edge
BLOCK_VOXELS = BLOCK**3
POINTS_PER_VOXEL = 10.0  # mean over occupied voxels: balances the length of lists against their number
AXIS_BITS = 21
AXIS_LIMIT = 1 << (AXIS_BITS - 1)
GATHER_LIMIT = 4096  # candidates before pruning
LIST_LIMIT = 384  # after pruning; longer lists (the centre of a sphere) are not worth keeping
FAR, CROWDED = -1, -2  # instead of a list's length: no point within reach; too many candidates


class VoxelArrays(NamedTuple):
    """The index as arrays. Kernels take it whole; only the cache arrays and `state` are ever written.

    points: (P, 3) sorted by voxel [m]; order: (P,) their rows in the caller's cloud.
    geometry: (6,) origin x, y, z, voxel edge, its inverse, reach of the candidate lists [m].
    blocks: (3,) extent of the map in blocks.
    block_slots: (H, 2) hash table of block key and block number; block_keys: (B,) key of each block.
    voxel_start: (B * 64 + 1,) first sorted point of each voxel.
    cell_slots: (C, 2) hash table of cell key and packed list (start * 2^16 + length + 2).
    pool: (L,) sorted-point numbers, the lists end to end.
    state: (4,) cells in use, pool in use, lists made, times emptied.
    """

    points: np.ndarray
    order: np.ndarray
    geometry: np.ndarray
    blocks: np.ndarray
    block_slots: np.ndarray
    block_keys: np.ndarray
    voxel_start: np.ndarray
    cell_slots: np.ndarray
    pool: np.ndarray
    state: np.ndarray


@njit(cache=True, inline="always")
def _pack(i, j, k):
    return (np.int64(i) << (2 * AXIS_BITS)) | (np.int64(j) << AXIS_BITS) | np.int64(k)


@njit(cache=True, inline="always")
def _hash(key, mask):
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    return np.int64((mixed ^ (mixed >> np.uint64(32))) & np.uint64(mask))


@njit(cache=True)
def _find_slot(slots, key):
    """Row of `key` in the table, or of the free row where it belongs."""
    mask = slots.shape[0] - 1
    row = _hash(key, mask)
    while slots[row, 0] != key and slots[row, 0] != -1:
        row = (row + 1) & mask
    return row


@njit(cache=True, inline="always")
def _voxel_in_block(i, j, k):
    """Number of a voxel within its block, 0..63, in Morton order (each coordinate 0..3)."""
    return ((i & 2) << 4) | ((j & 2) << 3) | ((k & 2) << 2) | ((i & 1) << 2) | ((j & 1) << 1) | (k & 1)


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
    """(P,) Morton code of each point's voxel; the lowest 6 bits number the voxel within its block."""
    codes = np.empty(points.shape[0], np.int64)
    for p in range(points.shape[0]):
        i = np.int64(np.floor((points[p, 0] - origin[0]) * inverse_voxel))
        j = np.int64(np.floor((points[p, 1] - origin[1]) * inverse_voxel))
        k = np.int64(np.floor((points[p, 2] - origin[2]) * inverse_voxel))
        codes[p] = (_spread_bits(i) << 2) | (_spread_bits(j) << 1) | _spread_bits(k)
    return codes


@njit(cache=True)
def _fill_blocks(points, codes, origin, inverse_voxel, block_slots, block_keys, voxel_start):
    """Enter the sorted points' blocks in the hash table and note where each voxel's points start."""
    block, last = -1, np.int64(-1)
    voxel = 0
    for p in range(points.shape[0]):
        if codes[p] >> 6 != last:
            last = codes[p] >> 6
            block += 1
            i = np.int64(np.floor((points[p, 0] - origin[0]) * inverse_voxel)) // BLOCK
            j = np.int64(np.floor((points[p, 1] - origin[1]) * inverse_voxel)) // BLOCK
            k = np.int64(np.floor((points[p, 2] - origin[2]) * inverse_voxel)) // BLOCK
            key = _pack(i, j, k)
            row = _find_slot(block_slots, key)
            block_slots[row, 0], block_slots[row, 1] = key, block
            block_keys[block] = key
        here = block * BLOCK_VOXELS + (codes[p] & 63)
        while voxel <= here:
            voxel_start[voxel] = p
            voxel += 1
    voxel_start[voxel:] = points.shape[0]


@njit(cache=True, inline="always")
def _axis_gap(x, low, high):
    return max(low - x, x - high, 0.0)


@njit(cache=True)
def _block_distance2(arrays, key, x, y, z):
    """Squared distance from a point to a block's box, a little less, so that rounding never rules out a hit."""
    edge = arrays.geometry[3] * BLOCK
    mask = (1 << AXIS_BITS) - 1
    x0 = arrays.geometry[0] + (key >> (2 * AXIS_BITS)) * edge
    y0 = arrays.geometry[1] + ((key >> AXIS_BITS) & mask) * edge
    z0 = arrays.geometry[2] + (key & mask) * edge
    gx = _axis_gap(x, x0, x0 + edge)
    gy = _axis_gap(y, y0, y0 + edge)
    gz = _axis_gap(z, z0, z0 + edge)
    return (gx * gx + gy * gy + gz * gz) * (1.0 - 1e-9) - 1e-18


@njit(cache=True, inline="always")
def _voxel_range(x, radius, origin, inverse_voxel, first):
    """Voxels 0..3 of the block starting at voxel `first` that x +- radius covers, as a half-open range."""
    low = np.floor((x - radius - origin) * inverse_voxel) - first
    high = np.floor((x + radius - origin) * inverse_voxel) - first
    return int(max(low, 0.0)), int(min(high, BLOCK - 1.0)) + 1


@njit(cache=True)
def _scan_block(arrays, block, key, normals, x, y, z, dx, dy, dz, min_cos, best, best2):
    """Improve (best sorted point, squared distance) by the points of one block."""
    points, geometry, start = arrays.points, arrays.geometry, arrays.voxel_start
    inverse = geometry[4]
    radius = np.sqrt(best2) * (1.0 + 1e-9) + 1e-12
    mask = (1 << AXIS_BITS) - 1
    i0, i1 = _voxel_range(x, radius, geometry[0], inverse, (key >> (2 * AXIS_BITS)) * BLOCK)
    j0, j1 = _voxel_range(y, radius, geometry[1], inverse, ((key >> AXIS_BITS) & mask) * BLOCK)
    k0, k1 = _voxel_range(z, radius, geometry[2], inverse, (key & mask) * BLOCK)
    for i in range(i0, i1):
        for j in range(j0, j1):
            for k in range(k0, k1):
                voxel = block * BLOCK_VOXELS + _voxel_in_block(i, j, k)
                for p in range(start[voxel], start[voxel + 1]):
                    ex, ey, ez = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
                    d2 = ex * ex + ey * ey + ez * ez
                    if d2 < best2 and (min_cos <= -1.0 or _faces(normals, arrays.order[p], dx, dy, dz, min_cos)):
                        best, best2 = p, d2
    return best, best2


@njit(cache=True, inline="always")
def _faces(normals, p, dx, dy, dz, min_cos):
    return -(normals[p, 0] * dx + normals[p, 1] * dy + normals[p, 2] * dz) >= min_cos


@njit(cache=True)
def _search(arrays, normals, x, y, z, dx, dy, dz, min_cos, best, best2):
    """Improve (best sorted point, squared distance) by every block nearer than that, in shells outward."""
    geometry, slots, blocks = arrays.geometry, arrays.block_slots, arrays.blocks
    edge = geometry[3] * BLOCK
    ci = np.int64(np.floor((x - geometry[0]) / edge))
    cj = np.int64(np.floor((y - geometry[1]) / edge))
    ck = np.int64(np.floor((z - geometry[2]) / edge))
    first = max(-ci, ci - blocks[0] + 1, -cj, cj - blocks[1] + 1, -ck, ck - blocks[2] + 1, 0)
    last = max(ci, blocks[0] - 1 - ci, cj, blocks[1] - 1 - cj, ck, blocks[2] - 1 - ck)
    for shell in range(first, last + 1):
        if shell > 1 and ((shell - 1) * edge) ** 2 * (1.0 - 1e-9) > best2:
            break
        if (2 * shell + 1) ** 2 > arrays.block_keys.shape[0] and shell > 2:
            return _search_all(arrays, normals, x, y, z, dx, dy, dz, min_cos, best, best2)
        for i in range(max(ci - shell, 0), min(ci + shell + 1, blocks[0])):
            for j in range(max(cj - shell, 0), min(cj + shell + 1, blocks[1])):
                on_side = abs(i - ci) == shell or abs(j - cj) == shell
                step = 1 if on_side or shell == 0 else 2 * shell
                for k in range(ck - shell, ck + shell + 1, step):
                    if k < 0 or k >= blocks[2]:
                        continue
                    key = _pack(i, j, k)
                    if _block_distance2(arrays, key, x, y, z) >= best2:
                        continue
                    row = _find_slot(slots, key)
                    if slots[row, 0] == key:
                        best, best2 = _scan_block(
                            arrays, slots[row, 1], key, normals, x, y, z, dx, dy, dz, min_cos, best, best2)
    return best, best2


@njit(cache=True)
def _search_all(arrays, normals, x, y, z, dx, dy, dz, min_cos, best, best2):
    """As `_search`, over the list of blocks: cheaper than empty space once that is the larger of the two."""
    for block in range(arrays.block_keys.shape[0]):
        key = arrays.block_keys[block]
        if _block_distance2(arrays, key, x, y, z) < best2:
            best, best2 = _scan_block(arrays, block, key, normals, x, y, z, dx, dy, dz, min_cos, best, best2)
    return best, best2


@njit(cache=True, inline="always")
def _never_nearest(arrays, p, other, x, y, z, edge):
    """Whether sorted point `other` is closer than `p` at every point of the box (centre x, y, z)."""
    points = arrays.points
    px, py, pz = points[p, 0], points[p, 1], points[p, 2]
    ox, oy, oz = points[other, 0], points[other, 1], points[other, 2]
    p2 = (px - x) ** 2 + (py - y) ** 2 + (pz - z) ** 2
    o2 = (ox - x) ** 2 + (oy - y) ** 2 + (oz - z) ** 2
    swing = edge * (abs(ox - px) + abs(oy - py) + abs(oz - pz))
    return p2 - o2 - swing > 1e-12 * (p2 + o2)


@njit(cache=True)
def _gather(arrays, x, y, z, radius, centre_nearest, edge):
    """Write to the end of the pool the points within `radius` that `centre_nearest` does not rule out; how many
    (GATHER_LIMIT + 1 when there are more)."""
    points, geometry, slots, blocks = arrays.points, arrays.geometry, arrays.block_slots, arrays.blocks
    start = arrays.voxel_start
    block_edge, used, count = geometry[3] * BLOCK, arrays.state[1], 0
    radius2 = radius * radius
    for i in range(max(np.int64(np.floor((x - radius - geometry[0]) / block_edge)), 0),
                   min(np.int64(np.floor((x + radius - geometry[0]) / block_edge)) + 1, blocks[0])):
        for j in range(max(np.int64(np.floor((y - radius - geometry[1]) / block_edge)), 0),
                       min(np.int64(np.floor((y + radius - geometry[1]) / block_edge)) + 1, blocks[1])):
            for k in range(max(np.int64(np.floor((z - radius - geometry[2]) / block_edge)), 0),
                           min(np.int64(np.floor((z + radius - geometry[2]) / block_edge)) + 1, blocks[2])):
                key = _pack(i, j, k)
                if _block_distance2(arrays, key, x, y, z) > radius2:
                    continue
                row = _find_slot(slots, key)
                if slots[row, 0] != key:
                    continue
                block = slots[row, 1]
                for p in range(start[block * BLOCK_VOXELS], start[(block + 1) * BLOCK_VOXELS]):
                    d2 = (points[p, 0] - x) ** 2 + (points[p, 1] - y) ** 2 + (points[p, 2] - z) ** 2
                    if d2 > radius2 or _never_nearest(arrays, p, centre_nearest, x, y, z, edge):
                        continue
                    if count == GATHER_LIMIT:
                        return GATHER_LIMIT + 1
                    arrays.pool[used + count] = p
                    count += 1
    return count


@njit(cache=True)
def _prune(arrays, x, y, z, edge, count):
    """Drop from the gathered candidates those ruled out by the point nearest to one of the box's corners."""
    points, pool, used = arrays.points, arrays.pool, arrays.state[1]
    for corner in range(8):
        qx = x + edge * ((corner & 1) - 0.5)
        qy = y + edge * (((corner >> 1) & 1) - 0.5)
        qz = z + edge * (((corner >> 2) & 1) - 0.5)
        best, best2 = -1, np.inf
        for c in range(used, used + count):
            p = pool[c]
            d2 = (points[p, 0] - qx) ** 2 + (points[p, 1] - qy) ** 2 + (points[p, 2] - qz) ** 2
            if d2 < best2:
                best, best2 = p, d2
        kept = 0
        for c in range(used, used + count):
            if not _never_nearest(arrays, pool[c], best, x, y, z, edge):
                pool[used + kept] = pool[c]
                kept += 1
        count = kept
    return count


@njit(cache=True)
def _make_list(arrays, x, y, z):
    """Candidate list of the cell with this centre at the end of the pool: its length, or FAR or CROWDED."""
    edge, reach = arrays.geometry[3], arrays.geometry[5]
    half_diagonal = 0.5 * np.sqrt(3.0) * edge
    limit = reach + half_diagonal
    best, best2 = _search(arrays, arrays.points, x, y, z, 0.0, 0.0, 0.0, -1.0, -1, limit * limit)
    if best < 0:
        return FAR
    # Every query of the cell has a point within |c - best| + half diagonal of it.
    radius = np.sqrt(best2) + 2.0 * half_diagonal * (1.0 + 1e-9)
    count = _gather(arrays, x, y, z, radius, best, edge)
    if count > GATHER_LIMIT:
        return CROWDED
    count = _prune(arrays, x, y, z, edge, count)
    return count if count <= LIST_LIMIT else CROWDED


@njit(cache=True)
def _empty_cache(arrays):
    arrays.cell_slots[:, 0] = -1
    arrays.state[0] = 0
    arrays.state[1] = 0
    arrays.state[3] += 1


@njit(cache=True)
def _add_list(arrays, key):
    """Make and store the list of a cell not seen before; its packed entry."""
    state, geometry = arrays.state, arrays.geometry
    if state[0] * 2 > arrays.cell_slots.shape[0] or state[1] + GATHER_LIMIT > arrays.pool.shape[0]:
        _empty_cache(arrays)
    edge = geometry[3]
    mask = (1 << AXIS_BITS) - 1
    x = geometry[0] + ((key >> (2 * AXIS_BITS)) - AXIS_LIMIT + 0.5) * edge
    y = geometry[1] + (((key >> AXIS_BITS) & mask) - AXIS_LIMIT + 0.5) * edge
    z = geometry[2] + ((key & mask) - AXIS_LIMIT + 0.5) * edge
    count = _make_list(arrays, x, y, z)
    entry = (state[1] << 16) + count + 2
    row = _find_slot(arrays.cell_slots, key)
    arrays.cell_slots[row, 0], arrays.cell_slots[row, 1] = key, entry
    state[0] += 1
    state[1] += max(count, 0)
    state[2] += 1
    return entry


@njit(cache=True)
def _cell_key(geometry, x, y, z):
    """Key of the cell that holds a place; -1 for nan and for places absurdly far away."""
    i = np.floor((x - geometry[0]) * geometry[4])
    j = np.floor((y - geometry[1]) * geometry[4])
    k = np.floor((z - geometry[2]) * geometry[4])
    if not (abs(i) < AXIS_LIMIT and abs(j) < AXIS_LIMIT and abs(k) < AXIS_LIMIT):
        return np.int64(-1)
    return _pack(int(i) + AXIS_LIMIT, int(j) + AXIS_LIMIT, int(k) + AXIS_LIMIT)


@njit(cache=True)
def _nearest_listed(points, pool, entry, x, y, z, limit2):
    """Nearest of a cell's candidates (sorted point or -1, squared distance)."""
    best, best2 = -1, limit2
    start = entry >> 16
    for c in range(start, start + (entry & 0xFFFF) - 2):
        p = pool[c]
        ex, ey, ez = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
        d2 = ex * ex + ey * ey + ez * ez
        if d2 < best2:
            best, best2 = p, d2
    return best, best2


@njit(cache=True)
def _nearest_unlisted(arrays, key, row, x, y, z, max_distance):
    """`nearest` where the cell has no usable list yet: make one, or search where none can be made."""
    entry = arrays.cell_slots[row, 1] if arrays.cell_slots[row, 0] == key else _add_list(arrays, key)
    count = (entry & 0xFFFF) - 2
    if count == CROWDED or (count == FAR and max_distance > arrays.geometry[5]):
        return _search(arrays, arrays.points, x, y, z, 0.0, 0.0, 0.0, -1.0, -1, max_distance * max_distance)
    return _nearest_listed(arrays.points, arrays.pool, entry, x, y, z, max_distance * max_distance)


# The next two are inlined into their callers: handing the arrays over costs more than the lookup itself.
@njit(cache=True, inline="always")
def nearest(arrays, x, y, z, max_distance):
    """(row of the nearest point in the caller's cloud, squared distance [m^2]), or (-1, inf) when none lies
    strictly within `max_distance` [m] or the query is not finite."""
    index, distance2 = np.int64(-1), np.inf
    key = _cell_key(arrays.geometry, x, y, z)
    if key >= 0:
        row = _find_slot(arrays.cell_slots, key)
        if arrays.cell_slots[row, 0] == key and (arrays.cell_slots[row, 1] & 0xFFFF) > 1:
            best, best2 = _nearest_listed(
                arrays.points, arrays.pool, arrays.cell_slots[row, 1], x, y, z, max_distance * max_distance)
        else:
            best, best2 = _nearest_unlisted(arrays, key, row, x, y, z, max_distance)
        if best >= 0:
            index, distance2 = np.int64(arrays.order[best]), best2
    return index, distance2


@njit(cache=True, inline="always")
def nearest_facing(arrays, normals, x, y, z, dx, dy, dz, max_distance, min_cos):
    """As `nearest`, among the points whose outward normal n has -(n . d) >= min_cos.

    normals: (P, 3) in the caller's order; d = (dx, dy, dz): unit direction of the ray, so that it hits the surface
    from its outside. The nearest point of all is the answer where it faces, which is the common case.
    """
    index, distance2 = nearest(arrays, x, y, z, max_distance)
    if index >= 0 and not _faces(normals, index, dx, dy, dz, min_cos):
        index, distance2 = _search_facing(arrays, normals, x, y, z, dx, dy, dz, max_distance, min_cos)
    return index, distance2


@njit(cache=True)
def _search_facing(arrays, normals, x, y, z, dx, dy, dz, max_distance, min_cos):
    """`nearest_facing` where the nearest point does not face: the facing ones among the cell's candidates bound the
    distance, and the grid is searched within that."""
    best, best2 = -1, max_distance * max_distance
    row = _find_slot(arrays.cell_slots, _cell_key(arrays.geometry, x, y, z))
    entry = arrays.cell_slots[row, 1]
    points, pool, order = arrays.points, arrays.pool, arrays.order
    for c in range(entry >> 16, (entry >> 16) + max((entry & 0xFFFF) - 2, 0)):
        p = pool[c]
        ex, ey, ez = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
        d2 = ex * ex + ey * ey + ez * ez
        if d2 < best2 and _faces(normals, order[p], dx, dy, dz, min_cos):
            best, best2 = p, d2
    best, best2 = _search(arrays, normals, x, y, z, dx, dy, dz, min_cos, best, best2)
    if best < 0:
        return np.int64(-1), np.inf
    return np.int64(order[best]), best2


@njit(cache=True)
def _nearest_batch(arrays, queries, max_distance, index, distance2):
    for q in range(queries.shape[0]):
        index[q], distance2[q] = nearest(arrays, queries[q, 0], queries[q, 1], queries[q, 2], max_distance)


@njit(cache=True)
def _nearest_facing_batch(arrays, normals, queries, directions, max_distance, min_cos, index, distance2):
    for q in range(queries.shape[0]):
        index[q], distance2[q] = nearest_facing(
            arrays, normals, queries[q, 0], queries[q, 1], queries[q, 2],
            directions[q, 0], directions[q, 1], directions[q, 2], max_distance, min_cos)


class VoxelIndex:
    """Nearest-neighbour index of a fixed cloud; see the module's docstring for how it works.

    points: (P, 3) [m], finite, P >= 1. normals: (P, 3) unit, needed for `nearest_facing`.
    voxel: edge of a voxel [m], by default so that an occupied one holds about ten points.
    reach: largest distance [m] that is served at full speed; larger ones are exact too, but searched for.
    cache_cells: candidate lists kept at a time (about 150 bytes each).
    """

    def __init__(self, points: np.ndarray, normals: np.ndarray | None = None, voxel: float | None = None,
                 reach: float = 0.1, cache_cells: int = 1 << 18):
        points = _checked_rows(points, "points")
        self.normals = points if normals is None else _checked_rows(normals, "normals")
        if self.normals.shape != points.shape:
            raise MapError(f"normals {self.normals.shape} must match points {points.shape}")
        self._has_normals = normals is not None
        self.voxel = float(voxel) if voxel is not None else _suitable_voxel(points)
        if not self.voxel > 0.0 or not reach >= 0.0:
            raise MapError(f"voxel must be > 0 and reach >= 0, got voxel {voxel!r}, reach {reach!r}")
        self.arrays = _build(points, self.voxel, float(reach), int(cache_cells))

    def copy(self) -> VoxelIndex:
        """An index of the same cloud with a cache of its own (for another thread)."""
        twin = object.__new__(VoxelIndex)
        twin.__dict__.update(self.__dict__)
        twin.arrays = self.arrays._replace(
            cell_slots=np.full_like(self.arrays.cell_slots, -1), pool=np.empty_like(self.arrays.pool),
            state=np.zeros_like(self.arrays.state))
        return twin

    def nearest(self, queries: np.ndarray, max_distance: float = np.inf) -> tuple[np.ndarray, np.ndarray]:
        """Rows (Q,) of the nearest points and distances (Q,) [m] for queries (Q, 3); -1 and inf where none."""
        queries = np.ascontiguousarray(queries, dtype=np.float64)
        index, distance2 = np.empty(len(queries), np.int64), np.empty(len(queries))
        _nearest_batch(self.arrays, queries, float(max_distance), index, distance2)
        return index, np.sqrt(distance2)

    def nearest_facing(self, queries: np.ndarray, directions: np.ndarray, max_distance: float = np.inf,
                       min_cos: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """As `nearest`, among points whose normal n has -(n . d) >= min_cos for the ray directions (Q, 3)."""
        if not self._has_normals:
            raise MapError("nearest_facing needs an index made with normals")
        queries = np.ascontiguousarray(queries, dtype=np.float64)
        directions = np.ascontiguousarray(np.broadcast_to(directions, queries.shape), dtype=np.float64)
        index, distance2 = np.empty(len(queries), np.int64), np.empty(len(queries))
        _nearest_facing_batch(self.arrays, self.normals, queries, directions, float(max_distance), float(min_cos),
                              index, distance2)
        return index, np.sqrt(distance2)


def _checked_rows(rows: np.ndarray, name: str) -> np.ndarray:
    rows = np.ascontiguousarray(rows, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != 3 or len(rows) == 0:
        raise MapError(f"{name} must be (P, 3) with P >= 1, got {rows.shape}")
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if len(bad):
        raise MapError(f"{name}: {len(bad)} of {len(rows)} rows are not finite, the first is row {bad[0]}")
    return rows


def _suitable_voxel(points: np.ndarray) -> float:
    """Voxel edge at which occupied voxels hold about POINTS_PER_VOXEL points, for points on a surface."""
    extent = float(np.ptp(points, axis=0).max())
    if extent == 0.0:
        return 1.0
    origin = points.min(axis=0)
    smallest = extent / (AXIS_LIMIT // 2)
    voxel = max(extent * np.sqrt(POINTS_PER_VOXEL / len(points)), smallest)
    for _ in range(4):  # occupancy grows as the square of the edge
        occupied = len(np.unique(_morton_codes(points, origin, 1.0 / voxel)))
        voxel = max(voxel * np.sqrt(POINTS_PER_VOXEL * occupied / len(points)), smallest)
        if voxel >= extent:
            return extent
    return voxel


def _build(points: np.ndarray, voxel: float, reach: float, cache_cells: int) -> VoxelArrays:
    origin = points.min(axis=0)
    extent = np.floor((points.max(axis=0) - origin) / voxel).astype(np.int64)
    if extent.max() >= AXIS_LIMIT // 2:
        raise MapError(f"voxel {voxel} m is too small for a cloud {np.ptp(points, axis=0).max():.6g} m across; "
                       f"at most {AXIS_LIMIT // 2} voxels fit along an axis")
    codes = _morton_codes(points, origin, 1.0 / voxel)
    order = np.argsort(codes, kind="stable")
    codes, points = codes[order], points[order]
    count = 1 + int(np.count_nonzero(np.diff(codes >> 6)))
    block_slots = np.full((_power_of_two(4 * count), 2), -1, np.int64)
    block_keys = np.empty(count, np.int64)
    voxel_start = np.empty(count * BLOCK_VOXELS + 1, np.int32 if len(points) < 2**31 else np.int64)
    _fill_blocks(points, codes, origin, 1.0 / voxel, block_slots, block_keys, voxel_start)
    return VoxelArrays(
        points=points, order=order.astype(np.int32 if len(points) < 2**31 else np.int64),
        geometry=np.array([*origin, voxel, 1.0 / voxel, reach]),
        blocks=np.floor((points.max(axis=0) - origin) * (1.0 / voxel)).astype(np.int64) // BLOCK + 1,
        block_slots=block_slots, block_keys=block_keys, voxel_start=voxel_start,
        cell_slots=np.full((_power_of_two(2 * cache_cells), 2), -1, np.int64),
        pool=np.empty(32 * cache_cells + 2 * GATHER_LIMIT, np.int32), state=np.zeros(4, np.int64))


def spatial_order(points: np.ndarray, voxel: float) -> np.ndarray:
    """(P,) rows of the points along a Morton curve through voxels of this edge [m]: neighbours lie close in memory."""
    return np.argsort(_morton_codes(points, points.min(axis=0), 1.0 / voxel), kind="stable")


def _power_of_two(least: int) -> int:
    return 1 << max(int(least - 1).bit_length(), 4)
