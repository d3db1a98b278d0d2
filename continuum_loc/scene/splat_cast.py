"""
Where a ray first crosses the mapped surface.

Each map point is taken as a small disc on its tangent plane.
"""

from __future__ import annotations

from continuum_loc.compiling import kernel
from continuum_loc.mapping.grid import find_slot, pack, span_bounds
from continuum_loc.mapping.prior_map import PriorMap
from continuum_loc.mapping.voxel_index import VoxelIndex
import numpy as np

COVER = 1.25  # spacings: 99.9 % of a sampled surface lies nearer than this to a sample


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
    _cast(
        index.arrays,
        prior.normals,
        *rays,
        float(radius),
        float(min_cos),
        prior.oriented,
        rows,
        depths,
    )
    return rows, depths


@kernel
def _cast(arrays, normals, origins, directions, lengths, radius, min_cos, oriented, rows, depths):
    for ray in range(origins.shape[0]):
        rows[ray], depths[ray] = _first_crossing(
            arrays, normals, origins[ray], directions[ray], lengths[ray], radius, min_cos, oriented
        )


@kernel
def _first_crossing(arrays, normals, origin, direction, length, radius, min_cos, oriented):
    """
    March through the index's blocks until the next one lies beyond the best crossing.

    A disc is looked for in the block of its centre only. One that reaches from a neighbouring
    block, through which
    the ray does not run, is not seen: a share of about radius / block edge of the surface has
    thinner cover.
    """
    lattice = arrays.lattice
    edge, corner = lattice.block, (lattice.x0, lattice.y0, lattice.z0)
    extent = (lattice.blocks_x, lattice.blocks_y, lattice.blocks_z)
    at, step, until, stride = start_march(origin, direction, corner, edge)
    best, depth, entered = -1, length, 0.0
    while entered <= depth:
        if 0 <= at[0] < extent[0] and 0 <= at[1] < extent[1] and 0 <= at[2] < extent[2]:
            key = pack(at[0], at[1], at[2])
            row = find_slot(arrays.block_slots, key, arrays.block_slots.shape[0] - 1)
            if arrays.block_slots[row, 0] == key:
                best, depth = _cross_block(
                    arrays,
                    arrays.block_slots[row, 1],
                    normals,
                    origin,
                    direction,
                    radius,
                    min_cos,
                    oriented,
                    best,
                    depth,
                )
        entered = next_cell(at, step, until, stride)
    return best, (depth if best >= 0 else np.inf)


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


@kernel
def _cross_block(arrays, span, normals, origin, direction, radius, min_cos, oriented, best, depth):
    """Improve (row, depth) by the discs of the block with this span."""
    points = arrays.points
    first, after = span_bounds(span)
    for p in range(first, after):
        row = int(points[p, 3])
        toward = -(
            normals[row, 0] * direction[0]
            + normals[row, 1] * direction[1]
            + normals[row, 2] * direction[2]
        )
        if (toward if oriented else abs(toward)) < min_cos:
            continue
        ox, oy, oz = points[p, 0] - origin[0], points[p, 1] - origin[1], points[p, 2] - origin[2]
        t = -(normals[row, 0] * ox + normals[row, 1] * oy + normals[row, 2] * oz) / toward
        if t <= 0.0 or t >= depth:
            continue
        ex, ey, ez = ox - t * direction[0], oy - t * direction[1], oz - t * direction[2]
        if ex * ex + ey * ey + ez * ez < radius * radius:
            best, depth = row, t
    return best, depth
