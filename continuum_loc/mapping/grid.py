"""
Points sorted by block, and the search among them.

A block is a cube of some twenty points; a hash table with open addressing finds it by its place.
"""

from __future__ import annotations

from typing import NamedTuple

from numba import njit
import numpy as np

AXIS_BITS = 19
AXIS_MASK = (1 << AXIS_BITS) - 1
AXIS_LIMIT = 1 << (AXIS_BITS - 1)
SPAN_BITS = 32  # of the length in a span
SPAN_MASK = (1 << SPAN_BITS) - 1
FIRST_REACH = 0.25  # blocks that a search looks around at first
ROUNDING = 1e-9  # far above the rounding of coordinates counted in blocks


class Lattice(NamedTuple):
    """
    Origin [m] and edges [m] of blocks and cells, with their inverses, and extent in blocks.

    rounding: bound [m] on the error of a difference of coordinates in single precision.
    """

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
    rounding: float


# ------------------------------------------------------------ keys and hash tables


@njit(cache=True, inline='always')
def in_range(lattice, x, y, z):
    """Whether cells can be counted up to a place: not for nan, nor absurdly far away."""
    limit = (AXIS_LIMIT - 1) * lattice.cell
    return (
        abs(x - lattice.x0) < limit and abs(y - lattice.y0) < limit and abs(z - lattice.z0) < limit
    )


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
def enter(keys, values, slots):
    """Put keys (B,) with their values (B,) into the table."""
    for number in range(keys.shape[0]):
        row = find_slot(slots, keys[number], slots.shape[0] - 1)
        slots[row, 0], slots[row, 1] = keys[number], values[number]


def pack_all(places: np.ndarray) -> np.ndarray:
    """Keys (B,) of blocks or cells at places (B, 3)."""
    i, j, k = places.T
    return (i << (2 * AXIS_BITS)) | (j << AXIS_BITS) | k


def table_size(least: int) -> int:
    """Rows of a hash table: the power of two that is not below `least`."""
    return 1 << max(int(least - 1).bit_length(), 4)


def span(first: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Where runs begin and how long they are, in one number each (`span_bounds`)."""
    return (first << SPAN_BITS) + length


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
def morton_codes(points, origin, inverse_edge):
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
def collect(slots, spans, block_at, lattice, scratch, gaps2, u, v, w, reach, seen2):
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
    """Where a run begins, and where it has ended."""
    return span >> SPAN_BITS, (span >> SPAN_BITS) + (span & SPAN_MASK)


@njit(cache=True, inline='always')
def _block_gap2(block_at, number, u, v, w):
    return (
        _gap2(u, block_at[number, 0]) + _gap2(v, block_at[number, 1])
    ) + _gap2(w, block_at[number, 2])  # fmt: skip


@njit(cache=True, inline='always')
def distance2(points, p, x, y, z):
    ex, ey, ez = points[p, 0] - x, points[p, 1] - y, points[p, 2] - z
    return ex * ex + ey * ey + ez * ez


@njit(cache=True, inline='always')
def toward(normals, p, dx, dy, dz):
    """How far a surface faces a beam: the cosine of the angle of incidence."""
    return -(normals[p, 0] * dx + normals[p, 1] * dy + normals[p, 2] * dz)


@njit(cache=True)
def _scan(points, normals, begin, end, x, y, z, dx, dy, dz, min_cos, best, best2, row):
    """Improve (place, squared distance, caller's row) by points begin..end that face the beam."""
    for p in range(begin, end):
        d2 = distance2(points, p, x, y, z)
        if d2 <= best2 and (d2 < best2 or points[p, 3] < row):
            if min_cos <= -1.0 or toward(normals, p, dx, dy, dz) >= min_cos:
                best, best2, row = p, d2, points[p, 3]
    return best, best2, row


@njit(cache=True)
def search(
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
        count = collect(slots, spans, block_at, lattice, scratch, gaps2, u, v, w, reach, seen2)
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
