"""
Lists of the points that can be the nearest one facing a beam, made where beams are.

A list belongs to a cell of space and to one of 24 cones of directions: it leaves out what faces no
direction of the cone, and only what faces all of them rules others out. It holds copies of its
points, packed into as few groups as they fill.

Lists are made when a cell has been visited a few times (until then the grid is searched: a body
that moves on visits most cells once or twice), in memory of fixed size: when it is full it is
emptied.
"""

from __future__ import annotations

from continuum_loc.mapping.candidates import HALF_DIAGONAL, prune
from continuum_loc.mapping.grid import (
    AXIS_BITS,
    AXIS_LIMIT,
    AXIS_MASK,
    collect,
    find_slot,
    in_range,
    pack,
    ROUNDING,
    search,
    span_bounds,
    table_size,
)
from continuum_loc.mapping.lanes import (
    COS_ERROR,
    empty_lanes,
    facing_lanes,
    FAR,
    fetch,
    LANES,
    lowest_lane,
)
from numba import njit
import numpy as np

GATHER_LIMIT = 1024  # groups before pruning
LIST_LIMIT = 16  # packed groups; longer lists (the centre of a sphere) are not worth keeping
LIST_MEAN = 2  # that memory is taken for
PATIENCE = 24  # visits before a cell gets a list; most cells of a body that moves on see fewer
LENGTH_BITS = 16  # of a list's length in its entry
LENGTH_MASK = (1 << LENGTH_BITS) - 1
CROWDED = -1000  # entry of a cell whose list would be too long
# Rows after the cell table: [keys in it, groups in lists], [lists made, times emptied].
COUNTERS = 2
CONE_COS = 0.85  # of the half-angle of a cone about its axis (0.857 at its farthest corner)
CONE_SIN = np.sqrt(1.0 - CONE_COS**2)
CONE_TILT = 0.366  # of the axis of a quarter of a cube's face: (1, tilt, tilt)
TAKEN_AS_FILLED = (
    'list_lanes', 'list_faces', 'list_points', 'scratch', 'scratch_gap2', 'marks'
)  # fmt: skip


def empty_cache(cells: int, blocks: int, groups: int) -> dict[str, np.ndarray]:
    """Arrays of `VoxelArrays` for that many lists; those `TAKEN_AS_FILLED` cost nothing yet."""
    cell_slots = np.full((table_size(2 * cells) + COUNTERS, 2), -1, np.int64)
    cell_slots[-COUNTERS:] = 0
    listed = LIST_MEAN * cells + LIST_LIMIT
    return {
        'cell_slots': cell_slots,
        'list_lanes': empty_lanes(listed),
        'list_faces': empty_lanes(listed),
        'list_points': np.empty((listed, LANES), np.int32),
        'scratch': np.empty(blocks, np.int64),
        'scratch_gap2': np.empty(blocks),
        'marks': np.zeros(groups, np.int64),
        'made_for': np.full(1, np.nan),
    }


# ------------------------------------------------------------ cones of directions


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
    """Return the unit axis of a cone."""
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
    sine = np.sqrt(max(1.0 - min_cos * min_cos, 0.0))
    may = min_cos * CONE_COS - sine * CONE_SIN - COS_ERROR
    sure = min_cos * CONE_COS + sine * CONE_SIN + COS_ERROR
    return (may if min_cos > -CONE_COS else -2.0), (sure if min_cos < CONE_COS else 2.0)


# ------------------------------------------------------------ lists


@njit(cache=True)
def find_facing_lists(arrays, queries, directions, min_cos, start, first, after):
    """
    Where the lists for queries (Q, 3) and beams (Q, 3), from `start` on, lie in the packed groups.

    first: -1 where there is no list (yet). Returns the query before which the cache has to be
    emptied, or Q: what was found for those before it must be used up first.
    """
    slots, lattice = arrays.cell_slots, arrays.lattice
    list_lanes, list_faces, list_points = arrays.list_lanes, arrays.list_faces, arrays.list_points
    x0, y0, z0, scale = lattice.x0, lattice.y0, lattice.z0, lattice.inverse_cell
    table, room = slots.shape[0] - COUNTERS, arrays.list_points.shape[0] - LIST_LIMIT
    for q in range(start, queries.shape[0]):
        first[q], after[q] = 0, 0
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        if not in_range(lattice, x, y, z):
            continue
        i, j, k = (
            np.floor((x - x0) * scale),
            np.floor((y - y0) * scale),
            np.floor((z - z0) * scale),
        )
        cell = pack(int(i) + AXIS_LIMIT, int(j) + AXIS_LIMIT, int(k) + AXIS_LIMIT)
        key = (cell << 5) | _cone(directions[q, 0], directions[q, 1], directions[q, 2])
        row = find_slot(slots, key, table - 1)
        entry = slots[row, 1]
        if slots[row, 0] != key or entry < 0:
            if slots[table, 0] * 2 >= table or slots[table, 1] > room:
                if q > start:
                    return q
                forget_lists(slots)
                row = find_slot(slots, key, table - 1)
            entry = _visit(slots, key, row)
            if CROWDED < entry <= -PATIENCE:
                entry = _add_list(arrays, key, row, min_cos)
        first[q], after[q] = -1, -1
        if entry >= 0:
            first[q] = entry >> LENGTH_BITS
            after[q] = first[q] + (entry & LENGTH_MASK)
            for row in range(3 * first[q], 3 * first[q] + 3):
                fetch(list_lanes, row * LANES)
                fetch(list_faces, row * LANES)
            fetch(list_points, first[q] * LANES)
    return queries.shape[0]


