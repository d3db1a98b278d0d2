"""
Which points of a cloud can be nearest to some place in a cube, found before anybody asks.

A point p cannot be nearest anywhere in a cube if another point o is closer at all of it. The
difference of the two squared distances is linear in the place, so that its minimum over the cube
with centre c and edge h has a closed form:

    min_q |q-p|^2 - |q-o|^2 = |c-p|^2 - |c-o|^2 - h |p-o|_1.

`prune` asks this of whole groups (`lanes`), for the points o that are nearest to the cube's centre
and corners. `near_cells` does so for all space within reach of a cloud: it begins with a cube
around everything and halves cubes, as only what is on a cube's list can be on those of its
children.
"""

from __future__ import annotations

from typing import NamedTuple

from continuum_loc.mapping.grid import AXIS_BITS, enter, find_slot, pack, pack_all, table_size
from continuum_loc.mapping.lanes import (
    ALL_LANES,
    LANES,
    lowest_lane,
    near_lanes,
    nearest_lane2,
    rival_lanes,
    SINGLE,
    slack2,
)
from numba import njit
import numpy as np

AXIS_CELLS = 1 << AXIS_BITS
STACK_BITS = 3  # of the number of cubes along a stack's edge
STACK_MASK = (1 << STACK_BITS) - 1
HALF_DIAGONAL = 0.5 * np.sqrt(3.0) * (1.0 + 1e-6)  # of a cube with edge 1


class NearCells(NamedTuple):
    """
    For each cube of space within reach of a cloud, the groups that can hold a nearest point.

    Cubes lie in stacks of 8 x 8 x 8, so that the lists of neighbours are close in memory.
    slots: (H, 2) hash table from a stack's key to its number. begins: (512 S + 1,) where the list
    of each cube begins in groups (L,), stack by stack; it ends where the next one begins.
    corner: x, y, z from which cubes are counted [m]. edge, inverse_edge: of a cube [m], [1/m].
    """

    slots: np.ndarray
    begins: np.ndarray
    groups: np.ndarray
    corner: tuple[float, float, float]
    edge: float
    inverse_edge: float


@njit(cache=True)
def prune(lanes, groups, may, sure, count, x, y, z, edge, reach, rounding):
    """
    Keep the groups that can hold the nearest point to some place in a cube; how many.

    groups, may, sure: (>= count,) numbers of groups, the bits of their points that may count, and
    of those that count for certain and so can rule others out; what is kept is moved to the front.
    x, y, z: the cube's centre from the lanes' origin [m]. Points more than `reach` [m] away from
    all of the cube are dropped.
    """
    cx, cy, cz = np.float32(x), np.float32(y), np.float32(z)
    half = HALF_DIAGONAL * edge
    least = np.float32(np.inf)
    for c in range(count):
        least = min(least, nearest_lane2(lanes, np.int64(groups[c]), sure[c], cx, cy, cz))
    # Every place in the cube has a point within |c - nearest| + half diagonal of it.
    radius = reach + half
    if least < np.inf:
        radius = min(np.sqrt(least + slack2(least, rounding)) + 2.0 * half, radius)
    error = slack2(radius * radius, rounding)
    limit2, kept = np.float32(radius * radius + error), 0
    for c in range(count):
        near = near_lanes(lanes, np.int64(groups[c]), cx, cy, cz, limit2)
        kept = _keep(groups, may, sure, kept, c, near)
    error += edge * (4.0 * rounding + 32.0 * SINGLE * radius)
    last = np.int64(-1)
    for corner in range(-1, 8):
        qx, qy, qz = cx, cy, cz
        if corner >= 0:
            qx = np.float32(x + edge * ((corner & 1) - 0.5))
            qy = np.float32(y + edge * (((corner >> 1) & 1) - 0.5))
            qz = np.float32(z + edge * (((corner >> 2) & 1) - 0.5))
        point = _nearest_sure(lanes, groups, sure, kept, qx, qy, qz)
        if point < 0:
            return kept
        if point == last:
            continue
        last = point
        kept = _drop_ruled_out(lanes, groups, may, sure, kept, point, cx, cy, cz, edge, error)
    return kept


@njit(cache=True)
def _nearest_sure(lanes, groups, sure, count, x, y, z):
    """Find the point, of those that count for certain, nearest to a place; its number, or -1."""
    least, at = np.float32(np.inf), -1
    for c in range(count):
        gap2 = nearest_lane2(lanes, np.int64(groups[c]), sure[c], x, y, z)
        if gap2 < least:
            least, at = gap2, c
    if at < 0:
        return np.int64(-1)
    group, limit2 = np.int64(groups[at]), np.float32(least * (1.0 + 32.0 * SINGLE))
    return LANES * group + lowest_lane(sure[at] & near_lanes(lanes, group, x, y, z, limit2))


@njit(cache=True)
def _drop_ruled_out(lanes, groups, may, sure, count, point, x, y, z, edge, error):
    """Drop what this point is closer than at all of the cube; how many groups stay."""
    group, lane = point // LANES, point % LANES
    ox, oy, oz = lanes[group, 0, lane], lanes[group, 1, lane], lanes[group, 2, lane]
    own2 = (ox - x) ** 2 + (oy - y) ** 2 + (oz - z) ** 2
    limit2, size, kept = np.float32(own2 + error), np.float32(edge), 0
    for c in range(count):
        rivals = rival_lanes(lanes, np.int64(groups[c]), x, y, z, ox, oy, oz, size, limit2)
        kept = _keep(groups, may, sure, kept, c, rivals)
    return kept


