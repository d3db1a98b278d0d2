"""
The lookup of `VoxelIndex`, as a kernel that other kernels call.

Blocks around a place are looked at in rings, each a hollow cube of blocks, from the block that
holds the place outward. The search ends when what has been found is nearer than any block that was
not looked at. Comparisons that may rule a block out give way by ROUNDING, so that rounding never
rules a neighbour out.
"""

from __future__ import annotations

from typing import NamedTuple

from continuum_loc.compiling import kernel
from continuum_loc.mapping.grid import find
import numpy as np

ROUNDING = 1e-9  # far above the rounding of coordinates counted in blocks


class Lattice(NamedTuple):
    """Corner x, y, z [m] that blocks are counted from, edge of one [m], blocks along each axis."""

    corner: tuple[float, float, float]
    edge: float
    inverse_edge: float
    extent: tuple[int, int, int]


class VoxelArrays(NamedTuple):
    """
    A cloud sorted by block; kernels take it whole, and none writes to it.

    points, normals: (P, 3) [m], unit; rows: (P,) the points' rows in the caller's cloud.
    begins: (B + 1,) where the points of each block begin; they end where the next one's begin.
    places: (B, 3) of the blocks, counted from the lattice's corner; slots: their hash table.
    """

    points: np.ndarray
    normals: np.ndarray
    rows: np.ndarray
    begins: np.ndarray
    places: np.ndarray
    slots: np.ndarray
    lattice: Lattice


class Beam(NamedTuple):
    """End of a beam [m], its unit direction, and the least cosine of a surface that faces it."""

    x: float
    y: float
    z: float
    dx: float
    dy: float
    dz: float
    min_cosine: float


@kernel
def nearest_facing_batch(arrays, ends, directions, max_distance, min_cosine, found, distance2):
    """
    Find for each beam the nearest point to its end among those whose normals face it.

    A normal n faces the direction d where -(n . d) >= min_cosine. ends, directions: (Q, 3), the
    latter unit, away from the sensor. Writes the rows in the caller's cloud to found (Q,) and the
    squared distances to distance2 (Q,) [m^2]: -1 and inf where none lies strictly within
    `max_distance` [m], or an end is not finite. Of equally near points the first of the caller's
    cloud is taken.
    """
    limit2 = max_distance * max_distance
    for q in range(ends.shape[0]):
        beam = Beam(
            ends[q, 0], ends[q, 1], ends[q, 2],
            directions[q, 0], directions[q, 1], directions[q, 2], min_cosine,
        )  # fmt: skip
        row, best2 = _search(arrays, beam, limit2)
        found[q], distance2[q] = row, best2 if row >= 0 else np.inf


@kernel
def _search(arrays, beam, limit2):
    """Row of the nearest point that faces the beam, or -1, and its squared distance [m^2]."""
    lattice, row, best2 = arrays.lattice, np.int64(-1), limit2
    if not (np.isfinite(beam.x) and np.isfinite(beam.y) and np.isfinite(beam.z)):
        return row, best2
    at = (
        (beam.x - lattice.corner[0]) * lattice.inverse_edge,
        (beam.y - lattice.corner[1]) * lattice.inverse_edge,
        (beam.z - lattice.corner[2]) * lattice.inverse_edge,
    )
    home = (
        _within(at[0], lattice.extent[0]),
        _within(at[1], lattice.extent[1]),
        _within(at[2], lattice.extent[2]),
    )
    ring = 0
    while (2 * ring + 1) ** 3 <= arrays.places.shape[0]:  # rings so far, hollow ones filled
        row, best2 = _scan_ring(arrays, beam, at, home, ring, row, best2)
        if _cleared(lattice, at, home, ring) ** 2 > _reach2(lattice, best2):
            return row, best2
        ring += 1
    return _scan_all(arrays, beam, at, row, best2)


# at: place of a beam's end counted in blocks; home: the block that holds it, or the nearest to it.