@njit(cache=True)
def _visit(slots, key, row):
    """
    Count a visit to a cell that has no list, whose key belongs in row `row` of the table.

    Returns its entry: minus the number of visits, or CROWDED.
    """
    table = slots.shape[0] - COUNTERS
    if slots[row, 0] != key:
        slots[row, 0], slots[row, 1] = key, 0
        slots[table, 0] += 1
    if slots[row, 1] != CROWDED:
        slots[row, 1] -= 1
    return slots[row, 1]


@njit(cache=True)
def forget_lists(slots):
    """Empty the table, and with it the memory of the lists."""
    table = slots.shape[0] - COUNTERS
    slots[:table, 0] = -1
    slots[table] = 0
    slots[table + 1, 1] += 1


@njit(cache=True)
def _add_list(arrays, key, row, min_cos):
    """Give the cell and cone in row `row` of the table its list; its packed entry, or CROWDED."""
    slots, lattice, place = arrays.cell_slots, arrays.lattice, key >> 5
    counters = slots[-COUNTERS:]
    x = ((place >> (2 * AXIS_BITS)) - AXIS_LIMIT + 0.5) * lattice.cell
    y = (((place >> AXIS_BITS) & AXIS_MASK) - AXIS_LIMIT + 0.5) * lattice.cell
    z = ((place & AXIS_MASK) - AXIS_LIMIT + 0.5) * lattice.cell
    begin = counters[0, 1]
    counters[1, 0] += 1
    length = _make_list(arrays, x, y, z, key & 31, min_cos, begin)
    if length < 0:
        slots[row, 1] = CROWDED
    else:
        counters[0, 1] += length
        slots[row, 1] = (begin << LENGTH_BITS) + length
    return slots[row, 1]


@njit(cache=True)
def _make_list(arrays, x, y, z, cone, min_cos, begin):
    """
    Write the list of the cell with this centre, counted from the lattice's corner, at `begin`.

    Its length (0: no point within reach), or -1 where it is too long.
    """
    lattice = arrays.lattice
    may_cos, sure_cos = _cone_limits(cone, min_cos)
    axis = _cone_axis(cone)
    half = HALF_DIAGONAL * lattice.cell
    limit = arrays.reach + half
    best, best2, _ = search(
        arrays.points, arrays.normals, arrays.block_slots, arrays.block_spans, arrays.block_at,
        lattice, arrays.scratch, arrays.scratch_gap2,
        x + lattice.x0, y + lattice.y0, z + lattice.z0, axis[0], axis[1], axis[2], sure_cos,
        limit * limit,
    )  # fmt: skip
    radius = limit if best < 0 else min(np.sqrt(best2) + 2.0 * half, limit)
    groups = np.empty(GATHER_LIMIT, np.int32)
    may, sure = np.empty(GATHER_LIMIT, np.int64), np.empty(GATHER_LIMIT, np.int64)
    count = _gather(arrays, x, y, z, radius, axis, may_cos, sure_cos, groups, may, sure)
    if count < 0:
        return -1
    kept = prune(
        arrays.lanes, groups, may, sure, count,
        x, y, z, lattice.cell, arrays.reach, lattice.rounding,
    )  # fmt: skip
    return _pack(arrays, groups, may, kept, begin)


@njit(cache=True)
def _pack(arrays, groups, chosen, count, begin):
    """Copy the chosen points of groups to packed groups from `begin` on; how many, or -1."""
    lanes, faces = arrays.lanes, arrays.faces
    list_lanes, list_faces, list_points = arrays.list_lanes, arrays.list_faces, arrays.list_points
    packed = 0
    for c in range(count):
        group, left = np.int64(groups[c]), chosen[c]
        while left != 0:
            lane = lowest_lane(left)
            left &= left - 1
            to, place = begin + packed // LANES, packed % LANES
            if to - begin == LIST_LIMIT:
                return -1
            list_points[to, place] = LANES * group + lane
            for axis in range(3):
                list_lanes[to, axis, place] = lanes[group, axis, lane]
                list_faces[to, axis, place] = faces[group, axis, lane]
            packed += 1
    used = -(-packed // LANES)
    for spare in range(packed, used * LANES):
        list_lanes[begin + spare // LANES, :, spare % LANES] = FAR
        list_faces[begin + spare // LANES, :, spare % LANES] = np.nan  # faces nothing
    return used


@njit(cache=True)
def _gather(arrays, x, y, z, radius, axis, may_cos, sure_cos, groups, may, sure):
    """
    Find the groups with points that may face, of blocks within `radius` of a place; how many.

    -1 where they are too many. may, sure: bits of the points that may face and that surely do.
    """
    faces, marks, scale = arrays.faces, arrays.marks, arrays.lattice.inverse_block
    ax, ay, az = np.float32(axis[0]), np.float32(axis[1]), np.float32(axis[2])
    stamp = arrays.cell_slots[-1, 0]  # lists made so far: marks what this one has looked at
    reach = radius * scale * (1.0 + ROUNDING) + ROUNDING
    blocks = collect(
        arrays.block_slots, arrays.block_spans, arrays.block_at, arrays.lattice,
        arrays.scratch, arrays.scratch_gap2, x * scale, y * scale, z * scale, reach, 0.0,
    )  # fmt: skip
    count = 0
    for block in range(blocks):
        first, after = span_bounds(arrays.scratch[block])
        for group in range(first // LANES, (after - 1) // LANES + 1):
            if marks[group] == stamp:
                continue
            marks[group] = stamp
            bits = facing_lanes(faces, group, ax, ay, az, np.float32(may_cos))
            if bits == 0:
                continue
            if count == GATHER_LIMIT:
                return -1
            groups[count], may[count] = group, bits
            sure[count] = bits & facing_lanes(faces, group, ax, ay, az, np.float32(sure_cos))
            count += 1
    return count
