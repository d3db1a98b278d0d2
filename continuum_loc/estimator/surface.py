"""The map's surface, as the kernels that match zones to it take it."""

from __future__ import annotations

from typing import Any, NamedTuple

from continuum_loc.mapping.prior_map import PriorMap
from continuum_loc.mapping.voxel_index import VoxelIndex
import numpy as np


class Planes(NamedTuple):
    """
    The surface at each point of a map.

    rows: (P, 7) point, unit normal, and weight of its information; variance: of the points across
    the surface [m^2].
    """

    rows: np.ndarray
    variance: float


class Surface(NamedTuple):
    """A map's planes, with the lookup of the nearest that faces a beam."""

    lookup: Any  # the `arrays` of a `VoxelIndex` of the same points
    planes: Planes


def surface_of(prior_map: PriorMap, planarity_power: float) -> Surface:
    """
    Weigh each point by its planarity, over the map's median and at most 1, to a power.

    A flat patch of scattered points has 0.8 to 0.9, which counts as whole: as a share of the
    information it would make the covariance too large.
    """
    flat = max(float(np.median(prior_map.planarity)), 1e-9)
    weight = np.minimum(prior_map.planarity / flat, 1.0) ** planarity_power
    rows = np.column_stack([prior_map.points, prior_map.normals, weight])
    return Surface(prior_map.index.arrays, Planes(rows, prior_map.sigma**2))


def thinned(surface: Surface, spacing: float) -> Surface:
    """
    Keep one point for each cell of `spacing` [m] and each octant of the normal.

    So both sides of a thin blade stay.
    """
    rows, variance = surface.planes
    points, normals = rows[:, :3], rows[:, 3:6]
    cells = np.floor((points - points.min(axis=0)) / spacing).astype(np.int64)
    octants = (normals > 0.0) @ np.array([1, 2, 4])
    keys = np.ravel_multi_index((*cells.T, octants), (*(cells.max(axis=0) + 1), 8))
    order = np.argsort(keys, kind='stable')
    kept = order[np.flatnonzero(np.diff(keys[order], prepend=-1))]
    index = VoxelIndex(points[kept], normals[kept])
    return Surface(index.arrays, Planes(rows[kept], variance))