@kernel(inline='always')
def _within(u, count):
    """Nearest of `count` blocks along one axis."""
    return int(min(max(np.floor(u), 0.0), count - 1.0))


@kernel(inline='always')
def _reach2(lattice, distance2):
    """Squared distance in blocks within which a block may hold a point as near as this [m^2]."""
    return distance2 * lattice.inverse_edge * lattice.inverse_edge * (1.0 + ROUNDING) + ROUNDING


@kernel(inline='always')
def _gap2(u, place):
    """Squared distance along one axis, in blocks, to the block at this place."""
    gap = max(place - u, u - place - 1.0, 0.0)
    return gap * gap


@kernel(inline='always')
def _cleared(lattice, at, home, ring):
    """How far from the place, in blocks, no block is left to look at beyond a ring."""
    nearest = np.inf
    for axis in range(3):
        if home[axis] - ring > 0:
            nearest = min(nearest, at[axis] - (home[axis] - ring))
        if home[axis] + ring + 1 < lattice.extent[axis]:
            nearest = min(nearest, home[axis] + ring + 1 - at[axis])
    return nearest


@kernel(inline='always')
def _outward(u, home, n):
    """Take the n-th place along an axis from home outward, the nearer side of u first."""
    away = (n + 1) // 2
    return home + away if (n % 2 == 1) == (u - home > 0.5) else home - away


@kernel(inline='always')
def _scan_ring(arrays, beam, at, home, ring, row, best2):
    """
    Improve (row, squared distance) by the blocks of a ring that come into question.

    Each axis is walked outward, so that what is found early rules most others out.
    """
    lattice, begins, slots = arrays.lattice, arrays.begins, arrays.slots
    nx, ny, nz = lattice.extent
    count, reach2 = 2 * ring + 1, _reach2(lattice, best2)
    for a in range(count):
        i = _outward(at[0], home[0], a)
        gap_i = _gap2(at[0], i)
        if gap_i > reach2 or not 0 <= i < nx:
            continue
        for b in range(count):
            j = _outward(at[1], home[1], b)
            gap_ij = gap_i + _gap2(at[1], j)
            if gap_ij > reach2 or not 0 <= j < ny:
                continue
            # A ring is hollow: inside it a line of blocks has its two ends only.
            for c in range(count - 2 if max(a, b) < count - 2 else 0, count):
                k = _outward(at[2], home[2], c)
                if 0 <= k < nz and gap_ij + _gap2(at[2], k) <= reach2:
                    block = find(slots, i, j, k)
                    if block >= 0:
                        row, best2 = _scan(
                            arrays, beam, begins[block], begins[block + 1], row, best2
                        )
                        reach2 = _reach2(lattice, best2)
    return row, best2


@kernel(inline='always')
def _scan_all(arrays, beam, at, row, best2):
    """Improve (row, squared distance) by all blocks: there are fewer than places in the rings."""
    begins, places = arrays.begins, arrays.places
    for block in range(places.shape[0]):
        gap2 = _gap2(at[0], places[block, 0]) + _gap2(at[1], places[block, 1])
        if gap2 + _gap2(at[2], places[block, 2]) <= _reach2(arrays.lattice, best2):
            row, best2 = _scan(arrays, beam, begins[block], begins[block + 1], row, best2)
    return row, best2


@kernel(inline='always')
def _scan(arrays, beam, first, after, row, best2):
    """Improve (row, squared distance) by the sorted points first .. after that face the beam."""
    points, normals, rows = arrays.points, arrays.normals, arrays.rows
    for p in range(first, after):
        ex, ey, ez = points[p, 0] - beam.x, points[p, 1] - beam.y, points[p, 2] - beam.z
        gap2 = ex * ex + ey * ey + ez * ez
        if gap2 < best2 or (gap2 == best2 and rows[p] < row):
            along = normals[p, 0] * beam.dx + normals[p, 1] * beam.dy + normals[p, 2] * beam.dz
            if -along >= beam.min_cosine:
                row, best2 = rows[p], gap2
    return row, best2
