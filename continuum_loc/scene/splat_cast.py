"""
Where a ray first crosses the mapped surface.

Each map point is taken as a small disc on its tangent plane.
"""

from __future__ import annotations

from typing import NamedTuple

from continuum_loc.compiling import kernel
from continuum_loc.mapping.grid import find
from continuum_loc.mapping.prior_map import PriorMap
from continuum_loc.mapping.voxel_index import VoxelIndex
import numpy as np

COVER = 1.25  # spacings: 99.9 % of a sampled surface lies nearer than this to a sample


class Discs(NamedTuple):
    """
    How map points are taken: their radius [m], and which count.

    Those count whose normal n has -(n . d) >= min_cosine for a ray's direction d; its absolute
    value, where normals are not oriented.
    """

    radius: float
    min_cosine: float
    oriented: bool


def first_crossings(
    prior: PriorMap,
    index: VoxelIndex,
    origins: np.ndarray,
    directions: np.ndarray,
    lengths: np.ndarray,
    *,
    radius: float | None = None,
    min_cos: float = 0.2,
) -> tuple[np.ndarray, np.ndarray]:
    """
    (rows (N,) of the map points first crossed, or -1; depths (N,) along the rays [m], or inf).

    origins (N, 3) [m]; directions (N, 3) unit; lengths (N,) how far to look [m]. radius: of the
    discs [m], by default a little more than the map's spacing, at which blue-noise points leave
    hardly a hole. min_cos: discs more oblique than this are passed by; on an oriented map so are
    those seen from inside the solid.
    """
    radius = COVER * prior.spacing if radius is None else radius
    rows, depths = np.full(len(origins), -1, np.int64), np.full(len(origins), np.inf)
    rays = (
        np.ascontiguousarray(part, dtype=np.float64) for part in (origins, directions, lengths)
    )
    discs = Discs(float(radius), float(min_cos), bool(prior.oriented))
    _cast(index.arrays, discs, *rays, rows, depths)
    return rows, depths


@kernel
def _cast(arrays, discs, origins, directions, lengths, rows, depths):
    for ray in range(origins.shape[0]):
        rows[ray], depths[ray] = _first_crossing(
            arrays, discs, origins[ray], directions[ray], lengths[ray]
        )


@kernel
def _first_crossing(arrays, discs, origin, direction, length):
    """
    March through the index's blocks until the next one lies beyond the best crossing.

    A disc is looked for in the block of its centre only. One that reaches from a neighbouring
    block, through which the ray does not run, is not seen: a share of about radius / block edge of
    the surface has thinner cover.
    """
    lattice, begins = arrays.lattice, arrays.begins
    nx, ny, nz = lattice.extent
    at, step, until, stride = start_march(origin, direction, lattice.corner, lattice.edge)
    best, depth, entered = np.int64(-1), length, 0.0
    while entered <= depth:
        if 0 <= at[0] < nx and 0 <= at[1] < ny and 0 <= at[2] < nz:
            block = find(arrays.slots, at[0], at[1], at[2])
            if block >= 0:
                points = range(begins[block], begins[block + 1])
                best, depth = _cross(arrays, discs, points, origin, direction, best, depth)
        entered = next_cell(at, step, until, stride)
    return best, (depth if best >= 0 else np.inf)


@kernel
def _cross(arrays, discs, block, origin, direction, best, depth):
    """Improve (row, depth) by the discs of a block, a range of sorted points."""
    points, normals = arrays.points, arrays.normals
    for p in block:
        toward = -(
            normals[p, 0] * direction[0]
            + normals[p, 1] * direction[1]
            + normals[p, 2] * direction[2]
        )
        if (toward if discs.oriented else abs(toward)) < discs.min_cosine:
            continue
        ox, oy, oz = points[p, 0] - origin[0], points[p, 1] - origin[1], points[p, 2] - origin[2]
        t = -(normals[p, 0] * ox + normals[p, 1] * oy + normals[p, 2] * oz) / toward
        if t <= 0.0 or t >= depth:
            continue
        ex, ey, ez = ox - t * direction[0], oy - t * direction[1], oz - t * direction[2]
        if ex * ex + ey * ey + ez * ez < discs.radius * discs.radius:
            best, depth = arrays.rows[p], t
    return best, depth


@kernel
def start_march(origin, direction, corner, edge):
    """
    Start a march through cells of `edge` [m] counted from `corner` (Amanatides and Woo, 1987).

    Returns its state: the cell, the step per axis, how far along the ray the cell's next side is,
    and how far apart such sides are.
    """
    at, step = np.empty(3, np.int64), np.empty(3, np.int64)
    until, stride = np.empty(3), np.empty(3)
    for axis in range(3):
        offset = (origin[axis] - corner[axis]) / edge
        at[axis] = int(np.floor(offset))
        step[axis] = 1 if direction[axis] > 0.0 else -1
        moving = abs(direction[axis]) > 1e-12
        stride[axis] = edge / abs(direction[axis]) if moving else np.inf
        ahead = at[axis] + 1 - offset if step[axis] > 0 else offset - at[axis]
        until[axis] = ahead * stride[axis] if moving else np.inf
    return at, step, until, stride


@kernel
def next_cell(at, step, until, stride):
    """Move a march (`start_march`) to its next cell; return how far along the ray it begins."""
    axis = int(np.argmin(until))
    entered = until[axis]
    until[axis] += stride[axis]
    at[axis] += step[axis]
    return entered
