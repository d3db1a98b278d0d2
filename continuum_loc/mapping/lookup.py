"""
The lookups of `VoxelIndex`, as kernels that others can call.

A batch goes through four passes: where each query's list lies, its two nearest points in single
precision, which one it is in double precision, and a search of the grid for the rest. Arrays are
handed on once a batch: numba counts who holds them, which for each query would take longer than
the lookup.
"""

from __future__ import annotations

from typing import NamedTuple

from continuum_loc.mapping.candidates import find_near_lists
from continuum_loc.mapping.facing import find_facing_lists, forget_lists
from continuum_loc.mapping.grid import distance2, in_range, Lattice, search, toward
from continuum_loc.mapping.lanes import (
    COS_ERROR,
    facing_lanes,
    fetch,
    LANES,
    lowest_lane,
    near_lanes,
    slack2,
    two_nearest,
    two_nearest_facing,
)
from numba import njit
import numpy as np


class VoxelArrays(NamedTuple):
    """
    The index as arrays.

    Kernels take it whole and unpack it outside their loops. Only the last eight arrays are ever
    written.

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
        _compare_facing(arrays, queries, directions, min_cos, begin, end, first, after, *found)
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
    lanes, points, lattice = arrays.lanes, arrays.points, arrays.lattice
    x0, y0, z0, rounding = lattice.x0, lattice.y0, lattice.z0, lattice.rounding
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
    """
    As `_compare`, for queries begin..end, among the points of their lists that may face.

    nearest holds rows of `points`; ~row where single precision cannot tell that it faces the beam.
    """
    lanes, faces, listed = arrays.list_lanes, arrays.list_faces, arrays.list_points
    points, lattice = arrays.points, arrays.lattice
    x0, y0, z0 = lattice.x0, lattice.y0, lattice.z0
    may, sure = np.float32(min_cos - COS_ERROR), np.float32(min_cos + COS_ERROR)
    for q in range(begin, end):
        dx, dy, dz = directions[q, 0], directions[q, 1], directions[q, 2]
        bx, by, bz = np.float32(dx), np.float32(dy), np.float32(dz)
        found, least2[q], next2[q] = two_nearest_facing(
            lanes, None, first[q], after[q],
            np.float32(queries[q, 0] - x0), np.float32(queries[q, 1] - y0),
            np.float32(queries[q, 2] - z0), faces, bx, by, bz, may,
        )  # fmt: skip
        group, lane = found // LANES, found % LANES
        row = np.int64(listed[group, lane])
        fetch(points, 4 * row)
        facing = -(
            faces[group, 0, lane] * bx + faces[group, 1, lane] * by + faces[group, 2, lane] * bz
        )
        nearest[q] = row if facing >= sure else ~row


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
            p = nearest[q] if nearest[q] >= 0 else ~nearest[q]
            if p == nearest[q] or toward(normals, p, dx, dy, dz) >= min_cos:
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