@njit(cache=True, inline='always')
def _keep(groups, may, sure, kept, c, chosen):
    """Move group c to place `kept` if any of its chosen points may count; how many there are."""
    left = may[c] & chosen
    if left == 0:
        return kept
    groups[kept], may[kept], sure[kept] = groups[c], left, sure[c] & left
    return kept + 1


# ------------------------------------------------------------ all space near a cloud


def near_cells(
    lanes: np.ndarray,
    origin: np.ndarray,
    extent: float,
    edge: float,
    reach: float,
    rounding: float,
    most: int,
) -> NearCells:
    """
    List the groups that matter in each cube within `reach` [m] of the cloud.

    lanes: (G, 3, 16), counted from `origin` (3,) [m]; extent: largest of the cloud's box [m].
    edge: wanted of a cube [m]; it is doubled until hardly more than `most` cubes are needed.
    """
    margin = reach + edge
    halvings = int(max(np.ceil(np.log2((extent + 2.0 * margin) / edge)), 0.0))
    edge = edge * 2.0**halvings
    cells, begins = np.zeros((1, 3), np.int64), np.array([0, len(lanes)])
    groups = np.arange(len(lanes), dtype=np.int32)
    for _ in range(min(halvings, AXIS_BITS)):
        if 8 * len(cells) > most:
            break
        edge *= 0.5
        cells, begins, groups = _halve(lanes, cells, begins, groups, edge, margin, reach, rounding)
    slots, stacked, groups = _stack(cells, begins, groups)
    return NearCells(slots, stacked, groups, tuple((origin - margin).tolist()), edge, 1.0 / edge)


def _stack(
    cells: np.ndarray, begins: np.ndarray, groups: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lay lists out as `NearCells` has them: its slots, begins and groups."""
    keys = pack_all(cells >> STACK_BITS)
    stacks, number = np.unique(keys, return_inverse=True)
    slots = np.full((table_size(4 * len(stacks)), 2), -1, np.int64)
    enter(stacks, np.arange(len(stacks)), slots)
    i, j, k = (cells & STACK_MASK).T
    at = _place_in_stacks(number, i, j, k)
    lengths = np.zeros((len(stacks) << (3 * STACK_BITS)) + 1, np.int64)
    lengths[at + 1] = np.diff(begins)
    stacked, order = np.cumsum(lengths), np.argsort(at)
    shift = np.repeat(begins[order] - stacked[at[order]], lengths[at[order] + 1])
    return slots, stacked, groups[np.arange(len(groups)) + shift]


@njit(cache=True, inline='always')
def _place_in_stacks(stack, i, j, k):
    """Where the cube with these places in a stack stands among all cubes of all stacks."""
    return ((((stack << STACK_BITS) | i) << STACK_BITS | j) << STACK_BITS) | k


@njit(cache=True)
def _halve(lanes, parents, begins, groups, edge, margin, reach, rounding):
    """
    (cells (C, 3), begins (C + 1,), groups (L,)) of the children that have a point within reach.

    edge: of a child [m]; margin: from the corner that cells are counted from to the origin [m].
    """
    most = np.diff(begins).max()
    listed, may, sure = (
        np.empty(most, np.int32),
        np.empty(most, np.int64),
        np.empty(most, np.int64),
    )
    cells, ends = np.empty((8 * parents.shape[0], 3), np.int64), [np.int64(0)]
    found, count = np.empty(2 * groups.shape[0], np.int32), 0
    for parent in range(parents.shape[0]):
        for octant in range(8):
            first, after = begins[parent], begins[parent + 1]
            listed[: after - first] = groups[first:after]
            may[: after - first] = ALL_LANES
            sure[: after - first] = ALL_LANES
            for axis in range(3):
                cells[count, axis] = 2 * parents[parent, axis] + ((octant >> axis) & 1)
            x = (cells[count, 0] + 0.5) * edge - margin
            y = (cells[count, 1] + 0.5) * edge - margin
            z = (cells[count, 2] + 0.5) * edge - margin
            kept = prune(lanes, listed, may, sure, after - first, x, y, z, edge, reach, rounding)
            if kept == 0:
                continue
            begin, end = ends[count], ends[count] + kept
            if end > found.shape[0]:
                found = np.concatenate((found, np.empty(end, np.int32)))
            found[begin:end] = listed[:kept]
            ends.append(end)
            count += 1
    return cells[:count].copy(), np.array(ends), found[: ends[count]].copy()


@njit(cache=True)
def find_near_lists(near, queries, first, after):
    """Where the list of the cube that holds each query (Q, 3) lies; it is empty beyond reach."""
    slots, begins, mask = near.slots, near.begins, near.slots.shape[0] - 1
    x0, y0, z0, inverse_edge = near.corner[0], near.corner[1], near.corner[2], near.inverse_edge
    for q in range(queries.shape[0]):
        first[q], after[q] = 0, 0
        u = (queries[q, 0] - x0) * inverse_edge
        v = (queries[q, 1] - y0) * inverse_edge
        w = (queries[q, 2] - z0) * inverse_edge
        if not (0.0 <= u < AXIS_CELLS and 0.0 <= v < AXIS_CELLS and 0.0 <= w < AXIS_CELLS):
            continue
        i, j, k = int(u), int(v), int(w)
        key = pack(i >> STACK_BITS, j >> STACK_BITS, k >> STACK_BITS)
        row = find_slot(slots, key, mask)
        if slots[row, 0] == key:
            at = _place_in_stacks(slots[row, 1], i & STACK_MASK, j & STACK_MASK, k & STACK_MASK)
            first[q], after[q] = begins[at], begins[at + 1]
